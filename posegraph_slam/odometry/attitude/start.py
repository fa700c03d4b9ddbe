"""What the first samples of an IMU tell: whether the body is still, its tilt, and the gyro's bias."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.odometry.attitude.settings import AttitudeSettings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Start:
    """Rotation R_world_base (3, 3) with heading zero and its tilt sigma, gyro bias (3,) rad/s and its sigma."""

    rotation: FloatArray
    gyro_bias: FloatArray
    bias_sigma_rad_s: float
    tilt_sigma_rad: float
    remark: str

    def __post_init__(self) -> None:
        for name in ("rotation", "gyro_bias"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def still_samples(stamps_s: FloatArray, omega: FloatArray, accel: FloatArray, settings: AttitudeSettings) -> int:
    """Count the samples before rate or acceleration leaves its median over the first `min_still_s`."""
    first = stamps_s <= stamps_s[0] + settings.min_still_s
    moved = ~(np.abs(omega - np.median(omega[first], axis=0)) < settings.still_rate_rad_s).all(axis=1)
    moved |= ~(np.abs(accel - np.median(accel[first], axis=0)) < settings.still_acceleration_m_s2).all(axis=1)
    return int(np.argmax(moved)) if moved.any() else len(stamps_s)


def level_rotation(accel: FloatArray) -> FloatArray:
    """Rotation (3, 3) with heading zero that turns the direction of `accel` (3,) upwards."""
    x, y, z = accel
    roll, pitch = np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))
    return np.asarray(Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix())


def find_start(stamps_s: FloatArray, omega: FloatArray, accel: FloatArray, settings: AttitudeSettings) -> Start:
    """Take tilt and gyro bias from the still start; without one the bias is zero and both are uncertain.

    The bias has the standard error of the mean, at least `still_bias_sigma_rad_s`.
    """
    count = still_samples(stamps_s, omega, accel, settings)
    seconds = float(stamps_s[count - 1] - stamps_s[0]) if count else 0.0
    if seconds >= settings.min_still_s:
        error = float(omega[:count].std(axis=0).max()) / np.sqrt(count)
        bias = omega[:count].mean(axis=0)
        return Start(
            rotation=level_rotation(accel[:count].mean(axis=0)),
            gyro_bias=bias,
            bias_sigma_rad_s=max(error, settings.still_bias_sigma_rad_s),
            tilt_sigma_rad=settings.start_tilt_sigma_rad,
            remark=f"gyro bias [{', '.join(f'{b:.2e}' for b in bias)}] rad/s from a still start of {seconds:.1f} s",
        )
    usable = accel[np.isfinite(accel).all(axis=1) & (np.linalg.norm(accel, axis=1) > 0)]
    return Start(
        rotation=level_rotation(usable[: max(count, 1)].mean(axis=0)) if len(usable) else np.eye(3),
        gyro_bias=np.zeros(3),
        bias_sigma_rad_s=settings.unknown_bias_sigma_rad_s,
        tilt_sigma_rad=settings.moving_tilt_sigma_rad,
        remark="the body moves from the start: gyro bias taken as zero and left to the filter",
    )
