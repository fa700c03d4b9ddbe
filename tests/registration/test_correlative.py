"""Branch and bound finds what the exhaustive search finds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.datasets.simulation import drive, tiny_settings
from posegraph_slam.geometry import SE2, planar_from_spatial, xyt_from_pose
from posegraph_slam.registration.beam_matching import between, compose
from posegraph_slam.registration.beam_scans import BeamScanSettings, prepare_beam_scans
from posegraph_slam.registration.correlative import (
    FIELD_MAX,
    NO_DISC,
    block_score,
    branch_and_bound,
    exhaustive_search,
    likelihood_field,
    max_pooled,
    rotated_cells,
)
from posegraph_slam.registration.local_search import LocalSearchSettings, search_pose

RESOLUTION, SIGMA = 0.1, 0.1


@given(seed=st.integers(0, 10_000), reach=st.integers(1, 21), levels=st.integers(0, 5), clustered=st.booleans())
def test_branch_and_bound_scores_as_high_as_every_pose_tried(
    seed: int, reach: int, levels: int, clustered: bool
) -> None:
    rng = np.random.default_rng(seed)
    target = rng.uniform(-3, 3, (60, 2))
    source = target[::3] + rng.normal(0, 0.05, (20, 2)) if clustered else rng.uniform(-3, 3, (20, 2))
    origin, pad = np.array([-3.5, -3.5]), 1 << levels
    field = likelihood_field(target, origin, RESOLUTION, 70, 70, pad, SIGMA)
    cells = rotated_cells(source, np.zeros(3), np.linspace(-0.3, 0.3, 7), origin, RESOLUTION, pad)
    best = exhaustive_search(field, cells, reach)
    found = branch_and_bound(max_pooled(field, levels), cells, reach, 0, NO_DISC)
    assert found[3] == best[3] or (best[3] == 0 and found[3] == -1)
    assert branch_and_bound(max_pooled(field, levels), cells, reach, best[3], NO_DISC)[3] == -1
    if found[3] > 0:
        assert max(abs(found[1]), abs(found[2])) <= reach


@given(seed=st.integers(0, 10_000), levels=st.integers(0, 4), radius=st.integers(0, 9))
def test_the_best_rival_lies_outside_the_disc(seed: int, levels: int, radius: int) -> None:
    rng = np.random.default_rng(seed)
    origin, pad, reach = np.array([-3.5, -3.5]), 1 << levels, 12
    field = likelihood_field(rng.uniform(-3, 3, (60, 2)), origin, RESOLUTION, 70, 70, pad, SIGMA)
    cells = rotated_cells(rng.uniform(-3, 3, (20, 2)), np.zeros(3), np.array([0.0, 0.2]), origin, RESOLUTION, pad)
    centre = rng.integers(-12, 13, 2)
    shifts = np.arange(-reach, reach + 1)
    scores = [
        block_score(field, turned, dx, dy)
        for turned in cells
        for dx in shifts
        for dy in shifts
        if (dx - centre[0]) ** 2 + (dy - centre[1]) ** 2 > radius**2
    ]
    disc = (int(centre[0]), int(centre[1]), radius)
    found = branch_and_bound(max_pooled(field, levels), cells, reach, 0, disc)
    assert found[3] == max(scores) or (max(scores) == 0 and found[3] == -1)


def test_pooled_levels_hold_the_maximum_of_their_blocks() -> None:
    field = np.random.default_rng(0).integers(0, 255, (23, 17)).astype(np.uint8)
    stack = max_pooled(field, 3)
    for level in range(4):
        width = 1 << level
        for y in range(23):
            for x in range(17):
                assert stack[level, y, x] == field[y : y + width, x : x + width].max()


def test_field_is_the_nearest_points_gaussian() -> None:
    points = np.array([[0.05, 0.05], [0.75, 0.45]])
    field = likelihood_field(points, np.zeros(2), RESOLUTION, 10, 12, 2, SIGMA)
    assert field[2, 2] == FIELD_MAX
    assert field[2, 3] == round(FIELD_MAX * np.exp(-0.5))
    assert field[6, 9] == FIELD_MAX
    assert not field[:2].any()
    assert not field[:, :2].any()


def test_a_wide_window_is_searched_to_the_true_pose() -> None:
    log = drive(tiny_settings())
    assert log.scans is not None
    assert log.truth is not None
    scans = prepare_beam_scans(log.scans, BeamScanSettings())
    poses = planar_from_spatial(log.truth.poses) @ scans.T_base_lidar
    truth = xyt_from_pose(SE2.between(poses[30], poses[32]))
    arrays = (LocalSearchSettings().vector(), scans.points, scans.kind, scans.thinned)
    for offset in ([1.2, -0.8, 0.5], [-1.5, 0.4, -0.6]):
        start = compose(truth, np.array(offset))
        pose, score, rival = search_pose(32, np.array([30]), np.zeros((1, 3)), start, 2.0, 0.8, 0.3, *arrays)
        error = between(truth, pose)
        assert np.hypot(error[0], error[1]) < 0.15
        assert abs(error[2]) < 0.05
        assert score > 0.5
        assert not rival
    pose, score, _ = search_pose(32, np.array([30]), np.zeros((1, 3)), start, 2.0, 0.8, 0.999, *arrays)
    assert score == 0.0
    np.testing.assert_array_equal(pose, start)


@pytest.mark.parametrize("empty", ["source", "target"])
def test_nothing_to_compare_scores_zero(empty: str) -> None:
    points = np.ones((2, 40, 2), dtype=np.float32)
    kind = np.ones((2, 40), dtype=np.uint8)
    kind[0 if empty == "source" else 1] = 0
    start = np.array([1.0, 2.0, 0.3])
    pose, score, _ = search_pose(
        0, np.array([1]), np.zeros((1, 3)), start, 1.0, 0.5, 0.1, LocalSearchSettings().vector(),
        points, kind, kind > 0,
    )  # fmt: skip
    assert score == 0.0
    np.testing.assert_array_equal(pose, start)
