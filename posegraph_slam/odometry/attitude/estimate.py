"""Orientation of a body over time from its IMU."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory, pose_from_rotation_translation
from posegraph_slam.odometry.attitude.calibration import estimate_gyro_gain
from posegraph_slam.odometry.attitude.complementary import complementary_stream
from posegraph_slam.odometry.attitude.quaternions import rotation_from_wxyz, wxyz_from_rotation
from posegraph_slam.odometry.attitude.settings import AttitudeMethod, AttitudeSettings
from posegraph_slam.odometry.attitude.start import find_start
from posegraph_slam.odometry.attitude.steps import steps
from posegraph_slam.odometry.attitude.ukf import initial_state, run_ukf, smoothed
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu

WORTH_SAYING = 0.01
"""Corrections of the gains below this are within their errors."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttitudeEstimate:
    """Orientation R_world_base (N, 3, 3) at `stamps_s` (N,); the world's z axis points up, its heading starts at zero.

    `covariance` (N, 3, 3) is of the turn in the body, R_true = R exp(turn), in rad^2; None where the method has none.
    `gyro_bias` (N, 3) rad/s in the base frame; `corrected_share` of the samples passed the accelerometer's gate.
    """

    method: AttitudeMethod
    stamps_s: FloatArray
    rotations: FloatArray
    covariance: FloatArray | None
    gyro_bias: FloatArray
    corrected_share: float
    remarks: tuple[str, ...]

    def __post_init__(self) -> None:
        for name in ("stamps_s", "rotations", "gyro_bias"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", read_only(self.covariance))

    def __len__(self) -> int:
        return int(self.stamps_s.shape[0])

    @property
    def trajectory(self) -> Trajectory:
        """Poses T_odom_base (N, 4, 4) with position zero, for `geometry.interpolate` and TUM files."""
        poses = pose_from_rotation_translation(self.rotations, np.zeros((len(self), 3)))
        return Trajectory(stamps_s=self.stamps_s, poses=poses, parent="odom", child="base")


def estimate_attitude(
    imu: Imu, settings: AttitudeSettings | None = None, *, method: AttitudeMethod = "ukf"
) -> AttitudeEstimate:
    """Estimate the orientation of the base at every IMU stamp from gyro and accelerometer.

    Rates and accelerations are turned into the base by `T_base_imu`; the lever arm is neglected. Rates that are NaN are
    unknown. `smoother` is the filter with a backward pass, by which later samples correct earlier ones. Gains of the
    gyro that are uncertain (`gyro_gain_sigma`) are first found from gravity, whatever the method. Raises `InputError`
    for an IMU without samples, one whose clock runs backwards or without acceleration.
    """
    settings = settings or AttitudeSettings()
    _check(imu)
    imu, remarks = _with_found_gains(imu)
    R_base_imu = imu.T_base_imu[:3, :3]
    omega, accel = imu.angular_velocity @ R_base_imu.T, imu.linear_acceleration @ R_base_imu.T
    start = find_start(imu.stamps_s, omega, accel, settings)
    dt, rates = steps(imu.stamps_s, omega, settings.max_gap_s)
    share, covariance, bias = 0.0, None, np.tile(start.gyro_bias, (len(imu), 1))
    if method in ("ukf", "smoother"):
        stream = run_ukf(initial_state(start, settings), dt, rates, accel, settings=settings)
        if method == "smoother":
            stream = smoothed(stream, dt, rates, settings=settings)
        quat_wxyz, bias = stream.quat_wxyz, stream.gyro_bias
        R = rotation_from_wxyz(quat_wxyz)
        covariance = R.transpose(0, 2, 1) @ stream.covariance[:, :3, :3] @ R
        share = float(stream.corrected.mean())
    else:
        time_constant = settings.complementary_time_s if method == "complementary" else np.inf
        noise = (STANDARD_GRAVITY, settings.max_excess, time_constant)
        quat_wxyz = complementary_stream(dt, rates - start.gyro_bias, accel, *noise, wxyz_from_rotation(start.rotation))
    return AttitudeEstimate(
        method=method,
        stamps_s=imu.stamps_s,
        rotations=rotation_from_wxyz(quat_wxyz),
        covariance=covariance,
        gyro_bias=bias,
        corrected_share=share,
        remarks=(start.remark, *remarks),
    )


def _with_found_gains(imu: Imu) -> tuple[Imu, tuple[str, ...]]:
    """Correct the gains of a gyro whose own are uncertain, and say by how much where it is more than a per cent."""
    if imu.gyro_gain_sigma == 0.0:
        return imu, ()
    gain, _ = estimate_gyro_gain([imu], prior_sigma=imu.gyro_gain_sigma)
    corrected = replace(imu, angular_velocity=imu.angular_velocity * gain, gyro_gain_sigma=0.0)
    if np.abs(gain - 1.0).max() < WORTH_SAYING:
        return corrected, ()
    factors = ", ".join(f"{each:.3f}" for each in gain)
    return corrected, (f"gravity shows the gyro's gains to be off: its rates are taken times [{factors}]",)


def _check(imu: Imu) -> None:
    if len(imu) == 0:
        raise InputError("imu", "has no samples")
    back = ~(np.diff(imu.stamps_s) >= 0)
    if back.any():
        raise InputError("imu", f"the clock runs backwards or stops at sample {int(np.argmax(back)) + 1}", "repair it")
    if not (np.isfinite(imu.linear_acceleration).all(axis=1) & imu.linear_acceleration.any(axis=1)).any():
        raise InputError("imu", "has no acceleration", "attitude needs an accelerometer")
