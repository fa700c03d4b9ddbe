"""A wheeled robot on ground that is not level: its tilt over time, and what that makes of its wheels and its gyro."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.ndimage import gaussian_filter1d

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SO3, Trajectory, interpolate, pose_from_rotation_translation
from posegraph_slam.odometry.attitude import AttitudeEstimate, AttitudeSettings, estimate_attitude
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu, WheelEncoders
from posegraph_slam.settings import Settings

GRID_S = 0.01
MIN_LEVEL_SAMPLES = 20
START_MARGIN_S = 0.2
"""Motion below one tick begins about this much before the first."""


class TiltSettings(Settings):
    """How roll and pitch of a wheeled robot are found."""

    level_start: bool = True
    """The log begins on level ground: a tilt that the accelerometer shows there is its own,"""
    level_start_max_rad: float = Field(default=0.1, gt=0, le=0.5)
    """up to this; more is a real slope."""
    wheel_acceleration: bool = True
    """Take the acceleration that the wheels show off the accelerometer's."""
    wheel_smoothing_s: float = Field(default=0.1, gt=0, le=2)
    """Standard deviation of the Gaussian that smooths the wheels' way before it is differentiated twice."""
    attitude: AttitudeSettings = AttitudeSettings(
        accelerometer_sigma_rad=0.05, accelerometer_lasting_s=0.01, accelerometer_excess_factor=2.0
    )
    """The filter; what the accelerometer shows beside gravity is smaller and shorter once the wheels' part is off."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tilt:
    """Attitude R_odom_base (M, 3, 3) at `stamps_s` (M,), sigma (M,) of its roll and pitch, and gyro biases (M, 3).

    The heading in it is that of the filter alone; `heading_rate` says how the body's rates turn the true heading.
    """

    stamps_s: FloatArray
    rotations: FloatArray
    sigma_rad: FloatArray
    gyro_bias: FloatArray
    remarks: tuple[str, ...]

    def __post_init__(self) -> None:
        for name in ("stamps_s", "rotations", "sigma_rad", "gyro_bias"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def at(self, stamps_s: FloatArray) -> FloatArray:
        """Rotations (n, 3, 3) at any stamps, held before the first and after the last, with heading zero."""
        poses = pose_from_rotation_translation(self.rotations, np.zeros((len(self.stamps_s), 3)))
        trajectory = Trajectory(stamps_s=self.stamps_s, poses=poses, parent="odom", child="base")
        return without_heading(interpolate(trajectory, stamps_s).poses[:, :3, :3])

    def sigma_at(self, stamps_s: FloatArray) -> FloatArray:
        """Sigma (n,) of roll and pitch at any stamps."""
        return np.interp(stamps_s, self.stamps_s, self.sigma_rad)

    def heading_rate(self, rate_up: FloatArray, imu: Imu) -> FloatArray:
        """Rate (M,) of the heading from that about the body's z axis (M,), its bias taken off, and the imu's others.

        psi' = (omega_y sin(roll) + omega_z cos(roll)) / cos(pitch).
        """
        aside = (imu.angular_velocity @ imu.T_base_imu[:3, :3].T)[:, 1] - self.gyro_bias[:, 1]
        R = self.rotations
        square = R[:, 2, 1] ** 2 + R[:, 2, 2] ** 2
        return np.asarray((aside * R[:, 2, 1] + rate_up * R[:, 2, 2]) / square)


def without_heading(R: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) turned about the vertical until their x axes point to heading zero."""
    turn = np.zeros((len(R), 3))
    turn[:, 2] = -np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return SO3.exp(turn) @ R


