"""Odometry in space of a wheeled robot with an IMU: plan view, height and tilt at every laser scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import (
    SE2,
    SO3,
    Trajectory,
    inverse_pose,
    planar_from_spatial,
    pose_from_rotation_translation,
    xyt_from_pose,
)
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.scan_odometry import resample_at_scans
from posegraph_slam.odometry.settings import OdometrySettings
from posegraph_slam.odometry.tilt import Tilt, TiltSettings, estimate_tilt, without_heading
from posegraph_slam.odometry.wheel_imu import wheel_imu_odometry
from posegraph_slam.sensors import LaserScans, RobotLog
from posegraph_slam.settings import Settings


class SpatialOdometrySettings(Settings):
    """Noise of heights, beside that of the tilt."""

    tilt: TiltSettings = TiltSettings()
    height_per_sqrt_m: float = Field(default=0.03, gt=0)
    """m of height sigma after driving 1 m: tilt errors that come and go,"""
    height_per_m: float = Field(default=0.005, ge=0)
    """and the share of the way by which heights drift, from a tilt that is wrong for long."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpatialOdometry:
    """Where a wheeled robot drove, in space, at every scan.

    `trajectory` T_odom_base (N, 4, 4), in the order of the scans; `travel_m` (N,) the way driven; `tilt_sigma_rad` (N,)
    of roll and pitch. `planar` is the plan view of the level lidar frame: origin at the scanner, x above its heading,
    z up; its covariance is that of the steps in that frame. `tilt` is that at every IMU sample.
    """

    trajectory: Trajectory
    travel_m: FloatArray
    tilt_sigma_rad: FloatArray
    planar: OdometryEstimate
    T_base_lidar: FloatArray
    tilt: Tilt

    def __post_init__(self) -> None:
        for name in ("travel_m", "tilt_sigma_rad", "T_base_lidar"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def lidar_poses(self) -> FloatArray:
        """Poses T_odom_lidar (N, 4, 4) of the scanner."""
        return np.asarray(self.trajectory.poses @ self.T_base_lidar)

    @property
    def level_rotations(self) -> FloatArray:
        """Rotations R_level_lidar (N, 3, 3) to the level frame at the same place with the same heading."""
        return without_heading(self.lidar_poses[:, :3, :3])

    def lift(self, planar: Trajectory, height_m: FloatArray | None = None) -> Trajectory:
        """Turn planar poses (N, 3, 3) of the level lidar frame into poses (N, 4, 4) of the base.

        Tilt is the odometry's, and so are the scanner's heights unless `height_m` (N,) gives others.
        """
        xyt = xyt_from_pose(planar.poses)
        height = self.lidar_poses[:, 2, 3] if height_m is None else height_m
        turn = np.zeros((len(xyt), 3))
        turn[:, 2] = xyt[:, 2]
        R = SO3.exp(turn) @ self.level_rotations
        T = pose_from_rotation_translation(R, np.column_stack([xyt[:, :2], height]))
        return planar.with_poses(T @ inverse_pose(self.T_base_lidar))

    def plan_view(self, trajectory: Trajectory) -> Trajectory:
        """Turn poses (N, 4, 4) of the base into planar ones (N, 3, 3) of the level lidar frame."""
        return trajectory.with_poses(planar_from_spatial(trajectory.poses @ self.T_base_lidar))


def spatial_odometry_at_scans(
    log: RobotLog, settings: OdometrySettings, spatial: SpatialOdometrySettings, *, tilt: Tilt | None = None
) -> SpatialOdometry:
    """Give every laser scan a pose in space from wheel encoders and IMU.

    The wheels' way runs along the body's x axis, which the tilt lays up and down the slopes; the heading comes from
    the gyro. `tilt` is taken where it is known already. Raises InputError for a log without scans, encoders or IMU.
    """
    if log.scans is None or len(log.scans) == 0:
        raise InputError(log.path, "the log has no laser scans", "record a LiDAR, or give a log that has one")
    if log.imu is None or len(log.imu) < 2:
        raise InputError(log.path, "has no IMU, which poses in space need", 'set pose_graph.group = "se2"')
    if log.encoders is None:
        raise InputError(log.path, "has no wheel encoders, which poses in space need", 'set pose_graph.group = "se2"')
    encoders, scans = log.encoders, log.scans
    tilt = tilt or estimate_tilt(encoders, log.imu, spatial.tilt)
    driven = wheel_imu_odometry(encoders, log.imu, settings, tilt=tilt)
    base = resample_at_scans(driven, scans.stamps_s, settings)
    distance = np.concatenate([[0.0], encoders.travel_m[1:].mean(axis=1)])
    middle = encoders.stamps_s - 0.5 * np.diff(encoders.stamps_s, prepend=encoders.stamps_s[0])
    climb = distance * tilt.at(middle)[:, 2, 0]
    height, travel = (
        np.interp(scans.stamps_s, encoders.stamps_s, np.cumsum(each)) for each in (climb, np.abs(distance))
    )
    xyt = xyt_from_pose(base.trajectory.poses)
    turn = np.zeros((len(xyt), 3))
    turn[:, 2] = xyt[:, 2]
    R = SO3.exp(turn) @ tilt.at(scans.stamps_s)
    poses = pose_from_rotation_translation(R, np.column_stack([xyt[:, :2], height]))
    trajectory = base.trajectory.with_poses(poses)
    return SpatialOdometry(
        trajectory=trajectory,
        travel_m=travel,
        tilt_sigma_rad=tilt.sigma_at(scans.stamps_s),
        planar=_level_lidar(base, trajectory, scans, tilt),
        T_base_lidar=scans.T_base_lidar,
        tilt=tilt,
    )


def _level_lidar(base: OdometryEstimate, trajectory: Trajectory, scans: LaserScans, tilt: Tilt) -> OdometryEstimate:
    """The plan view of the scanner, with the base's covariances seen from there."""
    planar = planar_from_spatial(trajectory.poses @ scans.T_base_lidar)
    lever = SE2.adjoint(SE2.between(planar[1:], base.trajectory.poses[1:]))
    return OdometryEstimate(
        trajectory=base.trajectory.with_poses(planar),
        covariance=_symmetric(lever @ base.covariance @ np.swapaxes(lever, 1, 2)),
        source=base.source,
        remarks=(*base.remarks, *tilt.remarks),
    )


def _symmetric(matrices: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrices + np.swapaxes(matrices, 1, 2)))
