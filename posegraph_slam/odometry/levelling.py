"""Laser scans of a tilting robot, cleared of itself, of ground and of ceiling, and seen again from a level scanner."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from posegraph_slam.arrays import BoolArray, Float32Array, FloatArray
from posegraph_slam.execution import split_range
from posegraph_slam.geometry import Trajectory, pose_from_rotation_translation
from posegraph_slam.odometry.spatial import SpatialOdometry
from posegraph_slam.sensors import LaserScans
from posegraph_slam.sensors.level_scans import LevelFan, level_ranges
from posegraph_slam.sensors.self_returns import SelfReturnSettings, find_self_returns
from posegraph_slam.settings import Settings

SCANS_A_CHUNK = 256
GROUND_SPACING_M = 0.1
"""Poses this far apart stand for the ground that was driven."""


class LevellingSettings(Settings):
    """Which returns of a tilting scanner count, and how they are levelled."""

    box_below_m: float = Field(default=0.35, gt=0)
    """Returns further than this below the scanner, once levelled, are ground;"""
    box_above_m: float = Field(default=1.2, gt=0)
    """further than this above it, ceiling."""
    ground_reach_m: float = Field(default=1.8, ge=0)
    """The ground that the robot drove on is known this far beside its path; 0: it is not looked at."""
    ground_way_m: float = Field(default=20.0, gt=0)
    """of what was driven this much before or after a scan, until the poses are optimised: odometry drifts;"""
    ground_height_m: float = Field(default=0.12, gt=0)
    """Returns no higher above that ground are ground: the ramp before a robot that still stands level, for example."""
    self_returns: SelfReturnSettings = SelfReturnSettings()
    """Returns from the robot itself."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelledScans:
    """Scans as a level scanner would see them, mounted at its own level frame, and what was left out."""

    scans: LaserScans
    remarks: tuple[str, ...]


def level_laser(
    scans: LaserScans, odometry: SpatialOdometry, settings: LevellingSettings, *, path: Trajectory | None = None
) -> LevelledScans:
    """Level scans (N, B) with roll and pitch, and drop the robot itself, ground and ceiling.

    The ground that was driven comes from odometry shortly before and after each scan, or from all of `path` (N, 4, 4),
    the optimised poses of the base. The result keeps the scanner's beams; its frame is gravity's, at the scanner, with
    x above the scanner's own x axis.
    """
    own = find_self_returns(scans.ranges_m, odometry.travel_m, settings.self_returns)
    poses = (odometry.trajectory if path is None else path).poses
    ranges = scans.ranges_m.copy()
    way_m = settings.ground_way_m if path is None else np.inf
    ground = _DrivenGround(poses, odometry, settings, way_m)
    counts = np.zeros(2, dtype=np.int64)
    for start, stop in split_range(len(scans), SCANS_A_CHUNK):
        part = slice(start, stop)
        chunk = ranges[part]
        robot = own.mask(chunk)
        on_ground = ground.hit(chunk, scans, part)
        counts += [robot.sum(), (on_ground & ~robot).sum()]
        chunk[robot | on_ground] = 0.0
    R = odometry.level_rotations
    level = level_ranges(
        ranges,
        scans.angles_rad,
        pose_from_rotation_translation(R, np.zeros((len(R), 3))),
        heights_m=(-settings.box_below_m, settings.box_above_m),
        limits_m=np.array([max(scans.range_min_m, 1e-6), scans.range_max_m]),
        fan=LevelFan(angle_min_rad=scans.angle_min_rad, increment_rad=scans.angle_increment_rad, count=scans.beams),
    )
    share = 100.0 / max(ranges.size, 1)
    remark = (
        f"of all beams {own.beams} see the robot itself; of all returns "
        f"{share * counts[0]:.1f} % are the robot, {share * (level.too_low + counts[1]):.1f} % ground and "
        f"{share * level.too_high:.1f} % ceiling: they are left out"
    )
    return LevelledScans(scans=replace(scans, ranges_m=level.ranges_m, T_base_lidar=np.eye(4)), remarks=(remark,))


class _DrivenGround:
    """The ground under the path as a plane at every 0.1 m of it, known a little to either side."""

    def __init__(self, poses: FloatArray, odometry: SpatialOdometry, settings: LevellingSettings, way_m: float) -> None:
        step = np.floor((odometry.travel_m - odometry.travel_m[0]) / GROUND_SPACING_M)
        chosen = np.concatenate([[True], np.diff(step) > 0])
        self.settings, self.poses, self.way_m = settings, poses, way_m
        self.ground, self.travel, self.ground_travel = poses[chosen], odometry.travel_m, odometry.travel_m[chosen]

    def hit(self, ranges: Float32Array, scans: LaserScans, part: slice) -> BoolArray:
        """Which ranges (n, B) of the scans in `part` end on the ground beside the path."""
        result = np.zeros(ranges.shape, dtype=np.bool_)
        reach, travel = self.settings.ground_reach_m, self.travel[part]
        first = np.searchsorted(self.ground_travel, travel[0] - self.way_m)
        last = np.searchsorted(self.ground_travel, travel[-1] + self.way_m, side="right")
        near = self.ground[first:last]
        if reach <= 0 or len(near) == 0:
            return result
        T = self.poses[part] @ scans.T_base_lidar
        rows, beams = np.nonzero((ranges >= scans.range_min_m) & (ranges < scans.range_max_m))
        r, angle = ranges[rows, beams].astype(np.float64), scans.angles_rad[beams]
        points = np.einsum("nij,nj->ni", T[rows, :3, :2], np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1))
        points += T[rows, :3, 3]
        low = np.flatnonzero(points[:, 2] < self._level_of_ground(near))
        rows, beams, points = rows[low], beams[low], points[low]
        distance, nearest = cKDTree(near[:, :2, 3]).query(points[:, :2], distance_upper_bound=reach)
        beside = np.flatnonzero(np.isfinite(distance))
        at = near[np.asarray(nearest)[beside]]
        above = np.sum((points[beside] - at[:, :3, 3]) * at[:, :3, 2], axis=1)
        low = above < self.settings.ground_height_m
        result[rows[beside[low]], beams[beside[low]]] = True
        return result

    def _level_of_ground(self, near: FloatArray) -> float:
        """Height above which nothing is on the planes of `near` (K, 4, 4): most points need no search for a plane."""
        up = near[:, :3, 2]
        aside = self.settings.ground_reach_m * float(np.hypot(up[:, 0], up[:, 1]).max())
        return float(near[:, 2, 3].max() + (self.settings.ground_height_m + aside) / up[:, 2].min())
