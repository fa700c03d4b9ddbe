"""A simulated robot in an indoor world, with its truth."""

from posegraph_slam.datasets.simulation.files import simulate
from posegraph_slam.datasets.simulation.run import SimulatedRun, drive, simulate_run
from posegraph_slam.datasets.simulation.settings import (
    DriveSettings,
    EncoderSettings,
    ImuSettings,
    KinectSettings,
    LidarSettings,
    RampSettings,
    SimulationSettings,
    WorldSettings,
    demo_settings,
    ramp_settings,
    tiny_settings,
)

__all__ = [
    "DriveSettings",
    "EncoderSettings",
    "ImuSettings",
    "KinectSettings",
    "LidarSettings",
    "RampSettings",
    "SimulatedRun",
    "SimulationSettings",
    "WorldSettings",
    "demo_settings",
    "drive",
    "ramp_settings",
    "simulate",
    "simulate_run",
    "tiny_settings",
]
