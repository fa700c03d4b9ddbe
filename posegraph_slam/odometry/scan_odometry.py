"""One odometry pose for every laser scan, from whatever source the log has."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.errors import ConfigurationError, InputError
from posegraph_slam.geometry import SE2, Trajectory, planar_from_spatial
from posegraph_slam.odometry.estimate import OdometryEstimate, diagonal_covariance, resample, step_covariance
from posegraph_slam.odometry.settings import OdometrySettings, OdometrySource
from posegraph_slam.odometry.wheel_imu import wheel_imu_odometry
from posegraph_slam.sensors import RobotLog

STILL = 1e-3
"""A logged step shorter than this, in metres and radians, is one of odometry that stands still, or has stalled."""
STALL_STEPS_MAX = 60
"""Steps over which a leap is spread at most."""


def odometry_at_scans(log: RobotLog, settings: OdometrySettings | None = None) -> OdometryEstimate:
    """Give every laser scan its odometry pose, in file order, with the noise of the steps between them.

    The source is the logged odometry (pose of each scan, else the logger's stream), else wheels and gyro, else the
    wheels alone, else nothing, which is a robot that stays put with a wide covariance; `settings.source` forces one.
    Scans outside the time of the odometry hold its first or last pose, and a remark says so.
    Raises InputError without scans or with poses that are not finite, ConfigurationError for a source that is absent.
    """
    settings = settings or OdometrySettings()
    if log.scans is None or len(log.scans) == 0:
        raise InputError(log.path, "the log has no laser scans", "record a LiDAR, or give a log that has one")
    stamps = log.scans.stamps_s
    source = chosen_source(log, settings.source)
    if source == "none":
        return _constant_pose(stamps, settings)
    if source == "logged":
        return _logged(log, stamps, settings)
    assert log.encoders is not None
    imu = log.imu if source == "wheels_imu" else None
    return resample_at_scans(wheel_imu_odometry(log.encoders, imu, settings), stamps, settings)


def chosen_source(log: RobotLog, wanted: OdometrySource = "auto") -> OdometrySource:
    """Say which source `odometry_at_scans` takes; ConfigurationError when the wanted one is not in the log."""
    present: dict[OdometrySource, bool] = {
        "logged": bool(log.scan_odometry or log.odometry),
        "wheels_imu": bool(log.encoders and log.imu),
        "wheels": bool(log.encoders),
        "none": True,
    }
    if wanted == "auto":
        unmoved = not _moves(log.scan_odometry) and not _moves(log.odometry)
        return next(source for source, there in present.items() if there and not (source == "logged" and unmoved))
    if not present[wanted]:
        have = ", ".join(source for source, there in present.items() if there)
        raise ConfigurationError("odometry.source", f"'{wanted}' is not in {log.path}", f"choose auto, {have}")
    return wanted


def _moves(trajectory: Trajectory | None) -> bool:
    """Whether there are poses, and not one and the same at all times, as loggers write that know no odometry."""
    if trajectory is None or len(trajectory) == 0:
        return False
    return len(trajectory) == 1 or not bool(np.all(np.abs(trajectory.poses - trajectory.poses[0]) <= 1e-9))


def _logged(log: RobotLog, stamps: FloatArray, settings: OdometrySettings) -> OdometryEstimate:
    """Odometry of the robot's own computer: the pose logged with each scan, else its stream at the scan stamps."""
    if log.scan_odometry is not None:
        if len(log.scan_odometry) != len(stamps):
            raise InputError(log.path, f"{len(log.scan_odometry)} odometry poses for {len(stamps)} scans")
        return _from_poses(log, log.scan_odometry.restamped(stamps), settings)
    assert log.odometry is not None
    return resample_at_scans(_from_poses(log, log.odometry.in_stamp_order(), settings), stamps, settings)


def _from_poses(log: RobotLog, trajectory: Trajectory, settings: OdometrySettings) -> OdometryEstimate:
    """Put noise on the steps of a logged trajectory; a leap, longer than a robot moves in one, is left almost free."""
    poses = trajectory.poses if trajectory.group is SE2 else planar_from_spatial(trajectory.poses)
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
    if len(bad):
        raise InputError(log.path, f"odometry pose {bad[0]} is not finite ({len(bad)} in all)", "drop these scans")
    distance, turn = _lengths(poses)
    leap = (distance > settings.leap_m) | (turn > settings.leap_rad)
    poses, unsure = _spread_leaps(poses, np.flatnonzero(leap), np.maximum(distance, turn) < STILL)
    covariance = step_covariance(*_lengths(poses), settings.logged_noise) + unsure
    remark = f"the logged odometry leaps {leap.sum()} times by metres or tens of degrees in one step"
    return OdometryEstimate(
        trajectory=Trajectory(stamps_s=trajectory.stamps_s, poses=poses, parent="odom", child="base"),
        covariance=covariance,
        source="logged",
        remarks=(remark,) if leap.any() else (),
    )


def _lengths(poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distance and turn (N-1,) of the steps between poses (N, 3, 3)."""
    xi = SE2.log(SE2.between(poses[:-1], poses[1:]))
    return np.hypot(xi[:, 0], xi[:, 1]), np.abs(xi[:, 2])


def _spread_leaps(poses: FloatArray, leaps: IntArray, still: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Spread each of the steps `leaps` evenly over the `still` steps before it, during which odometry had stalled.

    Returns the poses (N, 3, 3) and what is to be added to the covariance of the steps (N-1, 3, 3): a leap and the
    steps over which it was spread share a variance of its own size.
    """
    poses, unsure = poses.copy(), np.zeros((len(still), 3, 3))
    for leap in leaps:
        moving = np.flatnonzero(~still[max(leap - STALL_STEPS_MAX, 0) : leap])
        first = max(leap - STALL_STEPS_MAX, 0) + (int(moving[-1]) + 1 if len(moving) else 0)
        count = int(leap) + 1 - first
        motion = SE2.log(SE2.between(poses[first], poses[leap + 1])[None])
        share = np.arange(1, count)[:, None] / count
        poses[first + 1 : leap + 1] = SE2.retract(poses[[first] * (count - 1)], share * motion)
        unsure[first : leap + 1] = diagonal_covariance(motion[:, 0] ** 2 + motion[:, 1] ** 2, motion[:, 2] ** 2) / count
    return poses, unsure


def resample_at_scans(estimate: OdometryEstimate, stamps: FloatArray, settings: OdometrySettings) -> OdometryEstimate:
    """Resample at the scan stamps and remark on scans outside the odometry's time."""
    known = estimate.trajectory.stamps_s
    floor = settings.wheels_imu_noise if estimate.source == "wheels_imu" else settings.wheels_noise
    floor = settings.logged_noise if estimate.source == "logged" else floor
    at_scans = resample(estimate, stamps, unknown_per_s=_unknown_per_s(settings), floor=floor)
    before, after = int((stamps < known[0]).sum()), int((stamps > known[-1]).sum())
    if not before and not after:
        return at_scans
    remark = f"{before} scans before and {after} after the time of the odometry hold its first or last pose"
    return OdometryEstimate(
        trajectory=at_scans.trajectory, covariance=at_scans.covariance, source=at_scans.source,
        remarks=(*at_scans.remarks, remark),
    )  # fmt: skip


def _constant_pose(stamps: FloatArray, settings: OdometrySettings) -> OdometryEstimate:
    """No motion at all, with a covariance that allows for any; scans in bursts count as evenly spread."""
    count = len(stamps)
    even_s = float(np.ptp(stamps)) / max(count - 1, 1)
    step_s = np.maximum(np.abs(np.diff(stamps)), max(even_s, 1e-3))
    return OdometryEstimate(
        trajectory=Trajectory(stamps_s=stamps, poses=SE2.identity(count), parent="odom", child="base"),
        covariance=_unknown_per_s(settings) * step_s[:, None, None],
        source="none",
        remarks=("the log has no odometry: the robot is taken to stay put, with a wide covariance",),
    )


def _unknown_per_s(settings: OdometrySettings) -> FloatArray:
    """Covariance (3, 3) a second of a robot that is not watched."""
    position = np.asarray(settings.unknown_m_per_sqrt_s**2)
    return diagonal_covariance(position, np.asarray(settings.unknown_rad_per_sqrt_s**2))
