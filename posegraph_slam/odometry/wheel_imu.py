"""Odometry of a differential-drive robot from wheel encoders and the yaw rate of an IMU."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory
from posegraph_slam.odometry.differential_drive import integrate_motion, wheel_difference, wheel_distance
from posegraph_slam.odometry.estimate import OdometryEstimate, diagonal_covariance, step_covariance
from posegraph_slam.odometry.gyro_bias import GyroBias, estimate_gyro_bias, runs, yaw_rate
from posegraph_slam.odometry.gyro_integral import integrate_rate
from posegraph_slam.odometry.settings import OdometrySettings
from posegraph_slam.odometry.tilt import Tilt
from posegraph_slam.odometry.track_width import estimate_track_width
from posegraph_slam.sensors import Imu, WheelEncoders

COVERED = 1 - 1e-6
"""Part of an encoder interval that the gyro must cover for the interval to count as covered."""


def wheel_imu_odometry(
    encoders: WheelEncoders, imu: Imu | None, settings: OdometrySettings | None = None, *, tilt: Tilt | None = None
) -> OdometryEstimate:
    """Integrate wheel travel and yaw rate into poses at the encoder stamps, the first one the identity.

    Over each encoder interval the distance is the mean travel of the two sides and the turn the exact integral of the
    gyro (linear between its samples, bias removed). Where the gyro is missing (late start, gap, early end, no IMU) the
    wheels' difference over the effective track width turns instead, for just that part of the interval. With `tilt` at
    the IMU's stamps the poses are the plan view of a drive over slopes: headings turn about the vertical, and the way
    is its horizontal part.
    Raises InputError on empty streams, stamps that run backwards and values that are not finite.
    """
    settings = settings or OdometrySettings()
    _check_stream("encoders", encoders.stamps_s, encoders.travel_m, minimum=2)
    if imu is None or len(imu) < 2:
        short = () if imu is None else ("the imu has fewer than two samples and is not used",)
        return _wheel_odometry(encoders, settings, short)
    _check_stream("imu", imu.stamps_s, imu.angular_velocity, minimum=2)
    epoch = encoders.stamps_s[0]
    stamps = encoders.stamps_s - epoch
    travel, duration = encoders.travel_m[1:], np.diff(stamps)
    bias = estimate_gyro_bias(encoders, imu, settings.gyro_bias)
    rate = yaw_rate(imu) - bias.rad_s
    if tilt is not None:
        rate = tilt.heading_rate(rate, imu)
    gyro = integrate_rate(imu.stamps_s - epoch, rate, max_gap_s=settings.max_imu_gap_s)
    angle, covered_s = (np.diff(values) for values in gyro.at(stamps))
    covered = np.divide(covered_s, duration, out=np.zeros_like(duration), where=duration > 0)
    covered = np.where(covered > COVERED, 1.0, covered)
    distance, difference = wheel_distance(travel), wheel_difference(travel)
    if tilt is not None:
        distance = distance * tilt.at(encoders.stamps_s[1:] - 0.5 * duration)[:, 0, 0]
    full = covered == 1.0
    width = estimate_track_width(stamps[1:][full], difference[full], angle[full], nominal_m=encoders.track_width_m)
    turn = angle + (1 - covered) * difference / width.metres
    by_wheels = step_covariance(distance, difference / width.metres, settings.wheels_noise)
    by_gyro = step_covariance(distance, turn, settings.wheels_imu_noise) + _gyro_covariance(bias, covered_s)
    part = covered[:, None, None]
    remarks = (*bias.remarks, width.remark, _bridged(stamps, duration * (1 - covered)))
    return OdometryEstimate(
        trajectory=_trajectory(encoders, integrate_motion(distance, turn)),
        covariance=part * by_gyro + (1 - part) * by_wheels,
        source="wheels_imu",
        remarks=tuple(remark for remark in remarks if remark),
    )


def _wheel_odometry(encoders: WheelEncoders, settings: OdometrySettings, remarks: tuple[str, ...]) -> OdometryEstimate:
    """Odometry from the wheels alone, with the track width of the log."""
    if not encoders.track_width_m > 0:
        raise InputError("encoders", "no track width is known and there is no gyro", "give track_width_m")
    travel = encoders.travel_m[1:]
    distance, turn = wheel_distance(travel), wheel_difference(travel) / encoders.track_width_m
    return OdometryEstimate(
        trajectory=_trajectory(encoders, integrate_motion(distance, turn)),
        covariance=step_covariance(distance, turn, settings.wheels_noise),
        source="wheels",
        remarks=remarks,
    )


def _trajectory(encoders: WheelEncoders, poses: FloatArray) -> Trajectory:
    return Trajectory(stamps_s=encoders.stamps_s, poses=poses, parent="odom", child="base")


def _gyro_covariance(bias: GyroBias, covered_s: FloatArray) -> FloatArray:
    """Heading noise of the gyro itself: white noise, and the error of the bias.

    The error of the bias is one and the same over the whole log; as independent steps it gets the variance that is
    right for the whole, (sigma T)^2, spread evenly over the time T.
    """
    total_s = float(covered_s.sum())
    rate = bias.noise_density**2 + bias.sigma_rad_s**2 * total_s
    return diagonal_covariance(np.zeros_like(covered_s), rate * covered_s)


def _bridged(stamps: FloatArray, missing_s: FloatArray) -> str:
    """Say when the gyro was missing."""
    first, after = runs(missing_s > 1e-6)
    if len(first) == 0:
        return ""
    where = [f"{stamps[a]:.2f}-{stamps[b]:.2f} s" for a, b in zip(first[:4], after[:4], strict=True)]
    more = f" and {len(first) - 4} more stretches" if len(first) > 4 else ""
    return (
        f"the gyro is missing for {float(missing_s.sum()):.2f} s ({', '.join(where)}{more} after the first encoder "
        "stamp): the turn there comes from the wheels"
    )


def _check_stream(name: str, stamps_s: FloatArray, values: FloatArray, *, minimum: int) -> None:
    """Raise InputError unless the stream has `minimum` samples, finite values and stamps that do not run backwards."""
    if len(stamps_s) < minimum:
        raise InputError(name, f"{len(stamps_s)} samples are too few for odometry", "record at least two")
    bad = np.flatnonzero(~np.isfinite(stamps_s) | ~np.all(np.isfinite(values), axis=1))
    if len(bad):
        raise InputError(name, f"sample {bad[0]} is not finite ({len(bad)} in all)", "repair or drop these samples")
    back = np.flatnonzero(np.diff(stamps_s) < 0)
    if len(back):
        raise InputError(
            name, f"the clock runs backwards at sample {back[0] + 1} ({len(back)} times in all)", "repair the stamps"
        )
