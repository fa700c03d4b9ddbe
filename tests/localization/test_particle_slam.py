"""Particle-filter SLAM: its map, its weights against slow sums, its accuracy and its determinism."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path as Polygon
from scipy.ndimage import binary_dilation, distance_transform_edt

from posegraph_slam.datasets import read
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.summary import evaluate_trajectory
from posegraph_slam.geometry import SE2, pose_from_xyt
from posegraph_slam.localization.cell_counts import (
    count_scores,
    free_before,
    one_a_cell,
    scan_outline,
    straightened,
)
from posegraph_slam.localization.free_space import draw_scan_by_polygon
from posegraph_slam.localization.particle_slam import particle_slam
from posegraph_slam.localization.slam_map import FAR, SlamMap, draw_scan, empty_map
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.localization.slam_weights import (
    field_scores,
    likelihood_table,
    log_weights,
    weighed_scan,
    window_scores,
)
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.raycast import NEVER_SEEN, ray_cells
from posegraph_slam.odometry.scan_odometry import odometry_at_scans

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


def test_counts_match_slow_ones_of_cells_inside(world: Any, drawn: SlamMap) -> None:
    """Returns in obstacles, and free cells whose centre lies inside the outline, tested one by one."""
    particles, points = world.truth[[20, 60]] + [0.05, 0.0, 0.02], base_points(world, 60)
    outline, returns = scan_outline(points, SENSOR, 0.05), one_a_cell(points, 0.05)
    scores = count_scores(
        particles, outline, returns, drawn.geometry.cells_from_map, drawn.near, free_before(drawn.evidence)
    )
    free = (drawn.evidence < 0) & (drawn.evidence != NEVER_SEEN)
    rows, columns = np.nonzero(free)
    for particle, score in zip(particles, scores, strict=True):
        T = pose_from_xyt(particle)
        centres = drawn.geometry.origin_m + 0.05 * np.column_stack([columns + 0.5, rows + 0.5])
        inside = Polygon(outline @ T[:2, :2].T + T[:2, 2]).contains_points(centres).sum()
        cells = drawn.geometry.world_to_cell(returns @ T[:2, :2].T + T[:2, 2])
        cells = cells[drawn.geometry.contains(cells)]
        hits = (drawn.evidence[cells[:, 0], cells[:, 1]] > drawn.steps[3]).sum()
        assert inside > 1000
        assert score == pytest.approx(inside + hits, abs=2)  # centres on an edge


def test_counts_are_those_of_the_filled_polygon(dense: Any, drawn: SlamMap) -> None:
    """The measure as reported: fill the polygon of the returns, take its edge away, compare both kinds of cells."""
    rng = np.random.default_rng(8)
    particles = dense.truth[0] + rng.normal(0, [0.1, 0.1, 0.05], (40, 3))
    points = base_points(dense, 0)
    settings = ParticleSlamSettings(weighting="cell_counts", correlation_power=1.0)
    counted = replace(drawn, free_before=free_before(drawn.evidence))
    weights = log_weights(counted, particles, weighed_scan(points, SENSOR, drawn.reach, settings), settings)
    reported = []
    for particle in particles:
        T = pose_from_xyt(particle)
        corners = drawn.geometry.world_to_cell(np.concatenate([SENSOR[None], points]) @ T[:2, :2].T + T[:2, 2])
        mask = np.zeros(drawn.evidence.shape, dtype=np.uint8)
        cv2.drawContours(mask, [corners[:, None, ::-1].astype(np.int32)], -1, 1, cv2.FILLED)
        mask[corners[1:, 0], corners[1:, 1]] = 2
        free = (drawn.evidence < 0) & (drawn.evidence != NEVER_SEEN)
        reported.append((free & (mask == 1)).sum() + ((drawn.evidence > drawn.steps[3]) & (mask == 2)).sum())
    counts = np.expm1(weights)
    # Filling rounds every corner to a cell, which moves the count by 0.25 % (1 sigma); particles differ by 1.1 %.
    np.testing.assert_allclose(counts, reported, rtol=0.03)
    assert np.std(counts / reported) < 0.004
    assert np.corrcoef(counts, reported)[0, 1] > 0.97


def test_free_cells_are_recounted_as_the_map_grows(world: Any) -> None:
    slam_map = empty_map(world.grid.geometry, ParticleSlamSettings(weighting="cell_counts"))
    for k in range(0, 240, 16):
        draw = draw_scan if k % 32 else draw_scan_by_polygon
        draw(slam_map, base_points(world, k), world.truth[k], SENSOR)
    free = (slam_map.evidence < 0) & (slam_map.evidence != NEVER_SEEN)
    np.testing.assert_array_equal(slam_map.free_before[:, 1:], np.cumsum(free, axis=1))


@given(st.integers(3, 60), st.floats(0.01, 0.3), st.integers(0, 10**6))
def test_a_straightened_outline_keeps_within_the_tolerance(corners: int, tolerance: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(-2.3, 2.3, corners))
    reach = np.repeat(rng.uniform(1, 6, corners), rng.integers(1, 4, corners))[:corners]
    outline = np.concatenate([[[0.0, 0.0]], reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    kept = straightened(outline, tolerance)
    positions = [int(np.flatnonzero((outline == corner).all(axis=1))[0]) for corner in kept]
    assert positions[0] == 0
    assert positions[-1] == corners
    assert positions == sorted(positions)
    for first, last in pairwise(positions):
        a, edge = outline[first], outline[last] - outline[first]
        for corner in outline[first + 1 : last]:
            part = np.clip((corner - a) @ edge / max(edge @ edge, 1e-12), 0, 1)
            assert np.linalg.norm(corner - a - part * edge) < 1.5 * tolerance + 1e-9


@pytest.mark.parametrize("weighting", ["likelihood_field", "window_correlation", "cell_counts"])
def test_heavy_particles_are_near_the_true_pose(world: Any, weighting: str) -> None:
    settings = ParticleSlamSettings(weighting=weighting)  # type: ignore[arg-type]
    slam_map = empty_map(world.grid.geometry, settings)
    for k in range(0, 240, 6):
        draw_scan(slam_map, base_points(world, k), world.truth[k], SENSOR)
    rng, shares = np.random.default_rng(9), []
    for k in range(45, 240, 30):
        particles = world.truth[k] + rng.normal(0, [0.3, 0.3, 0.05], (100, 3))
        scan = weighed_scan(base_points(world, k), SENSOR, slam_map.reach, settings)
        heavy = np.argsort(-log_weights(slam_map, particles, scan, settings))[:10]
        off = np.linalg.norm(particles[:, :2] - world.truth[k, :2], axis=1)
        shares.append(off[heavy].mean() / off.mean())
    assert np.mean(shares) < 0.6


@pytest.mark.data
@pytest.mark.parametrize("weighting", ["likelihood_field", "cell_counts"])
def test_maps_a_real_drive(psg_data: Path, weighting: str) -> None:
    log = read(psg_data / "ece276a" / "20")
    assert log.scans is not None
    assert log.truth is not None
    settings = ParticleSlamSettings(weighting=weighting)  # type: ignore[arg-type]
    odometry = odometry_at_scans(log).trajectory
    result = particle_slam(log.scans, odometry, settings, rng=np.random.default_rng(0))
    ape = evaluate_trajectory(result.trajectory, truth=log.truth).ape
    assert ape is not None
    assert ape.translation_m.rmse < 0.20


@pytest.mark.parametrize(("weighting", "limit"), [("likelihood_field", 0.06), ("window_correlation", 0.28)])
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
