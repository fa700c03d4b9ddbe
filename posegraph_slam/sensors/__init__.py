"""What a robot records and how it is calibrated."""

from posegraph_slam.sensors.imu import STANDARD_GRAVITY, Imu, ImuCalibration
from posegraph_slam.sensors.laser import LaserScans
from posegraph_slam.sensors.rgbd import DisparityCalibration, RgbdFrames
from posegraph_slam.sensors.rgbd_sequence import PinholeCamera, RgbdSequence
from posegraph_slam.sensors.robot_log import RobotLog
from posegraph_slam.sensors.wheels import WheelEncoders

__all__ = [
    "STANDARD_GRAVITY",
    "DisparityCalibration",
    "Imu",
    "ImuCalibration",
    "LaserScans",
    "PinholeCamera",
    "RgbdFrames",
    "RgbdSequence",
    "RobotLog",
    "WheelEncoders",
]
