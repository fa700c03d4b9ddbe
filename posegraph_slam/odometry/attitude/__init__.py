"""Orientation from gyro and accelerometer: quaternion UKF and simpler baselines."""

from posegraph_slam.odometry.attitude.estimate import AttitudeEstimate, estimate_attitude
from posegraph_slam.odometry.attitude.reference_calibration import calibrate_against_reference, clock_offset
from posegraph_slam.odometry.attitude.settings import AttitudeMethod, AttitudeSettings
from posegraph_slam.odometry.attitude.ukf import AttitudeState, predict, run_ukf, update

__all__ = [
    "AttitudeEstimate",
    "AttitudeMethod",
    "AttitudeSettings",
    "AttitudeState",
    "calibrate_against_reference",
    "clock_offset",
    "estimate_attitude",
    "predict",
    "run_ukf",
    "update",
]
