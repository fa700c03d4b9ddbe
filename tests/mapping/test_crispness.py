"""Figures of map quality without truth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from posegraph_slam.geometry import Trajectory, pose_from_xyt
from posegraph_slam.mapping.crispness import crispness, entropy_bits, wall_area_m2
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid, build_occupancy
from posegraph_slam.sensors import LaserScans


def grid_of(log_odds) -> OccupancyGrid:
    log_odds = np.asarray(log_odds, dtype=np.float32)
    geometry = GridGeometry(origin_m=np.zeros(2), resolution_m=0.5, shape=log_odds.shape)
    return OccupancyGrid(geometry=geometry, log_odds=log_odds, observed=np.ones(log_odds.shape))


def room_seen_with_noise(sigma_m: float) -> OccupancyGrid:
    """A square room of 6 m, scanned 60 times from a path that is wrong by white noise."""
    rng = np.random.default_rng(1)
    angles = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    xy = np.column_stack([np.linspace(-1, 1, 60), np.zeros(60)])
    c, s = np.cos(angles), np.sin(angles)
    with np.errstate(divide="ignore"):
        ranges = np.minimum((3 - xy[:, :1] * np.sign(c)) / np.abs(c), 3 / np.abs(s))
    scans = LaserScans(
        stamps_s=np.arange(60.0), ranges_m=ranges, angle_min_rad=-np.pi, angle_increment_rad=2 * np.pi / 360,
        range_min_m=0.1, range_max_m=30, T_base_lidar=np.eye(4),
    )  # fmt: skip
    xyt = np.column_stack([xy + rng.normal(0, sigma_m, xy.shape), np.zeros(60)])
    return build_occupancy(
        scans, Trajectory(stamps_s=scans.stamps_s, poses=pose_from_xyt(xyt), parent="map", child="base")
    )


def test_entropy_of_known_probabilities():
    p = np.array([[0.5, 0.8, 0.2, 0.99]])
    expected = -(p * np.log2(p) + (1 - p) * np.log2(1 - p))
    assert entropy_bits(grid_of(np.log(p / (1 - p))).log_odds) == pytest.approx(expected, abs=1e-6)


def test_certain_map_is_crisp_and_far_cells_do_not_count():
    certain = np.full((1, 9), -40.0)
    certain[0, 4] = 40
    assert crispness(grid_of(certain)) == pytest.approx(1.0)
    certain[0, [0, 8]] = 0.0  # four cells away from the wall
    assert crispness(grid_of(certain)) == pytest.approx(1.0)
    certain[0, 6] = 0.0  # one of the five cells near the wall: one bit
    assert crispness(grid_of(certain)) == pytest.approx(0.8)
    assert crispness(grid_of(np.full((3, 3), -1.0))) == 0.0


def test_wall_area_counts_occupied_cells():
    assert wall_area_m2(grid_of([[math.log(4), -1.0, 0.0, 5.0]])) == pytest.approx(0.5)


def test_worse_paths_give_less_crisp_maps_with_more_wall():
    grids = [room_seen_with_noise(sigma) for sigma in (0.0, 0.03, 0.1)]
    figures = [crispness(grid) for grid in grids]
    assert figures[0] > 0.85
    assert figures[0] > figures[1] + 0.05
    assert figures[1] > figures[2] + 0.05
    assert wall_area_m2(grids[1]) > 1.2 * wall_area_m2(grids[0])
