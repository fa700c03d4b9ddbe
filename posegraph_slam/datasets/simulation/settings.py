"""What to simulate: the floor, the drive, the sensors' rates and their errors."""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from posegraph_slam.settings import Settings

LANDING_M = 0.35
"""Level piece before and after each ramp, beside the corridors that it joins."""


class RampSettings(Settings):
    """Levels and ramps of a world of kind `ramps`."""

    rise_min_m: float = Field(0.4, gt=0, le=5, description="Least difference in height of neighbouring levels")
    rise_max_m: float = Field(0.9, gt=0, le=5, description="Largest difference in height of neighbouring levels")
    slope_min_deg: float = Field(18.0, ge=5, le=25, description="Least slope of a ramp")
    slope_max_deg: float = Field(20.0, ge=5, le=25, description="Largest slope of a ramp")
    ceiling_m: float = Field(2.4, ge=1, le=20, description="Height of the ceiling above the highest level")
    clutter_min_m: float = Field(0.8, gt=0, description="Least height of boxes and pillars above the ground")
    clutter_max_m: float = Field(1.8, gt=0, description="Largest height of boxes and pillars above the ground")

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        for name, unit in (("rise", "m"), ("slope", "deg"), ("clutter", "m")):
            low, high = getattr(self, f"{name}_min_{unit}"), getattr(self, f"{name}_max_{unit}")
            if low > high:
                raise ValueError(f"{name}_min_{unit} {low:g} is above {name}_max_{unit} {high:g}")
        return self


class WorldSettings(Settings):
    """The floor plan: blocks of rooms, two rooms deep, in a net of corridors."""

    kind: Literal["flat", "ramps"] = Field("flat", description="flat, or ramps: corridors on levels, joined by ramps")
    ramps: RampSettings = RampSettings()
    blocks_across: int = Field(1, ge=1, le=20, description="Blocks of rooms along x; more make a larger world")
    blocks_up: int = Field(1, ge=1, le=20, description="Blocks of rooms along y")
    rooms_across: int = Field(3, ge=1, le=10, description="Rooms along x in each block")
    room_width_m: float = Field(3.3, ge=2.5, le=20, description="Length of a room along x")
    room_depth_m: float = Field(2.8, ge=2.0, le=20, description="Length of a room along y")
    corridor_width_m: float = Field(1.9, ge=1.6, le=10, description="Distance between the walls of a corridor")
    door_width_m: float = Field(1.1, ge=1.0, le=2.0, description="Clear width of a door")
    passable_fraction: float = Field(0.7, ge=0, le=1, description="Share of room pairs with a door between the two")
    clutter: float = Field(1.0, ge=0, le=2, description="Boxes, pillars and tables, relative to the usual number")

    @model_validator(mode="after")
    def _check_ramps(self) -> Self:
        length = self.ramps.rise_max_m / float(np.tan(np.radians(self.ramps.slope_min_deg)))
        room = 2 * (self.room_depth_m - LANDING_M)
        if self.kind == "ramps" and length > room:
            raise ValueError(
                f"a ramp of {length:.1f} m does not fit into the {room:.1f} m between two corridors; lower rise_max_m, "
                "raise slope_min_deg or room_depth_m"
            )
        return self


class DriveSettings(Settings):
    """How the robot goes through the floor."""

    laps: float = Field(2.0, gt=0, le=1000, description="Length of the drive, in lengths of all corridors together")
    speed_m_s: float = Field(1.2, gt=0, le=3, description="Speed on a straight")
    yaw_rate_rad_s: float = Field(1.4, gt=0, le=4, description="Largest yaw rate; corners are taken at this rate")
    acceleration_m_s2: float = Field(0.6, gt=0, le=5, description="Acceleration and braking")
    wander_m: float = Field(0.06, ge=0, le=0.15, description="Standard deviation of the path about the centre line")
    still_s: float = Field(3.0, ge=0, le=60, description="Standing still before the drive")
    duration_s: float | None = Field(None, ge=1, description="Stop recording after this time; none: at the end")


class EncoderSettings(Settings):
    """Errors of the wheel encoders."""

    rate_hz: float = Field(40.0, gt=0, le=1000, description="Stamps a second")
    sigma_scale: float = Field(0.015, ge=0, le=0.2, description="Scale error, drawn once for each side")
    sigma_slip_m: float = Field(0.003, ge=0, le=0.1, description="Slip of each wheel after one metre (grows as root)")


