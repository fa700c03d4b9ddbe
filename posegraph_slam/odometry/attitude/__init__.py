"""Orientation from gyro and accelerometer: quaternion UKF and simpler baselines."""

from posegraph_slam.odometry.attitude.estimate import AttitudeEstimate, estimate_attitude
from posegraph_slam.odometry.attitude.settings import AttitudeMethod, AttitudeSettings
from posegraph_slam.odometry.attitude.ukf import AttitudeState, predict, run_ukf, update

__all__ = [
    "AttitudeEstimate",
    "AttitudeMethod",
    "AttitudeSettings",
    "AttitudeState",
    "estimate_attitude",
    "predict",
    "run_ukf",
    "update",
]