def estimate_tilt(encoders: WheelEncoders, imu: Imu, settings: TiltSettings) -> Tilt:
    """Find roll and pitch of a wheeled robot at every IMU stamp.

    The base moves along its x axis with speed v, so that the accelerometer shows gravity and [v', v w_z, -v w_y]; the
    latter is taken off. The filter is smoothed backwards. Raises InputError for an IMU without acceleration or a clock
    that runs backwards.
    """
    R_base_imu = imu.T_base_imu[:3, :3]
    omega, accel = imu.angular_velocity @ R_base_imu.T, imu.linear_acceleration @ R_base_imu.T
    count = _before_the_wheels_roll(encoders, imu)
    offset, remark = _level_offset(accel[:count], settings)
    bias = np.median(omega[:count], axis=0) if count >= MIN_LEVEL_SAMPLES else np.zeros(3)
    accel = accel - offset
    if settings.wheel_acceleration:
        accel = accel - motion_acceleration(encoders, imu.stamps_s, omega - bias, settings.wheel_smoothing_s)
    base = Imu(stamps_s=imu.stamps_s, angular_velocity=omega, linear_acceleration=accel, T_base_imu=np.eye(4))
    estimate = estimate_attitude(base, settings.attitude, method="smoother")
    return Tilt(
        stamps_s=imu.stamps_s,
        rotations=estimate.rotations,
        sigma_rad=_tilt_sigma(estimate),
        gyro_bias=estimate.gyro_bias,
        remarks=(remark,) if remark else (),
    )


def motion_acceleration(
    encoders: WheelEncoders, stamps_s: FloatArray, omega: FloatArray, smoothing_s: float
) -> FloatArray:
    """Acceleration (M, 3) in the base of a robot that drives along its x axis, at `stamps_s` (M,) with rates (M, 3)."""
    way = np.cumsum(encoders.travel_m.mean(axis=1))
    way -= way[0]
    if len(encoders) < 2 or not encoders.stamps_s[-1] > encoders.stamps_s[0]:
        raise InputError("encoders", f"{len(encoders)} samples are too few for a speed", "record at least two")
    epoch = encoders.stamps_s[0]
    grid = np.arange(0.0, encoders.stamps_s[-1] - epoch + GRID_S, GRID_S)
    smooth = gaussian_filter1d(np.interp(grid, encoders.stamps_s - epoch, way), smoothing_s / GRID_S, mode="nearest")
    speed = np.gradient(smooth, GRID_S)
    rate = np.gradient(speed, GRID_S)
    v, a = (np.interp(stamps_s - epoch, grid, values, left=0.0, right=0.0) for values in (speed, rate))
    return np.stack([a, v * omega[:, 2], -v * omega[:, 1]], axis=1)


def _before_the_wheels_roll(encoders: WheelEncoders, imu: Imu) -> int:
    """Count the samples before the first tick, a margin cut off: to an IMU an even acceleration looks like a stop."""
    ticks = np.concatenate([encoders.ticks_left, encoders.ticks_right], axis=1)[1:].any(axis=1)
    rolling = encoders.stamps_s[int(np.argmax(ticks))] if ticks.any() else np.inf
    return int(np.searchsorted(imu.stamps_s, rolling - START_MARGIN_S))


def _level_offset(accel: FloatArray, settings: TiltSettings) -> tuple[FloatArray, str]:
    """What a still accelerometer (n, 3) shows beside gravity on level ground, and a remark on it."""
    if not settings.level_start:
        return np.zeros(3), ""
    if len(accel) < MIN_LEVEL_SAMPLES:
        return np.zeros(3), "the robot moves from the start: the accelerometer's own tilt is not known"
    mean = np.median(accel, axis=0)
    tilt = float(np.arctan2(np.hypot(mean[0], mean[1]), mean[2]))
    if tilt > settings.level_start_max_rad:
        return np.zeros(3), f"the log begins at a tilt of {np.degrees(tilt):.1f} deg, which is taken for a slope"
    offset = mean - [0.0, 0.0, STANDARD_GRAVITY]
    return (
        offset,
        f"the accelerometer shows a tilt of {np.degrees(tilt):.2f} deg on the level start, which is taken off",
    )


def _tilt_sigma(estimate: AttitudeEstimate) -> FloatArray:
    """Sigma (M,) of the tilt: the largest over the two directions of the turn that are level."""
    assert estimate.covariance is not None
    R = estimate.rotations
    world = R @ estimate.covariance @ R.transpose(0, 2, 1)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(world[:, :2, :2])[:, 1]))
