"""From the plan view to space: level scans for the planar stages, and their graph lifted into SE(3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.geometry import SE3, Trajectory, inverse_pose
from posegraph_slam.odometry.levelling import LevellingSettings
from posegraph_slam.odometry.spatial import SpatialOdometry, SpatialOdometrySettings
from posegraph_slam.odometry.wheel_calibration import WheelCalibrationSettings
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.settings import Settings

FREE_INFORMATION = 1e-4
"""Of a direction that a constraint leaves free: one sigma of 100 m or rad, and still invertible."""
UNEVEN = 0.05
"""Rise over distance by which a ground differs from the plane that two poses on it span."""
NEAREST_PLACES = 24
"""Keyframes around one among which the place is sought that the robot passed before."""


class SpatialSettings(Settings):
    """Poses in space: used with `pose_graph.group = "se3"`."""

    odometry: SpatialOdometrySettings = SpatialOdometrySettings()
    levelling: LevellingSettings = LevellingSettings()
    wheels: WheelCalibrationSettings = WheelCalibrationSettings()
    search: bool = False
    """Whether scan matching searches a window where few points match. On a ramp little but the side walls is left,
    along which a scan slides, and wheels and gyro know each step better; wheels that slip for metres need it."""
    tilt_sigma_min_rad: float = Field(default=0.004, gt=0)
    """Roll and pitch of a keyframe are not known better than this, whatever the filter says."""
    same_ground_m: float = Field(default=0.6, ge=0)
    """Keyframes this near in the plan view stand on one and the same ground; 0: this is not used."""
    same_ground_sigma_m: float = Field(default=0.02, gt=0)
    """To within this, and a twentieth of their distance."""
    level_gap_m: float = Field(default=0.5, gt=0)
    """Places whose heights differ by more than this, beyond their sigma, are on two levels: no loop joins them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Heights:
    """Height (K,) of the base at keyframes and the way driven (K,), for telling one level from another."""

    height_m: FloatArray
    travel_m: FloatArray
    settings: SpatialSettings

    @staticmethod
    def of(odometry: SpatialOdometry, keyframes: IntArray, settings: SpatialSettings) -> Heights:
        """Take them from the odometry."""
        return Heights(
            height_m=odometry.trajectory.poses[keyframes, 2, 3],
            travel_m=odometry.travel_m[keyframes],
            settings=settings,
        )

    def sigma(self, i: IntArray, j: IntArray) -> FloatArray:
        """Sigma (M,) of the difference in height between keyframes i and j (M,)."""
        noise, way = self.settings.odometry, np.abs(self.travel_m[j] - self.travel_m[i])
        return np.hypot(noise.height_per_sqrt_m * np.sqrt(way), noise.height_per_m * way)

    def apart(self, i: IntArray, j: IntArray, distance_m: FloatArray) -> BoolArray:
        """Which pairs (M,) are on two levels: further apart in height than drift, and a ramp of 25 degrees, explain."""
        gap = np.abs(self.height_m[j] - self.height_m[i])
        allowed = np.maximum(self.settings.level_gap_m, np.tan(np.radians(25.0)) * distance_m)
        return np.asarray(gap > allowed + 3 * self.sigma(i, j))


