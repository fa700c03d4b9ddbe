"""A map for each particle: the same cells as a map drawn by itself, shared until they differ."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from posegraph_slam.localization.particle_maps import BLANK, TILE, ParticleMaps
from posegraph_slam.localization.particle_slam import particle_slam
from posegraph_slam.localization.shared_map import SharedMap
from posegraph_slam.localization.slam_map import draw_scan, empty_map
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.mapping.occupancy import OccupancyGrid

SENSOR = np.array([0.1, 0.0])
FEW = ParticleSlamSettings(maps="per_particle", particles=6)


def points_of(world: Any, k: int) -> np.ndarray:
    return world.scans.points(k) + SENSOR


def scattered(pose: np.ndarray, count: int, seed: int) -> np.ndarray:
    return pose + np.random.default_rng(seed).normal(0, [0.05, 0.05, 0.02], (count, 3))


def cells(grid: OccupancyGrid, rows: int, columns: int) -> tuple[bytes, bytes]:
    return grid.log_odds[:rows, :columns].tobytes(), grid.observed[:rows, :columns].tobytes()


def in_use(maps: ParticleMaps) -> int:
    """Tiles that the tables name, the blank one left out."""
    return len(np.setdiff1d(maps.table, [BLANK]))


@pytest.fixture
def drawn(world: Any) -> ParticleMaps:
    """Six particles that have each drawn a dozen scans at poses of their own."""
    maps, weights = ParticleMaps(world.grid.geometry, FEW), np.zeros(6)
    for k in range(0, 240, 20):
        weights = maps.observe(scattered(world.truth[k], 6, k), weights, points_of(world, k), SENSOR)
    return maps


def test_each_map_is_what_its_particle_would_draw_alone(world: Any, drawn: ParticleMaps) -> None:
    rows, columns = world.grid.geometry.shape
    for particle in (0, 3, 5):
        alone = empty_map(world.grid.geometry, FEW)
        for k in range(0, 240, 20):
            draw_scan(alone, points_of(world, k), scattered(world.truth[k], 6, k)[particle], SENSOR)
        assert cells(drawn.occupancy(particle), rows, columns) == cells(alone.occupancy(), rows, columns)
    assert cells(drawn.occupancy(0), rows, columns) != cells(drawn.occupancy(3), rows, columns)


@pytest.mark.parametrize("weighting", ["likelihood_field", "window_correlation", "cell_counts"])
def test_particles_of_one_past_are_weighed_as_with_one_map(world: Any, weighting: str) -> None:
    settings = FEW.model_copy(update={"weighting": weighting})
    own, shared = ParticleMaps(world.grid.geometry, settings), SharedMap(world.grid.geometry, settings)
    for k in range(0, 80, 10):
        same = np.tile(world.truth[k], (6, 1))
        for maps in (own, shared):
            maps.observe(same, np.zeros(6), points_of(world, k), SENSOR)
    particles = scattered(world.truth[75], 6, 1)
    weights = [maps.observe(particles, np.zeros(6), points_of(world, 75), SENSOR) for maps in (own, shared)]
    np.testing.assert_allclose(weights[0], weights[1], atol=1e-9)
    assert np.ptp(weights[0]) > 0.01


def test_resampling_shares_tiles_and_drawing_parts_them(world: Any, drawn: ParticleMaps) -> None:
    rows, columns = world.grid.geometry.shape
    before = drawn.tiles_used
    drawn.resample(np.array([2, 2, 2, 2, 4, 4]))
    shared = drawn.tiles_used
    assert shared == in_use(drawn)
    assert shared < 0.5 * before
    first, last = cells(drawn.occupancy(0), rows, columns), cells(drawn.occupancy(5), rows, columns)
    # The robot looks at a corner from close by: only tiles in view are drawn on, by one particle at a time.
    particles = np.tile(world.truth[0], (6, 1))
    drawn.observe(particles, np.zeros(6), points_of(world, 0)[:20], SENSOR)
    assert shared < drawn.tiles_used < shared + 6 * 40
    assert cells(drawn.occupancy(0), rows, columns) != first
    assert cells(drawn.occupancy(5), rows, columns) != last
    assert drawn.tiles_used == in_use(drawn)


def test_memory_grows_with_the_differences(world: Any) -> None:
    """A hundred particles of one ancestor take little more than one of them, and far less than a hundred maps."""
    settings = ParticleSlamSettings(maps="per_particle", particles=100)
    maps, weights = ParticleMaps(world.grid.geometry, settings), np.zeros(100)
    for k in range(0, 120, 30):
        weights = maps.observe(scattered(world.truth[k], 100, k), weights, points_of(world, k), SENSOR)
    whole = maps.tiles_used
    maps.resample(np.zeros(100, dtype=np.int64))
    assert maps.tiles_used < 0.02 * whole
    held = maps.bytes_used
    maps.observe(np.tile(world.truth[0], (100, 1)), np.zeros(100), points_of(world, 0)[:20], SENSOR)
    assert maps.bytes_used == in_use(maps) * TILE * TILE * 5 + maps.table.nbytes
    assert held < maps.bytes_used < 0.25 * maps.peak_bytes


def test_a_loop_is_mapped_no_worse_than_with_one_map(rings: Any) -> None:
    errors: dict[str, list[float]] = {"best": [], "per_particle": []}
    for seed, (scans, odometry, truth) in enumerate(rings):
        for maps, found in errors.items():
            settings = ParticleSlamSettings(maps=maps, particles=40)  # type: ignore[arg-type]
            result = particle_slam(scans, odometry, settings, rng=np.random.default_rng(seed))
            difference = (result.trajectory.poses - truth)[:, :2, 2]
            found.append(float(np.sqrt((difference**2).sum(axis=1).mean())))
            assert result.occupancy.occupied.any()
            assert result.map_bytes > 0
    assert np.mean(errors["per_particle"]) < np.mean(errors["best"])


def test_same_seed_same_bytes(world: Any) -> None:
    part = np.arange(60)
    runs = [
        particle_slam(world.scans.select(part), world.odometry.select(part), FEW, rng=np.random.default_rng(seed))
        for seed in (1, 1, 2)
    ]
    assert runs[0].trajectory.poses.tobytes() == runs[1].trajectory.poses.tobytes()
    assert runs[0].occupancy.log_odds.tobytes() == runs[1].occupancy.log_odds.tobytes()
    assert runs[0].trajectory.poses.tobytes() != runs[2].trajectory.poses.tobytes()


def test_maps_of_particles_are_drawn_by_rays_only() -> None:
    with pytest.raises(ValueError, match="need free_cells rays"):
        ParticleSlamSettings(maps="per_particle", free_cells="polygon")