class ImuSettings(Settings):
    """Errors of the inertial measurement unit."""

    rate_hz: float = Field(100.0, gt=0, le=2000, description="Stamps a second")
    sigma_bias_rad_s: float = Field(0.004, ge=0, le=0.2, description="Gyro bias, drawn once for each axis")
    sigma_gyro_rad_s: float = Field(0.005, ge=0, le=0.5, description="Noise of one gyro sample")
    sigma_scale: float = Field(0.01, ge=0, le=0.2, description="Scale error of the gyro, drawn once")
    sigma_walk_rad_s: float = Field(0.0003, ge=0, le=0.05, description="Walk of the gyro bias after one second")
    sigma_accelerometer_g: float = Field(0.003, ge=0, le=0.5, description="Noise of one accelerometer sample")
    sigma_accelerometer_bias_g: float = Field(0.005, ge=0, le=0.5, description="Its bias, drawn once for each axis")
    missing_tail_s: float = Field(1.0, ge=0, le=60, description="The stream ends this much before the others")


class LidarSettings(Settings):
    """Beams and errors of the laser scanner."""

    rate_hz: float = Field(10.0, gt=0, le=100, description="Scans a second; 40 as on the real robot")
    beams: int = Field(1081, ge=2, le=20000, description="Beams over 270 degrees")
    sigma_range_m: float = Field(0.01, ge=0, le=1, description="Noise of one range")
    dropout_rate: float = Field(0.005, ge=0, le=1, description="Share of ranges lost and reported as 0.001")
    no_return_rate: float = Field(0.005, ge=0, le=1, description="Share of beams that come back as 60")
    antennae: bool = Field(False, description="Two antennae behind the scanner, which it sees in every scan")
    sweep_s: float = Field(0.0, ge=0, le=0.2, description="Time from first to last beam; 0: all at the stamp")


class KinectSettings(Settings):
    """Frames and errors of the disparity and colour camera."""

    rate_hz: float = Field(1.5, gt=0, le=60, description="Frames a second of either camera")
    images: bool = Field(True, description="Render the frames and write the PNG files")
    missing_fraction: float = Field(0.03, ge=0, lt=1, description="Share of frames lost, on each clock alone")
    sigma_disparity: float = Field(0.3, ge=0, le=10, description="Noise of one disparity, in its own unit")
    range_min_m: float = Field(0.5, gt=0, description="Nothing nearer than this has a disparity")
    range_max_m: float = Field(6.0, gt=0, le=50, description="Nothing farther than this has a disparity")
    exposure_change: float = Field(0.0, ge=0, lt=1, description="Colour frames are up to this share brighter or darker")
    floor_resolution_m: float = Field(0.02, gt=0, le=1, description="Cell of the floor's texture and of floor.png")

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        if self.range_min_m >= self.range_max_m:
            raise ValueError(f"range_min_m {self.range_min_m:g} is not below range_max_m {self.range_max_m:g}")
        return self


class SimulationSettings(Settings):
    """One simulated log: a seed, a world, a drive and its sensors."""

    seed: int = Field(24, ge=0, description="Same seed and settings: same bytes in every file")
    number: int = Field(1, ge=0, description="Number in the names of the files")
    start_epoch_s: float = Field(1.7e9, ge=0, description="Stamp of the begin, seconds")
    world: WorldSettings = WorldSettings()
    drive: DriveSettings = DriveSettings()
    encoders: EncoderSettings = EncoderSettings()
    imu: ImuSettings = ImuSettings()
    lidar: LidarSettings = LidarSettings()
    kinect: KinectSettings = KinectSettings()

    @model_validator(mode="after")
    def _check_images(self) -> Self:
        if self.world.kind == "ramps" and self.kinect.images:
            raise ValueError("images are not rendered in a world of ramps: set kinect.images = false")
        return self


def demo_settings(**overrides: Any) -> SimulationSettings:
    """Return the settings of the built-in demo: two laps of a 14 m by 9 m floor, images included.

    `overrides` replace whole fields of `SimulationSettings`, for example `seed=7`.
    """
    return SimulationSettings(**overrides)


def ramp_settings(**overrides: Any) -> SimulationSettings:
    """Return the settings of a drive over ramps of 18 to 20 degrees, with antennae in view and without images.

    `overrides` replace whole fields of `SimulationSettings`, for example `seed=7`.
    """
    chosen = {
        "world": WorldSettings(kind="ramps"),
        "lidar": LidarSettings(antennae=True),
        "kinect": KinectSettings(images=False),
        **overrides,
    }
    return SimulationSettings(**chosen)


def tiny_settings(*, seed: int = 1, duration_s: float = 12.0, images: bool = False) -> SimulationSettings:
    """Return settings for unit tests: a few seconds, 361 beams, 5 scans a second, images on demand."""
    return SimulationSettings(
        seed=seed,
        drive=DriveSettings(duration_s=duration_s, still_s=2.0, laps=1.0),
        lidar=LidarSettings(beams=361, rate_hz=5.0),
        kinect=KinectSettings(images=images, rate_hz=0.5, floor_resolution_m=0.05),
    )
