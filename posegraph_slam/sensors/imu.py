"""Inertial measurement unit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.errors import InputError

STANDARD_GRAVITY = 9.80665
"""m/s^2 in one g."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Imu:
    """`stamps_s` (N,), `angular_velocity` (N, 3) rad/s and `linear_acceleration` (N, 3) m/s^2 in the imu frame.

    A rate is NaN where the gyro is known to have said nothing. `gyro_gain_sigma` is the relative standard deviation of
    the gains behind the rates: zero where they are known well enough to be left alone.
    """

    stamps_s: FloatArray
    angular_velocity: FloatArray
    linear_acceleration: FloatArray
    T_base_imu: FloatArray
    gyro_gain_sigma: float = 0.0

    def __post_init__(self) -> None:
        for name in ("stamps_s", "angular_velocity", "linear_acceleration", "T_base_imu"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        expected = (len(self.stamps_s), 3)
        if self.angular_velocity.shape != expected or self.linear_acceleration.shape != expected:
            raise InputError(
                "imu",
                f"angular velocity {self.angular_velocity.shape} and linear acceleration "
                f"{self.linear_acceleration.shape} do not fit {expected[0]} stamps",
            )

    def __len__(self) -> int:
        return int(self.stamps_s.shape[0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuCalibration:
    """Corrections of what an IMU puts out, from its own axes to those of the body it is mounted on.

    The specific force is `accelerometer_matrix` (3, 3) @ (measured - `accelerometer_offset` (3,) m/s^2) and the rate
    `gyro_matrix` (3, 3) @ measured: gains, axes that are not square, and the mounting. Bias of the gyro is left to the
    filters. What is stamped t happened at t + `early_s` on the clock that counts, such as that of motion capture.
    """

    accelerometer_offset: FloatArray
    accelerometer_matrix: FloatArray
    gyro_matrix: FloatArray
    early_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("accelerometer_offset", "accelerometer_matrix", "gyro_matrix"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def apply(self, imu: Imu) -> Imu:
        """Correct rates and accelerations of an IMU; its stamps stay, and what was measured is interpolated at them."""
        rates = imu.angular_velocity @ self.gyro_matrix.T
        forces = (imu.linear_acceleration - self.accelerometer_offset) @ self.accelerometer_matrix.T
        if self.early_s != 0.0 and len(imu):
            at = imu.stamps_s - self.early_s
            rates, forces = (
                np.stack([np.interp(at, imu.stamps_s, axis) for axis in each.T], axis=1) for each in (rates, forces)
            )
        return replace(imu, angular_velocity=rates, linear_acceleration=forces)
