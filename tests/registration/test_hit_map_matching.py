"""Two-stage correlative matching on hit counts, against a slow search of every pose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import pose_from_xyt, transform_points
from posegraph_slam.registration.hit_map_matching import (
    HitMap,
    HitMapSettings,
    WindowSettings,
    add_hits,
    match_on_hits,
)

REPORT = HitMapSettings()
OTHER = HitMapSettings(
    resolution_m=0.06,
    coarse=WindowSettings(reach_m=0.24, step_m=0.12, reach_rad=0.1, step_rad=0.05),
    fine=WindowSettings(reach_m=0.06, step_m=0.02, reach_rad=0.02, step_rad=0.01),
)


def slow_window(points, hit_map, centre, odometry, window):
    """Score of every pose of a window, one by one: [(score, pose)]."""
    s, found = hit_map.settings, []
    for t in range(-window.turns, window.turns + 1):
        for i in range(-window.shifts, window.shifts + 1):
            for j in range(-window.shifts, window.shifts + 1):
                pose = centre + np.array([j * window.step_m, i * window.step_m, t * window.step_rad])
                cells = np.floor(
                    (transform_points(pose_from_xyt(pose), points) - hit_map.origin_m) / s.resolution_m
                ).astype(int)
                away = np.sum((pose[:2] - odometry[:2]) ** 2) / window.reach_m**2
                away += ((pose[2] - odometry[2]) / window.reach_rad) ** 2
                score = hit_map.hits[cells[:, 1], cells[:, 0]].sum() / (len(points) * s.hits_max)
                found.append((score, s.prior_weight * np.exp(-0.5 * away), pose))
    top = max(score for score, _, _ in found)
    return [(score + top * prior, pose) for score, prior, pose in found]


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from([REPORT, OTHER]), st.integers(1, 60))
def test_finds_what_a_search_of_every_pose_finds(seed, chosen, count):
    rng = np.random.default_rng(seed)
    hits = rng.integers(0, 101, (160, 170)).astype(np.uint8)
    hit_map = HitMap(hits=hits, origin_m=np.array([-4.2, -4.1]), settings=chosen)
    points = np.repeat(rng.uniform(-2, 2, (count, 2)), 2, axis=0) + rng.normal(0, 0.01, (2 * count, 2))
    odometry = rng.uniform([-0.5, -0.5, -3], [0.5, 0.5, 3])
    found = match_on_hits(points, hit_map, odometry)
    coarse = slow_window(points, hit_map, odometry, odometry, chosen.coarse)
    best = max(score for score, _ in coarse)
    # rounding may decide between coarse poses of one score: any of them may lead on
    fine = [
        max(slow_window(points, hit_map, pose, odometry, chosen.fine), key=lambda each: each[0])
        for score, pose in coarse
        if score > best - 1e-12
    ]
    assert any(found.score == pytest.approx(score, abs=1e-9) for score, _ in fine)
    assert any(np.allclose(found.xyt, pose, atol=1e-9) for _, pose in fine)


def room(rng, count=700):
    """Points of the walls of a room with an alcove."""
    side = rng.uniform(-4, 4, count)
    points = np.stack([side, np.where(np.arange(count) % 2, -2.5, 2.5)], axis=1)
    points[: count // 3] = np.stack([np.full(count // 3, 4.0), rng.uniform(-2.5, 2.5, count // 3)], axis=1)
    points[: count // 8, 0] = -3.0
    return points


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_recovers_a_pose_within_a_step(seed):
    rng = np.random.default_rng(seed)
    hit_map = HitMap.empty(np.array([-8.0, -8.0]), (320, 320), REPORT)
    for _ in range(6):
        hit_map = hit_map.with_points(room(rng) + rng.normal(0, 0.005, (700, 2)), np.zeros(3))
    true = rng.uniform([-0.1, -0.1, -0.05], [0.1, 0.1, 0.05])
    T_robot_map = np.linalg.inv(pose_from_xyt(true))
    points = transform_points(T_robot_map, room(rng)) + rng.normal(0, 0.005, (700, 2))
    found = match_on_hits(points, hit_map, np.zeros(3))
    # a cell of 0.05 m holds the same hits wherever the point lies in it, and the prior pulls: 0.046 m over 1500 seeds
    assert np.abs(found.xyt[:2] - true[:2]).max() < REPORT.coarse.step_m
    assert abs(found.xyt[2] - true[2]) < REPORT.coarse.step_rad
    assert found.matched_fraction > 0.6


def test_the_prior_holds_a_scan_in_a_corridor():
    rng = np.random.default_rng(2)
    walls = np.stack([rng.uniform(-6, 6, 4000), rng.choice([-1.0, 1.0], 4000)], axis=1)
    scan = np.stack([rng.uniform(-3, 3, 600), rng.choice([-1.0, 1.0], 600)], axis=1)
    moved = {0.0: 0.0, 0.05: 0.0}
    for weight in moved:
        chosen = HitMapSettings(prior_weight=weight)
        hit_map = HitMap.empty(np.array([-8.0, -8.0]), (320, 320), chosen).with_points(walls, np.zeros(3))
        for x in np.linspace(-1.0, 1.0, 11):
            moved[weight] += abs(match_on_hits(scan, hit_map, np.array([x, 0.0, 0.0])).xyt[0] - x) / 11
    assert moved[0.05] < 0.03
    assert moved[0.05] < 0.5 * moved[0.0]


def test_counts_are_bounded_and_points_outside_do_not_count():
    chosen = HitMapSettings(hits_max=5)
    hit_map = HitMap.empty(np.array([0.0, 0.0]), (10, 10), chosen)
    for _ in range(9):
        hit_map = hit_map.with_points(np.array([[0.12, 0.22], [9.0, 9.0], [-1.0, 0.1]]), np.zeros(3))
    assert hit_map.hits.sum() == 5
    assert hit_map.hits[4, 2] == 5
    assert match_on_hits(np.array([[40.0, 40.0]]), hit_map, np.zeros(3)).matched_fraction == 0.0


def test_an_empty_map_leaves_the_odometry():
    hit_map = HitMap.empty(np.array([-5.0, -5.0]), (200, 200), REPORT)
    odometry = np.array([0.4, -0.3, 1.0])
    np.testing.assert_allclose(match_on_hits(np.ones((9, 2)), hit_map, odometry).xyt, odometry, atol=1e-12)


def test_hits_are_added_where_the_points_are():
    hits, frame = np.zeros((4, 6), dtype=np.uint8), np.array([0.0, 0.0, 0.5])
    add_hits(hits, frame, np.array([[1.0, 0.0]]), np.array([1.2, 0.3, np.pi / 2]), 100)
    assert np.argwhere(hits).tolist() == [[2, 2]]


def test_steps_must_fit_the_cells_and_input_must_be_finite():
    with pytest.raises(ValidationError, match="no whole multiple or fraction of a cell"):
        HitMapSettings(fine=WindowSettings(reach_m=0.05, step_m=0.03, reach_rad=0.1, step_rad=0.1))
    hit_map = HitMap.empty(np.array([-5.0, -5.0]), (200, 200), REPORT)
    with pytest.raises(InputError, match="not finite"):
        match_on_hits(np.array([[np.nan, 0.0]]), hit_map, np.zeros(3))
    with pytest.raises(InputError, match="not planar"):
        match_on_hits(np.zeros((3, 3)), hit_map, np.zeros(3))
