"""Configuration of the attitude filters."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from posegraph_slam.settings import Settings

AttitudeMethod = Literal["smoother", "ukf", "complementary", "gyro"]


class AttitudeSettings(Settings):
    """Noise of gyro and accelerometer as the filter believes it, and how the start is recognised.

    The accelerometer shows the vertical only as far as the body does not accelerate: its sigma is that of unmodelled
    motion (0.1 g tilts it by 0.1 rad), which dwarfs the sensor's own 0.005 rad. Motion lasts longer than one sample: a
    hand's for some 0.03 s, so that three samples at 100 Hz tell what one at 33 Hz does, and no more. The size |a|
    shows only the vertical part of that motion: where it is off by 0.02, the direction may be by far more.
    """

    gyro_noise_rad_per_sqrt_s: float = Field(default=0.005, gt=0, description="rad of sigma after 1 s, white noise")
    gyro_noise_rad_per_sqrt_rad: float = Field(
        default=0.02, ge=0, description="rad of sigma after turning 1 rad: errors of gain and axes"
    )
    unknown_rate_rad_per_sqrt_s: float = Field(
        default=0.3, gt=0, description="rad of sigma after 1 s in which the gyro says nothing (NaN, or a gap)"
    )
    bias_walk_rad_s_per_sqrt_s: float = Field(default=2e-5, gt=0, description="rad/s of bias sigma gained in 1 s")
    still_bias_sigma_rad_s: float = Field(default=3e-4, gt=0, description="least sigma of a bias from a still start")
    unknown_bias_sigma_rad_s: float = Field(default=0.02, gt=0, description="sigma of the bias without a still start")
    accelerometer_sigma_rad: float = Field(default=0.1, gt=0, description="sigma of the vertical where |a| is g")
    accelerometer_lasting_s: float = Field(
        default=0.03, ge=0, description="how long its error lasts; samples within this time share the weight of one"
    )
    accelerometer_excess_factor: float = Field(
        default=5.0, ge=0, description="growth of that sigma with | |a|/g - 1 |, added in squares"
    )
    max_excess: float = Field(default=0.3, gt=0, description="| |a|/g - 1 | beyond which the accelerometer is ignored")
    start_tilt_sigma_rad: float = Field(default=0.02, gt=0, description="sigma of roll and pitch at a still start")
    moving_tilt_sigma_rad: float = Field(default=0.2, gt=0, description="sigma of roll and pitch at a moving start")
    start_heading_sigma_rad: float = Field(
        default=1e-3, gt=0, description="sigma of the heading at the start, which defines heading zero"
    )
    still_rate_rad_s: float = Field(default=0.06, gt=0, description="a still start ends where the rate leaves its mean")
    still_acceleration_m_s2: float = Field(default=0.4, gt=0, description="or the acceleration its mean, by this much")
    min_still_s: float = Field(default=0.5, gt=0, description="a shorter still start does not count")
    max_gap_s: float = Field(default=0.5, gt=0, description="over longer gaps the gyro is not integrated")
    complementary_time_s: float = Field(default=2.0, gt=0, description="time constant of the complementary filter")
