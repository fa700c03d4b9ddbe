"""Quaternion unscented Kalman filter of orientation and gyro bias (Kraft 2003), with explicit state."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, read_only
from posegraph_slam.odometry.attitude.quaternions import rotation_from_wxyz, wxyz_from_rotation
from posegraph_slam.odometry.attitude.settings import AttitudeSettings
from posegraph_slam.odometry.attitude.sigma_points import POINTS, STATE, correct, filter_stream, predict_core
from posegraph_slam.odometry.attitude.smoother import smooth_stream
from posegraph_slam.odometry.attitude.start import Start
from posegraph_slam.sensors import STANDARD_GRAVITY


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttitudeState:
    """Orientation of the body in the world `quat_wxyz` (4,), `gyro_bias` (3,) rad/s, and their `covariance` (6, 6).

    The error is [turn, bias]: R_true = exp(turn) R, a turn in the world, whose z axis points up.
    """

    quat_wxyz: FloatArray
    gyro_bias: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        for name in ("quat_wxyz", "gyro_bias", "covariance"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def rotation(self) -> FloatArray:
        """R_world_body (3, 3)."""
        return rotation_from_wxyz(self.quat_wxyz)

    def copies(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return writable copies of the three arrays, for a kernel to change."""
        return self.quat_wxyz.copy(), self.gyro_bias.copy(), self.covariance.copy()


def initial_state(start: Start, settings: AttitudeSettings) -> AttitudeState:
    """Make the state of a start: tilt and bias as uncertain as it says, the heading known by definition."""
    sigma = [*[start.tilt_sigma_rad] * 2, settings.start_heading_sigma_rad, *[start.bias_sigma_rad_s] * 3]
    quat_wxyz = wxyz_from_rotation(start.rotation)
    return AttitudeState(quat_wxyz=quat_wxyz, gyro_bias=start.gyro_bias, covariance=np.diag(np.square(sigma)))


def predict(state: AttitudeState, omega: FloatArray, dt: float, settings: AttitudeSettings) -> AttitudeState:
    """Advance the state by `dt` > 0 seconds at the measured rate `omega` (3,) rad/s, bias included.

    Process noise is added before the sigma points are drawn (Kraft 2003, eq. 35). A rate that is not finite is
    unknown: the orientation stays and its covariance grows.
    """
    q, bias, P = state.copies()
    predict_core(q, bias, P, np.asarray(omega, dtype=np.float64), float(dt), gyro_noise(settings), *_workspace())
    return AttitudeState(quat_wxyz=q, gyro_bias=bias, covariance=P)


def update(state: AttitudeState, accel: FloatArray, settings: AttitudeSettings, dt: float = math.inf) -> AttitudeState:
    """Correct the state by the specific force `accel` (3,) m/s^2, which points up at rest.

    `dt` is the time since the last correction: motion lasts, and samples within `accelerometer_lasting_s` share what
    one alone would tell; without `dt` they are independent. The sigma grows with | |a|/g - 1 |; beyond `max_excess` the
    state is returned as it was. Only the direction counts.
    """
    q, bias, P = state.copies()
    noise = accelerometer_noise(settings)
    if not correct(q, bias, P, np.asarray(accel, dtype=np.float64), float(dt), noise, *_workspace()):
        return state
    return AttitudeState(quat_wxyz=q, gyro_bias=bias, covariance=P)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UkfStream:
    """Quaternions (N, 4) wxyz, gyro biases (N, 3), covariances (N, 6, 6), and samples (N,) that were corrected."""

    quat_wxyz: FloatArray
    gyro_bias: FloatArray
    covariance: FloatArray
    corrected: BoolArray


def run_ukf(
    state: AttitudeState, dt: FloatArray, omega: FloatArray, accel: FloatArray, *, settings: AttitudeSettings
) -> UkfStream:
    """Predict and update over a stream, in one kernel: `dt` (N,), rates over each step and `accel` at its end (N, 3).

    Gives what `predict` and `update` give one by one, each with its `dt`; a step of no duration is not predicted.
    """
    dt, omega, accel = (np.ascontiguousarray(each, dtype=np.float64) for each in (dt, omega, accel))
    noise = gyro_noise(settings), accelerometer_noise(settings)
    q, bias, P, used = filter_stream(dt, omega, accel, *noise, *state.copies())
    return UkfStream(quat_wxyz=q, gyro_bias=bias, covariance=P, corrected=used)


def smoothed(stream: UkfStream, dt: FloatArray, omega: FloatArray, *, settings: AttitudeSettings) -> UkfStream:
    """Let later samples correct earlier ones: the stream that `run_ukf` made of the same `dt` and `omega`, smoothed.

    Covariances are those of the smoothed estimates; the last sample stays what it was.
    """
    q, bias, P = stream.quat_wxyz.copy(), stream.gyro_bias.copy(), stream.covariance.copy()
    dt, omega = (np.ascontiguousarray(each, dtype=np.float64) for each in (dt, omega))
    smooth_stream(dt, omega, gyro_noise(settings), q, bias, P)
    return UkfStream(quat_wxyz=q, gyro_bias=bias, covariance=P, corrected=stream.corrected)


def gyro_noise(settings: AttitudeSettings) -> FloatArray:
    """The process noise in the order of `predict_core`."""
    return np.array([
        settings.gyro_noise_rad_per_sqrt_s,
        settings.gyro_noise_rad_per_sqrt_rad,
        settings.bias_walk_rad_s_per_sqrt_s,
        settings.unknown_rate_rad_per_sqrt_s,
    ])  # fmt: skip


def accelerometer_noise(settings: AttitudeSettings) -> FloatArray:
    """Gravity and the measurement noise in the order of `correct`."""
    return np.array([
        STANDARD_GRAVITY,
        settings.accelerometer_sigma_rad,
        settings.accelerometer_excess_factor,
        settings.max_excess,
        settings.accelerometer_lasting_s,
    ])  # fmt: skip


def _workspace() -> tuple[FloatArray, FloatArray, FloatArray]:
    return np.zeros((STATE, STATE)), np.empty((POINTS, 4)), np.empty((POINTS, STATE))
