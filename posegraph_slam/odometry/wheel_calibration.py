"""Wheels calibrated against matched scans: how far they roll a metre, and how evenly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.geometry import SE2
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.settings import OdometrySettings
from posegraph_slam.sensors import WheelEncoders
from posegraph_slam.settings import Settings

TURN_MAX_RAD = 1.0
"""Steps between keyframes that turn further say nothing of the way."""


class WheelCalibrationSettings(Settings):
    """How the way of the wheels is calibrated against scan matching, before the scans are matched a second time."""

    enabled: bool = True
    """Calibrate; false takes the encoders' metres a tick as they are."""
    way_min_m: float = Field(default=10.0, gt=0)
    """Less way than this, on which the scans show how far the robot came, says nothing."""
    scale_max: float = Field(default=0.1, gt=0, lt=1)
    """A larger share is no matter of tyres: it is not believed."""
    window_m: float = Field(default=2.0, gt=0)
    """Wheels and scans are compared over stretches of this length."""
    noise_min_per_sqrt_m: float = Field(default=0.015, gt=0)
    """m of position sigma after driving 1 m with calibrated wheels: as found, but no less, since the scans show the way
    on level ground above all, and wheels slip on slopes."""
    prediction_sigma_m: float = Field(default=0.002, gt=0)
    """`scan_matching.prediction_sigma_m` of calibrated wheels, whose systematic error is taken off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelCalibration:
    """`scale` of the wheels' way with its standard error, and the sigma in m that is left after 1 m."""

    scale: float = 1.0
    sigma: float = np.inf
    noise_per_sqrt_m: float = np.inf

    @property
    def known(self) -> bool:
        """Whether the log showed it."""
        return bool(np.isfinite(self.sigma))

    @property
    def remark(self) -> str:
        """Say what was found."""
        return (
            f"the wheels' way times {self.scale:.4f} ± {self.sigma:.4f} is that of the scans, "
            f"to within {1000 * self.noise_per_sqrt_m:.1f} mm after 1 m: corrected"
        )

    def applied(self, encoders: WheelEncoders) -> WheelEncoders:
        """Return the encoders with their metres a tick corrected."""
        return replace(encoders, metres_per_tick=encoders.metres_per_tick * self.scale)

    def noise(self, settings: OdometrySettings, least: float) -> OdometrySettings:
        """Return the settings with the noise of the way that was found, or `least`, where it is less than theirs."""
        noise = settings.wheels_imu_noise
        less = min(noise.translation_per_sqrt_m, max(self.noise_per_sqrt_m, least))
        return settings.model_copy(
            update={"wheels_imu_noise": noise.model_copy(update={"translation_per_sqrt_m": less})}
        )


UNCALIBRATED = WheelCalibration()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WayByScans:
    """Matched poses (N, 3, 3), the information (N, 3, 3) of each in its local map, and the scans that are keyframes."""

    poses: FloatArray
    information: FloatArray
    keyframes: IntArray


def calibrate_wheels(
    shown: WayByScans, odometry: OdometryEstimate, prediction_sigma_m: float, settings: WheelCalibrationSettings
) -> WheelCalibration:
    """Compare the way of the wheels, that of `odometry` (N), with that of matched scans, where these show it.

    A scan shows how far the robot came where its own information along the way exceeds that of the prediction, odometry
    and `prediction_sigma_m`: in a corridor, and on a ramp, it only repeats the odometry. Scale by robust regression
    (Huber) over windows of way, whose variance grows with their length. Unknown where too little of the way counts.
    """
    found, wheels = _ways(shown, odometry, prediction_sigma_m)
    window = np.floor(np.cumsum(wheels) / settings.window_m).astype(np.int64)
    a, o = np.bincount(window, found), np.bincount(window, wheels)
    a, o = a[o > 0.5 * settings.window_m], o[o > 0.5 * settings.window_m]
    if wheels.sum() < settings.way_min_m or len(o) < 3:
        return UNCALIBRATED
    scale = float(np.median(a / o))
    for _ in range(20):
        error = (a - scale * o) / np.sqrt(o)
        spread = max(1.4826 * float(np.median(np.abs(error))), 1e-6)
        weight = np.minimum(1.0, 1.345 * spread / np.maximum(np.abs(error), 1e-12))
        scale = float(np.sum(weight * a) / np.sum(weight * o))
    # not the median alone: wheels that slip now and then are not even
    noise = float(np.sqrt(np.mean(np.minimum(np.abs(error), 4 * spread) ** 2)))
    if abs(scale - 1.0) > settings.scale_max:
        return UNCALIBRATED
    return WheelCalibration(scale=scale, sigma=noise / float(np.sqrt(o.sum())), noise_per_sqrt_m=noise)


def _ways(shown: WayByScans, odometry: OdometryEstimate, prediction_sigma_m: float) -> tuple[FloatArray, FloatArray]:
    """Way (M,) by scans and by wheels between the neighbouring keyframes where all scans show it, wheels forwards."""
    variance = np.linalg.inv(shown.information[1:])[:, 0, 0]
    known = np.concatenate([[0], np.cumsum(variance < odometry.covariance[:, 0, 0] + prediction_sigma_m**2)])
    start, end = shown.keyframes[:-1], shown.keyframes[1:]
    by_scans, by_wheels = (
        SE2.log(SE2.between(poses[start], poses[end])) for poses in (shown.poses, odometry.trajectory.poses)
    )
    usable = (known[end] - known[start] == end - start) & (np.abs(by_wheels[:, 2]) < TURN_MAX_RAD)
    direction = np.sign(by_wheels[usable, 0])
    return direction * by_scans[usable, 0], direction * by_wheels[usable, 0]