def lift_graph(graph: PoseGraph, odometry: SpatialOdometry, settings: SpatialSettings) -> PoseGraph:
    """Turn a graph of level lidar poses in the plane into one of base poses in space, with the same nodes.

    Planar constraints keep their x, y and heading; heights between neighbours come from the odometry, roll and pitch of
    each node from the attitude, relative to the first node, which is fixed. Keyframes at one place stand on one ground.
    """
    keyframes = graph.index
    heights = Heights.of(odometry, keyframes, settings)
    plan = Trajectory(stamps_s=odometry.trajectory.stamps_s[keyframes], poses=graph.poses, parent="odom", child="base")
    lidar_height = odometry.lidar_poses[keyframes, 2, 3]
    tilted = _Lift(R=odometry.level_rotations[keyframes], T_lidar_base=inverse_pose(odometry.T_base_lidar))
    poses = tilted.base(plan.poses, lidar_height, np.arange(len(graph)))
    parts = [
        _lifted_constraints(graph.constraints, tilted, lidar_height, heights),
        _attitudes(poses, np.maximum(odometry.tilt_sigma_rad[keyframes], settings.tilt_sigma_min_rad)),
        _one_ground(poses, tilted, heights),
    ]
    return PoseGraph(
        poses=poses,
        session=graph.session,
        index=graph.index,
        fixed=graph.fixed,
        constraints=Constraints.concatenate(parts),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Lift:
    """Rotations (K, 3, 3) from scanner to level frame at each node, and the base as the scanner sees it (4, 4)."""

    R: FloatArray
    T_lidar_base: FloatArray

    def from_level(self, rows: IntArray) -> FloatArray:
        """T_level_base (M, 4, 4) of the nodes at `rows`."""
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        T[:, :3, :3] = self.R[rows]
        return T @ self.T_lidar_base

    def base(self, planar: FloatArray, height_m: FloatArray, rows: IntArray) -> FloatArray:
        """Poses (M, 4, 4) of the base at nodes `rows` from planar poses (M, 3, 3) of the level lidar frame."""
        return _raised(planar, height_m) @ self.from_level(rows)


def _raised(planar: FloatArray, height_m: FloatArray) -> FloatArray:
    """Level poses (M, 4, 4) from planar ones (M, 3, 3) and heights (M,)."""
    T = np.zeros((len(planar), 4, 4))
    T[:, :2, :2], T[:, :2, 3], T[:, 2, 3] = planar[:, :2, :2], planar[:, :2, 2], height_m
    T[:, 2, 2] = T[:, 3, 3] = 1.0
    return T


def _lifted_constraints(c: Constraints, lift: _Lift, lidar_height: FloatArray, heights: Heights) -> Constraints:
    """Constraints of the plan view between base poses; loops say nothing of heights and tilts, neighbours do."""
    level = _raised(c.T_i_j, lidar_height[c.j] - lidar_height[c.i])
    information = np.zeros((len(c), 6, 6))
    into = np.array([3, 4, 2])  # x, y and heading among [rotation, translation]
    information[:, into[:, None], into[None, :]] = c.information
    information[:, 0, 0] = information[:, 1, 1] = FREE_INFORMATION
    steps = np.abs(heights.travel_m[c.j] - heights.travel_m[c.i])
    variance = heights.settings.odometry.height_per_sqrt_m**2 * steps + 0.002**2
    information[:, 5, 5] = np.where(c.is_loop, FREE_INFORMATION, 1.0 / variance)
    return _between_bases(c.i, c.j, level, information, lift, c.kind)


def _between_bases(
    i: IntArray, j: IntArray, level: FloatArray, information: FloatArray, lift: _Lift, kind: IntArray
) -> Constraints:
    """Move level relative poses (M, 4, 4) with their information (M, 6, 6) to the bases."""
    T_level_base = lift.from_level(j)
    adjoint = SE3.adjoint(T_level_base)
    moved = np.swapaxes(adjoint, 1, 2) @ information @ adjoint
    return Constraints(
        i=i,
        j=j,
        T_i_j=inverse_pose(lift.from_level(i)) @ level @ T_level_base,
        information=0.5 * (moved + np.swapaxes(moved, 1, 2)),
        kind=kind,
    )


def _attitudes(poses: FloatArray, sigma_rad: FloatArray) -> Constraints:
    """Tie each node to the fixed first one by its roll and pitch alone: turns about the vertical are left free."""
    count = len(poses)
    up = poses[1:, 2, :3]  # the vertical in the body
    information = np.tile(FREE_INFORMATION * np.eye(6), (count - 1, 1, 1))
    level = np.eye(3) - up[:, :, None] * up[:, None, :]
    information[:, :3, :3] += level / sigma_rad[1:, None, None] ** 2
    first = np.zeros(count - 1, dtype=np.int64)
    return Constraints(
        i=first,
        j=np.arange(1, count),
        T_i_j=SE3.between(poses[first], poses[1:]),
        information=information,
        kind=np.full(count - 1, int(ConstraintKind.ATTITUDE)),
    )


def _one_ground(poses: FloatArray, lift: _Lift, heights: Heights) -> Constraints:
    """Give each keyframe the height of the nearest one at which the robot was before, on the mean of both slopes."""
    settings, pairs = heights.settings, _same_places(poses, heights)
    i, j = pairs[:, 0], pairs[:, 1]
    step = poses[j, :2, 3] - poses[i, :2, 3]
    slope = -poses[:, :2, 2] / poses[:, 2:3, 2]
    rise = np.sum(0.5 * (slope[i] + slope[j]) * step, axis=1)
    bend = 0.5 * np.abs(np.sum((slope[j] - slope[i]) * step, axis=1))
    T_level_base_i, T_level_base_j = lift.from_level(i), lift.from_level(j)
    T_map_level = poses @ inverse_pose(lift.from_level(np.arange(len(poses))))
    level = SE3.between(T_map_level[i], T_map_level[j])
    # equal grounds: the bases differ by the rise, the scanners by what their tilts add
    level[:, 2, 3] = rise + T_level_base_i[:, 2, 3] - T_level_base_j[:, 2, 3]
    information = np.tile(FREE_INFORMATION * np.eye(6), (len(pairs), 1, 1))
    uneven = UNEVEN * np.linalg.norm(step, axis=1)
    information[:, 5, 5] = 1.0 / (settings.same_ground_sigma_m**2 + uneven**2 + bend**2)
    return _between_bases(i, j, level, information, lift, np.full(len(pairs), int(ConstraintKind.SAME_GROUND)))


def _same_places(poses: FloatArray, heights: Heights) -> IntArray:
    """Pairs (M, 2): each keyframe with the nearest earlier one, driven to by a detour, on the same level."""
    count, settings = len(poses), heights.settings
    if settings.same_ground_m <= 0 or count < 2:
        return np.zeros((0, 2), dtype=np.int64)
    tree, k = cKDTree(poses[:, :2, 3]), min(NEAREST_PLACES, count)
    distance, near = tree.query(poses[:, :2, 3], k=k, distance_upper_bound=settings.same_ground_m)
    rows = np.repeat(np.arange(count), k).reshape(count, k)
    known = np.isfinite(distance)
    near = np.where(known, near, 0)
    detour = np.abs(heights.travel_m[rows] - heights.travel_m[near]) > 10 * settings.same_ground_m
    usable = known & (near < rows) & detour & ~heights.apart(near, rows, np.where(known, distance, 0.0))
    best = np.argmin(np.where(usable, distance, np.inf), axis=1)
    j = np.flatnonzero(usable.any(axis=1))
    return np.stack([near[j, best[j]], j], axis=1)
