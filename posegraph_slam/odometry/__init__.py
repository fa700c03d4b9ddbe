"""Motion between scans from what the robot measured of itself."""

from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.gyro_bias import GyroBias, estimate_gyro_bias
from posegraph_slam.odometry.scan_odometry import chosen_source, odometry_at_scans
from posegraph_slam.odometry.settings import GyroBiasSettings, OdometrySettings, StepNoise
from posegraph_slam.odometry.wheel_imu import wheel_imu_odometry

__all__ = [
    "GyroBias",
    "GyroBiasSettings",
    "OdometryEstimate",
    "OdometrySettings",
    "StepNoise",
    "chosen_source",
    "estimate_gyro_bias",
    "odometry_at_scans",
    "wheel_imu_odometry",
]
