"""Parts of the robot are told from the world by moving with it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.sensors.self_returns import SelfReturnSettings, find_self_returns


def made_scans(rng, beams, own, scans=400):
    """Ranges that change from scan to scan, but for the beams of `own`, and the way driven."""
    ranges = rng.uniform(0.3, 10.0, (scans, beams)).astype(np.float32)
    for beam, distance in own.items():
        ranges[:, beam] = distance + rng.normal(0, 0.01, scans)
    return ranges, np.linspace(0.0, 40.0, scans)


@given(st.integers(0, 2**31), st.dictionaries(st.integers(20, 80), st.floats(0.15, 0.7), min_size=1, max_size=4))
def test_finds_what_moves_with_the_robot_and_nothing_else(seed, own):
    ranges, travel = made_scans(np.random.default_rng(seed), 100, own)
    found = find_self_returns(ranges, travel, SelfReturnSettings(margin_beams=0))
    assert set(np.flatnonzero(np.isfinite(found.range_m))) == set(own)
    for beam, distance in own.items():
        assert abs(found.range_m[beam] - distance) < 0.01
    mask = found.mask(ranges)
    assert mask[:, list(own)].mean() > 0.99
    assert mask[:, [b for b in range(100) if b not in own]].sum() == 0


def test_edges_and_returns_behind_the_robot():
    rng = np.random.default_rng(3)
    ranges, travel = made_scans(rng, 60, {30: 0.4})
    ranges[rng.random(len(ranges)) < 0.2, 31] = 0.41  # the antenna's edge
    ranges[::2, 30] = 5.0  # and its gaps
    found = find_self_returns(ranges, travel, SelfReturnSettings())
    mask = found.mask(ranges)
    assert mask[ranges[:, 31] == np.float32(0.41), 31].all()
    assert not mask[::2, 30].any()
    assert mask[1::2, 30].all()


@pytest.mark.parametrize("settings", [SelfReturnSettings(enabled=False), SelfReturnSettings(travel_min_m=50.0)])
def test_says_nothing_when_switched_off_or_hardly_moved(settings):
    ranges, travel = made_scans(np.random.default_rng(1), 60, {30: 0.4})
    found = find_self_returns(ranges, travel, settings)
    assert found.beams == 0
    assert not found.mask(ranges).any()


def test_a_long_stop_beside_a_wall_is_no_part_of_the_robot():
    rng = np.random.default_rng(5)
    ranges, travel = made_scans(rng, 60, {})
    ranges[100:380] = rng.normal(0.5, 0.005, (1, 60))
    travel[100:380] = travel[100]
    assert find_self_returns(ranges, travel, SelfReturnSettings()).beams == 0
