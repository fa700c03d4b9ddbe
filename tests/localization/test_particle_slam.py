"""Particle-filter SLAM: its map, its weights against slow sums, its accuracy and its determinism."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, distance_transform_edt

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, pose_from_xyt
from posegraph_slam.localization.free_space import draw_scan_by_polygon
from posegraph_slam.localization.particle_slam import particle_slam
from posegraph_slam.localization.slam_map import FAR, SlamMap, draw_scan, empty_map
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.localization.slam_weights import count_scores, field_scores, likelihood_table, window_scores
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.raycast import NEVER_SEEN, ray_cells

SETTINGS = ParticleSlamSettings()
SENSOR = np.array([0.1, 0.0])


def base_points(world: Any, k: int) -> np.ndarray:
    return world.scans.points(k) + SENSOR


@pytest.fixture(scope="module")
def drawn(world: Any) -> SlamMap:
    """A map drawn from a dozen true poses."""
    slam_map = empty_map(world.grid.geometry, SETTINGS)
    for k in range(0, 240, 20):
        draw_scan(slam_map, base_points(world, k), world.truth[k], SENSOR)
    return slam_map


def test_one_scan_leaves_hits_four_times_as_heavy_as_misses(world: Any) -> None:
    slam_map = empty_map(world.grid.geometry, SETTINGS)
    draw_scan(slam_map, base_points(world, 0), world.truth[0], SENSOR)
    grid = slam_map.occupancy()
    values = np.unique(grid.log_odds[grid.observed])
    np.testing.assert_allclose(values, [-SETTINGS.free_log_odds, 4 * SETTINGS.free_log_odds], rtol=1e-3)
    for _ in range(40):
        draw_scan(slam_map, base_points(world, 0), world.truth[0], SENSOR)
    assert np.abs(slam_map.occupancy().log_odds).max() == pytest.approx(SETTINGS.clamp_log_odds, rel=1e-3)


def test_free_cells_are_those_of_the_slow_walk(world: Any) -> None:
    """The cells of every beam, walked one by one, less slivers beside beams that end in one cell."""
    slam_map = empty_map(world.grid.geometry, SETTINGS)
    points, pose = base_points(world, 50), world.truth[50]
    draw_scan(slam_map, points, pose, SENSOR)
    T = pose_from_xyt(pose)
    placed, sensor = points @ T[:2, :2].T + T[:2, 2], T[:2, :2] @ SENSOR + T[:2, 2]
    hits = {tuple(cell) for cell in world.grid.geometry.world_to_cell(placed)}
    free = {tuple(cell) for end in placed for cell in ray_cells(world.grid.geometry, sensor, end)} - hits
    drawn_free = {tuple(cell) for cell in np.argwhere((slam_map.evidence < 0) & (slam_map.evidence != NEVER_SEEN))}
    assert {tuple(cell) for cell in np.argwhere(slam_map.evidence > 0)} == hits
    assert drawn_free <= free
    assert len(free - drawn_free) < 0.05 * len(free)


def test_polygon_and_rays_agree_to_a_cell(world: Any, dense: Any) -> None:
    """Where beams lie closer than a cell, filling and walking find the same free space but for its edge."""
    points, pose = base_points(dense, 0), dense.truth[0]
    by_rays, by_polygon = (empty_map(world.grid.geometry, SETTINGS) for _ in range(2))
    draw_scan(by_rays, points, pose, SENSOR)
    draw_scan_by_polygon(by_polygon, points, pose, SENSOR)
    rays, polygon = ((m.evidence < 0) & (m.evidence != NEVER_SEEN) for m in (by_rays, by_polygon))
    touched = [(m.evidence != NEVER_SEEN) for m in (by_rays, by_polygon)]
    cross = np.ones((3, 3), dtype=bool)
    assert rays.sum() > 5000
    assert not (rays & ~binary_dilation(touched[1], cross)).any()
    assert not (polygon & ~binary_dilation(touched[0], cross)).any()
    assert (rays ^ polygon).sum() < 0.03 * rays.sum()
    np.testing.assert_array_equal(by_rays.evidence > 0, by_polygon.evidence > 0)


def test_distances_stay_right_while_obstacles_come_and_go(world: Any) -> None:
    slam_map = empty_map(world.grid.geometry, SETTINGS)
    rng = np.random.default_rng(4)
    for k in range(0, 240, 8):
        pose = world.truth[k] + rng.normal(0, [0.1, 0.1, 0.05])  # wrong poses draw walls that are cleared again
        draw = draw_scan if k % 16 else draw_scan_by_polygon
        draw(slam_map, base_points(world, k), pose, SENSOR)
    obstacles = slam_map.evidence > slam_map.steps[3]
    squared = np.rint(distance_transform_edt(~obstacles) ** 2)
    expected = np.where(squared <= slam_map.reach**2, squared, FAR)
    np.testing.assert_array_equal(slam_map.near, expected)


def test_field_scores_match_a_slow_sum(world: Any, drawn: SlamMap) -> None:
    particles, points = world.truth[[3, 90, 200]] + [0.05, 0.02, 0.01], base_points(world, 90)[::5]
    table = likelihood_table(drawn.reach, SETTINGS)
    scores = field_scores(particles, points, drawn.geometry.cells_from_map, drawn.evidence, drawn.near, table)
    for particle, score in zip(particles, scores, strict=True):
        T = pose_from_xyt(particle)
        cells = drawn.geometry.world_to_cell(points @ T[:2, :2].T + T[:2, 2])
        total = 0.0
        for row, column in cells:
            if not (0 <= row < drawn.near.shape[0] and 0 <= column < drawn.near.shape[1]):
                total += table[256]
            elif drawn.evidence[row, column] == NEVER_SEEN:
                total += max(table[256], table[drawn.near[row, column]])
            else:
                total += table[drawn.near[row, column]]
        assert score == pytest.approx(total)
    assert scores.argmax() == 1  # the particle near the scan's own pose


def test_window_scores_match_a_slow_search(world: Any, drawn: SlamMap) -> None:
    particles, points = world.truth[[20, 60, 200]] + [0.1, -0.05, 0.0], base_points(world, 60)[::4]
    scores = window_scores(particles, points, drawn.geometry.cells_from_map, drawn.near, 4)
    obstacles = np.pad(drawn.evidence > drawn.steps[3], 200)
    for particle, score in zip(particles, scores, strict=True):
        T = pose_from_xyt(particle)
        cells = drawn.geometry.world_to_cell(points @ T[:2, :2].T + T[:2, 2]) + 200
        slow = max(obstacles[cells[:, 0] + dy, cells[:, 1] + dx].sum() for dy in range(-4, 5) for dx in range(-4, 5))
        assert score == slow
    assert scores.argmax() == 1


def test_counts_match_a_slow_walk(world: Any, drawn: SlamMap) -> None:
    particles, points = world.truth[[20, 60]] + [0.05, 0.0, 0.02], base_points(world, 60)[::9]
    scores = count_scores(particles, points, SENSOR, drawn.geometry.cells_from_map, drawn.evidence, drawn.steps[3])
    for particle, score in zip(particles, scores, strict=True):
        T = pose_from_xyt(particle)
        sensor, slow = T[:2, :2] @ SENSOR + T[:2, 2], 0
        for end in points @ T[:2, :2].T + T[:2, 2]:
            cells = ray_cells(drawn.geometry, sensor, end)
            if not drawn.geometry.contains(cells).all():
                continue
            values = drawn.evidence[cells[:, 0], cells[:, 1]]
            slow += int(((values[:-1] < 0) & (values[:-1] != NEVER_SEEN)).sum() + (values[-1] > drawn.steps[3]))
        assert score == pytest.approx(slow, abs=3)  # the two round positions in other frames: cells at their edges


@pytest.mark.parametrize(
    ("weighting", "limit"), [("likelihood_field", 0.06), ("window_correlation", 0.35), ("cell_counts", 0.3)]
)
def test_maps_a_walk_better_than_odometry(world: Any, weighting: str, limit: float) -> None:
    settings = ParticleSlamSettings(weighting=weighting)  # type: ignore[arg-type]
    result = particle_slam(world.scans, world.odometry, settings, rng=np.random.default_rng(0))
    truth = pose_from_xyt(world.truth)
    error = SE2.between(truth[:1], truth)[:, :2, 2] - result.trajectory.poses[:, :2, 2]
    assert np.sqrt((error**2).sum(axis=1).mean()) < limit
    assert result.resamplings > 0
    assert result.occupancy.occupied.any()


def test_polygon_maps_as_well(world: Any) -> None:
    settings = ParticleSlamSettings(free_cells="polygon")
    result = particle_slam(world.scans, world.odometry, settings, rng=np.random.default_rng(0))
    truth = pose_from_xyt(world.truth)
    error = SE2.between(truth[:1], truth)[:, :2, 2] - result.trajectory.poses[:, :2, 2]
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.06


def test_same_seed_same_bytes(world: Any) -> None:
    results = [
        particle_slam(world.scans, world.odometry, SETTINGS, rng=np.random.default_rng(seed)) for seed in (1, 1, 2)
    ]
    assert results[0].trajectory.poses.tobytes() == results[1].trajectory.poses.tobytes()
    assert results[0].occupancy.log_odds.tobytes() == results[1].occupancy.log_odds.tobytes()
    assert results[0].trajectory.poses.tobytes() != results[2].trajectory.poses.tobytes()


def test_counts_that_do_not_fit_are_refused(world: Any) -> None:
    with pytest.raises(InputError, match="do not fit"):
        particle_slam(world.scans, world.odometry.select(np.arange(4)), SETTINGS, rng=np.random.default_rng(0))


def test_points_outside_the_grid_do_no_harm(world: Any) -> None:
    geometry = GridGeometry(origin_m=np.array([0.5, 0.5]), resolution_m=0.05, shape=(20, 20))
    for draw in (draw_scan, draw_scan_by_polygon):
        slam_map = empty_map(geometry, SETTINGS)
        draw(slam_map, base_points(world, 0), world.truth[0], SENSOR)
        assert slam_map.evidence.shape == (20, 20)
