"""A small world with its map, and scans of a walk through it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from posegraph_slam.geometry import SE2, Trajectory, pose_from_xyt
from posegraph_slam.localization.motion import step_sigmas
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.sensors import LaserScans

WALLS = np.array([
    [0, 0, 14, 0], [14, 0, 14, 9], [14, 9, 0, 9], [0, 9, 0, 0], [4, 0, 4, 3.5], [4, 5.2, 4, 9], [9, 9, 9, 6],
    [6, 2, 7, 2], [7, 2, 7, 3], [7, 3, 6, 3], [6, 3, 6, 2], [10, 3, 12, 3], [12, 3, 12, 3.6], [1, 7, 2.2, 7],
], dtype=float)  # fmt: skip
"""Rooms without symmetry: walls (W, 4) [x0, y0, x1, y1]."""


@dataclass(frozen=True)
class World:
    grid: OccupancyGrid
    scans: LaserScans
    truth: np.ndarray
    odometry: Trajectory


def cast(poses: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Ranges (N, B) from planar poses (N, 3)."""
    bearing = poses[:, 2:3] + angles
    dx, dy = np.cos(bearing), np.sin(bearing)
    ranges = np.full(bearing.shape, 60.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        for x0, y0, x1, y1 in WALLS:
            ex, ey, wx, wy = x1 - x0, y1 - y0, x0 - poses[:, :1], y0 - poses[:, 1:2]
            cross = dx * ey - dy * ex
            along, part = (wx * ey - wy * ex) / cross, (wx * dy - wy * dx) / cross
            ranges = np.where((along > 0) & (part >= 0) & (part <= 1) & (along < ranges), along, ranges)
    return ranges


def drawn_map(resolution: float = 0.05, yaw: float = 0.0) -> OccupancyGrid:
    """The world's map: walls occupied, the rest of the hall free, unknown outside; the grid turned by `yaw`."""
    margin = 1.0
    c, s = np.cos(yaw), np.sin(yaw)
    corner = np.array([[c, -s], [s, c]]) @ np.array([-margin, -margin])
    shape = (int((9 + 2 * margin) / resolution), int((14 + 2 * margin) / resolution))
    cells = np.indices(shape).reshape(2, -1).T
    x, y = ((cells[:, ::-1] + 0.5) * resolution - margin).T
    log_odds = np.where((x > 0) & (x < 14) & (y > 0) & (y < 9), -5.0, 0.0)
    for x0, y0, x1, y1 in WALLS:
        e = np.array([x1 - x0, y1 - y0])
        part = np.clip(((x - x0) * e[0] + (y - y0) * e[1]) / (e @ e), 0, 1)
        log_odds[np.maximum(abs(x - x0 - part * e[0]), abs(y - y0 - part * e[1])) < 0.6 * resolution] = 5.0
    values = log_odds.reshape(shape)
    geometry = GridGeometry(origin_m=corner, resolution_m=resolution, shape=shape, yaw_rad=yaw)
    return OccupancyGrid(geometry=geometry, log_odds=values, observed=values != 0)


def walk(count: int) -> np.ndarray:
    """Poses (N, 3) of a walk from room to room, 0.1 m or so a step."""
    corners = np.array([
        [1, 1.2], [2.5, 4.3], [5.2, 4.3], [8, 4.6], [8, 7.5], [5.5, 7.5], [5.2, 4.3], [5.2, 1.2], [8.3, 1.2],
        [12.5, 1.5], [13, 5], [10.5, 5],
    ])  # fmt: skip
    leg = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    s = np.linspace(0.3, leg[-1] - 0.3, count)
    smooth = [
        np.mean([np.interp(s + d, leg, corners[:, k]) for d in np.linspace(-0.3, 0.3, 9)], axis=0) for k in (0, 1)
    ]
    heading = np.unwrap(np.arctan2(np.gradient(smooth[1]), np.gradient(smooth[0])))
    return np.stack([*smooth, heading], axis=1)


def make_scans(poses: np.ndarray, rng: np.random.Generator, beams: int = 180) -> LaserScans:
    """Scans over 270 degrees with 1 cm of noise, the laser 0.1 m ahead of the base."""
    angles = np.linspace(-0.75 * np.pi, 0.75 * np.pi, beams)
    mounted = poses.copy()
    mounted[:, :2] += 0.1 * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    ranges = cast(mounted, angles) + 0.01 * rng.standard_normal((len(poses), beams))
    T = np.eye(4)
    T[0, 3] = 0.1
    return LaserScans(
        stamps_s=100.0 + 0.2 * np.arange(len(poses)), ranges_m=ranges.astype(np.float32), angle_min_rad=angles[0],
        angle_increment_rad=angles[1] - angles[0], range_min_m=0.1, range_max_m=30.0, T_base_lidar=T,
    )  # fmt: skip


def make_odometry(poses: np.ndarray, rng: np.random.Generator, stamps: np.ndarray) -> Trajectory:
    """Odometry that starts at the origin and errs by about 2 % of each step."""
    steps = SE2.log(SE2.between(pose_from_xyt(poses[:-1]), pose_from_xyt(poses[1:])))
    steps = steps * (1 + 0.02 * rng.standard_normal(steps.shape))
    chained = [np.eye(3)]
    for step in SE2.exp(steps):
        chained.append(chained[-1] @ step)
    return Trajectory(stamps_s=stamps, poses=np.array(chained), parent="odom", child="base")


@pytest.fixture(scope="session")
def world() -> World:
    rng = np.random.default_rng(5)
    truth = walk(240)
    scans = make_scans(truth, rng)
    return World(grid=drawn_map(), scans=scans, truth=truth, odometry=make_odometry(truth, rng, scans.stamps_s))


@pytest.fixture(scope="session")
def turned_map() -> OccupancyGrid:
    return drawn_map(yaw=0.6)


@pytest.fixture(scope="session")
def kidnapped() -> World:
    """The walk with its middle cut out: the robot is carried 6 m, and its odometry does not know."""
    rng = np.random.default_rng(6)
    whole = walk(300)
    parts = [whole[:90], whole[215:]]
    truth = np.concatenate(parts)
    scans = make_scans(truth, rng)
    first = make_odometry(parts[0], rng, scans.stamps_s[:90]).poses
    second = make_odometry(parts[1], rng, scans.stamps_s[90:]).poses
    poses = np.concatenate([first, first[-1] @ second])
    return World(
        grid=drawn_map(), scans=scans, truth=truth,
        odometry=Trajectory(stamps_s=scans.stamps_s, poses=poses, parent="odom", child="base"),
    )  # fmt: skip


@pytest.fixture(scope="session")
def dense() -> World:
    """One scan whose beams lie less than a cell apart."""
    rng = np.random.default_rng(7)
    truth = walk(240)[30:32]
    scans = make_scans(truth, rng, beams=1081)
    return World(grid=drawn_map(), scans=scans, truth=truth, odometry=make_odometry(truth, rng, scans.stamps_s))


def ring(rng: np.random.Generator, count: int) -> tuple[LaserScans, Trajectory, np.ndarray]:
    """A round trip about the pillar with a laser that sees 3 m, so that drift shows where the loop closes.

    The odometry errs as the filter's own noise says.
    """
    corners = np.array([
        [5, 1], [8.3, 1], [9.6, 2.5], [12.9, 2.3], [13, 5.2], [9.5, 5.2], [8, 7.5], [5.3, 7.6], [5, 4.4], [5, 1],
        [8.3, 1],
    ])  # fmt: skip
    leg = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    s = np.linspace(0.3, leg[-1] - 0.3, count)
    x, y = (np.mean([np.interp(s + d, leg, corners[:, k]) for d in np.linspace(-0.3, 0.3, 9)], axis=0) for k in (0, 1))
    truth = np.stack([x, y, np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))], axis=1)
    scans = make_scans(truth, rng)
    scans = replace(scans, ranges_m=np.where(scans.ranges_m > 3, np.float32(60), scans.ranges_m))
    steps = SE2.log(SE2.between(pose_from_xyt(truth[:-1]), pose_from_xyt(truth[1:])))
    sigma = step_sigmas(steps, ParticleSlamSettings().noise)
    steps = steps + sigma[:, [0, 0, 1]] * rng.standard_normal(steps.shape)
    poses = [np.eye(3)]
    for step in SE2.exp(steps):
        poses.append(poses[-1] @ step)
    odometry = Trajectory(stamps_s=scans.stamps_s, poses=np.array(poses), parent="odom", child="base")
    return scans, odometry, SE2.between(pose_from_xyt(truth[:1]), pose_from_xyt(truth))


@pytest.fixture(scope="session")
def rings() -> list[tuple[LaserScans, Trajectory, np.ndarray]]:
    """Two round trips: scans, odometry, and true poses relative to the first."""
    return [ring(np.random.default_rng(seed), 200) for seed in (10, 11)]
