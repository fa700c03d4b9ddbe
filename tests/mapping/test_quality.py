"""Quality of maps without truth: thick, doubled and blurred walls are told from clean ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from posegraph_slam.datasets import read
from posegraph_slam.geometry import Trajectory, pose_from_xyt
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid, build_occupancy
from posegraph_slam.mapping.quality import MapQuality, map_quality, walls
from posegraph_slam.sensors import LaserScans

CELL_M = 0.05
CERTAIN = 4 * np.log(4)


def grid_of(log_odds: np.ndarray, observed: np.ndarray | None = None) -> OccupancyGrid:
    seen = np.ones(log_odds.shape, dtype=bool) if observed is None else observed
    geometry = GridGeometry(origin_m=np.zeros(2), resolution_m=CELL_M, shape=log_odds.shape)
    return OccupancyGrid(geometry=geometry, log_odds=log_odds, observed=seen)


def room(thickness: int = 1) -> np.ndarray:
    """Log-odds of a square room whose walls are some cells thick."""
    log_odds = np.full((80, 80), -CERTAIN)
    inner = slice(10 + thickness, 70 - thickness)
    log_odds[10:70, 10:70] = CERTAIN
    log_odds[inner, inner] = -CERTAIN
    return log_odds


@pytest.mark.parametrize("thickness", [1, 2, 4])
def test_thickness_is_that_of_the_walls(thickness: int) -> None:
    quality = map_quality(grid_of(room(thickness)))
    # a corner's diagonal is longer than the wall is thick, by less than the cells of four corners
    assert quality.wall_thickness_m == pytest.approx(thickness * CELL_M, rel=0.02)
    assert quality.double_walls == 0


def test_walls_at_45_degrees_are_as_thick_as_they_are() -> None:
    row, column = np.indices((60, 60))
    occupied = np.abs(row - column) <= 2  # five cells on the diagonal's normal, 2.5 of its steps to either side
    thickness, doubled = walls(occupied, ~occupied, CELL_M)
    assert np.median(thickness) == pytest.approx(3 * np.sqrt(2) * CELL_M, rel=0.2)
    assert not doubled.any()


def test_a_wall_drawn_twice_is_found_only_across_what_was_seen_free() -> None:
    log_odds = np.full((60, 60), -CERTAIN)
    log_odds[5:55, 20] = log_odds[5:55, 26] = CERTAIN
    assert map_quality(grid_of(log_odds)).double_walls == 1.0
    unseen = np.ones(log_odds.shape, dtype=bool)
    unseen[:, 21:26] = False  # the inside of a thick wall
    assert map_quality(grid_of(np.where(unseen, log_odds, 0), unseen)).double_walls == 0.0
    far = np.full((60, 60), -CERTAIN)
    far[5:55, 20] = far[5:55, 32] = CERTAIN
    assert map_quality(grid_of(far)).double_walls == 0.0
    crossing = np.full((60, 60), -CERTAIN)
    crossing[5:55, 20] = crossing[30, 26:50] = CERTAIN
    assert map_quality(grid_of(crossing)).double_walls == 0.0


def test_a_blurred_or_doubled_map_ranks_worse() -> None:
    clean = map_quality(grid_of(room()))
    blurred = map_quality(grid_of(ndimage.gaussian_filter(room(2), 1.5)))
    shifted = np.maximum(room(), np.roll(room(), (4, 4), axis=(0, 1)))
    doubled = map_quality(grid_of(shifted))
    assert blurred.crispness < clean.crispness
    assert blurred.entropy_bits > clean.entropy_bits
    assert doubled.double_walls > 0.7 > clean.double_walls
    assert doubled.wall_area_m2 > 1.8 * clean.wall_area_m2


def test_a_map_without_walls_has_none() -> None:
    nothing = map_quality(grid_of(np.zeros((5, 5)), np.zeros((5, 5), dtype=bool)))
    assert nothing == MapQuality(
        crispness=0.0, entropy_bits=1.0, wall_thickness_m=0.0, double_walls=0.0, wall_area_m2=0.0
    )


def scans_in_a_hall(xyt: np.ndarray) -> LaserScans:
    """Ranges to the walls, amid their cells, of a hall of about 8 x 6 m centred at the origin, from each pose."""
    angles = np.linspace(-np.pi, np.pi, 361)
    bearing = xyt[:, 2:] + angles
    c, s = np.cos(bearing), np.sin(bearing)
    with np.errstate(divide="ignore"):
        ranges = np.minimum(
            np.where(c > 0, (4.025 - xyt[:, :1]) / c, (-4.025 - xyt[:, :1]) / c),
            np.where(s > 0, (3.025 - xyt[:, 1:2]) / s, (-3.025 - xyt[:, 1:2]) / s),
        )
    return LaserScans(
        stamps_s=np.arange(len(xyt), dtype=float), ranges_m=ranges.astype(np.float32), angle_min_rad=-np.pi,
        angle_increment_rad=float(angles[1] - angles[0]), range_min_m=0.1, range_max_m=30.0, T_base_lidar=np.eye(4),
    )  # fmt: skip


def test_a_path_that_drifts_between_two_rounds_draws_the_hall_twice() -> None:
    turn = np.linspace(0, 4 * np.pi, 120)
    xyt = np.stack([1.5 * np.cos(turn), np.sin(turn), turn], axis=1)
    scans = scans_in_a_hall(xyt)
    found = []
    for drift_m in (0.0, 0.15, 0.3):
        moved = xyt + np.array([drift_m, drift_m, 0]) * (turn > 2 * np.pi)[:, None]
        path = Trajectory(stamps_s=scans.stamps_s, poses=pose_from_xyt(moved), parent="map", child="base")
        found.append(map_quality(build_occupancy(scans, path)))
    assert found[0].double_walls < 0.02
    assert min(found[1].double_walls, found[2].double_walls) > 0.2
    assert found[0].entropy_bits < found[1].entropy_bits
    assert found[0].crispness > found[1].crispness
    assert found[0].wall_area_m2 < found[1].wall_area_m2


@pytest.mark.data
def test_a_real_robots_odometry_draws_more_walls_twice_than_its_true_path(psg_data: Path) -> None:
    from posegraph_slam.geometry import interpolate
    from posegraph_slam.odometry.scan_odometry import odometry_at_scans

    log = read(psg_data / "ece276a" / "20")
    assert log.scans is not None
    assert log.truth is not None
    every = np.arange(0, len(log.scans), 4)
    scans = log.scans.select(every)
    odometry = odometry_at_scans(log).trajectory.select(every)
    worse = map_quality(build_occupancy(scans, odometry))
    better = map_quality(build_occupancy(scans, interpolate(log.truth, scans.stamps_s)))
    assert worse.double_walls > 2 * better.double_walls
    assert worse.crispness < better.crispness
    assert worse.entropy_bits > better.entropy_bits
