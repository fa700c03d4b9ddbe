"""Configuration of odometry: which source, how still stretches are found, and how noise grows."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from posegraph_slam.settings import Settings

OdometrySource = Literal["auto", "logged", "wheels_imu", "wheels", "none"]


class StepNoise(Settings):
    """Noise of a motion as a random walk: variances grow linearly with distance and turn, however finely it is cut.

    A motion of d metres and a radians has a translation variance, along and across, of
    translation_per_sqrt_m^2 d + translation_per_sqrt_rad^2 a + floor_m^2, and likewise its heading.
    """

    translation_per_sqrt_m: float = Field(default=0.03, gt=0, description="m of position sigma after driving 1 m")
    translation_per_sqrt_rad: float = Field(default=0.01, ge=0, description="m of position sigma after turning 1 rad")
    rotation_per_sqrt_rad: float = Field(default=0.02, gt=0, description="rad of heading sigma after turning 1 rad")
    rotation_per_sqrt_m: float = Field(default=0.005, ge=0, description="rad of heading sigma after driving 1 m")
    floor_m: float = Field(default=1e-3, gt=0, description="m of position sigma of a step without motion")
    floor_rad: float = Field(default=5e-4, gt=0, description="rad of heading sigma of a step without motion")


class GyroBiasSettings(Settings):
    """How stretches without motion are found, from which the gyro's bias is estimated."""

    min_still_s: float = Field(default=1.0, gt=0, description="shortest stretch without motion that counts, s")
    margin_s: float = Field(default=0.2, ge=0, description="cut from both ends of a stretch: motion below one tick, s")
    max_gyro_std_rad_s: float = Field(default=0.03, gt=0, description="a livelier gyro means that the robot moved")
    max_bias_rad_s: float = Field(default=0.2, gt=0, description="a larger mean rate is a turn, not a bias")
    unknown_sigma_rad_s: float = Field(default=0.01, gt=0, description="bias sigma of a robot that never stood still")


class OdometrySettings(Settings):
    """Which odometry is used, and its noise."""

    source: OdometrySource = Field(
        default="auto", description="auto | logged | wheels_imu | wheels | none; auto takes the first that the log has"
    )
    gyro_bias: GyroBiasSettings = GyroBiasSettings()
    max_imu_gap_s: float = Field(default=0.1, gt=0, description="longer gaps of the gyro are bridged by the wheels, s")
    wheels_imu_noise: StepNoise = StepNoise()
    wheels_noise: StepNoise = StepNoise(rotation_per_sqrt_rad=0.15, rotation_per_sqrt_m=0.03)
    logged_noise: StepNoise = StepNoise(
        translation_per_sqrt_m=0.05, translation_per_sqrt_rad=0.02, rotation_per_sqrt_rad=0.15, rotation_per_sqrt_m=0.03
    )
    leap_rad: float = Field(default=0.8, gt=0, description="a logged step that turns more is not believed, rad")
    leap_m: float = Field(default=1.5, gt=0, description="a logged step that is longer is not believed, m")
    unknown_m_per_sqrt_s: float = Field(default=0.5, gt=0, description="m of position sigma after 1 s without odometry")
    unknown_rad_per_sqrt_s: float = Field(default=0.5, gt=0, description="rad of heading sigma after 1 s without it")
