"""The backward pass: against a batch solution, its consistency, and what it gains over the filter."""

from __future__ import annotations

import numpy as np

from posegraph_slam.datasets.simulation import LidarSettings, drive, ramp_settings
from posegraph_slam.evaluation.attitude import attitude_errors
from posegraph_slam.geometry import SO3, Trajectory, pose_from_rotation_translation
from posegraph_slam.odometry.attitude import AttitudeSettings, AttitudeState, estimate_attitude, run_ukf
from posegraph_slam.odometry.attitude.quaternions import rotation_from_wxyz
from posegraph_slam.odometry.attitude.ukf import smoothed
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu

NOISE = AttitudeSettings(
    gyro_noise_rad_per_sqrt_s=0.004,
    gyro_noise_rad_per_sqrt_rad=0.0,
    bias_walk_rad_s_per_sqrt_s=1e-3,
    accelerometer_sigma_rad=0.05,
    accelerometer_lasting_s=0.0,
    accelerometer_excess_factor=0.0,
    max_excess=10.0,
)
"""Exactly what `still_body` and `turning_body` do."""


def still_stream(seed, count=60, dt=0.05):
    """A body near level that hardly turns: rates (N, 3), accelerations (N, 3), steps (N,)."""
    rng = np.random.default_rng(seed)
    omega = 0.002 + rng.normal(0, 0.004 / np.sqrt(dt), (count, 3)) * 0.2
    accel = STANDARD_GRAVITY * (np.array([0, 0, 1.0]) + rng.normal(0, 0.02, (count, 3)) * [1, 1, 0])
    steps = np.full(count, dt)
    steps[0] = 0.0
    return steps, omega, accel


def batch_solution(dt, omega, accel, sigma0):
    """Turns and biases (N, 6) that minimise the linearised cost over all samples at once, by dense least squares.

    Unknowns are the turn in the world, small, and the bias; up in the body is [-pitch, roll, 1] to first order.
    """
    n = len(dt)
    rows, right, weights = [], [], []

    def add(row, value, sigma):
        rows.append(row), right.append(value), weights.append(1 / sigma)

    def unit(k, m):
        row = np.zeros(6 * n)
        row[6 * k + m] = 1.0
        return row

    for m in range(6):
        add(unit(0, m), 0.0, sigma0[m])
    for k in range(n):
        up = accel[k] / np.linalg.norm(accel[k])
        add(unit(k, 0), up[1], NOISE.accelerometer_sigma_rad)
        add(-unit(k, 1), up[0], NOISE.accelerometer_sigma_rad)
        if k == 0:
            continue
        for m in range(3):
            turned = unit(k, m) - unit(k - 1, m) + dt[k] * unit(k - 1, 3 + m)
            add(turned, omega[k, m] * dt[k], NOISE.gyro_noise_rad_per_sqrt_s * np.sqrt(dt[k]))
            walked = unit(k, 3 + m) - unit(k - 1, 3 + m)
            add(walked, 0.0, NOISE.bias_walk_rad_s_per_sqrt_s * np.sqrt(dt[k]))
    weight = np.array(weights)
    A = np.array(rows) * weight[:, None]
    x = np.linalg.lstsq(A, np.array(right) * weight, rcond=None)[0]
    return x.reshape(n, 6), np.linalg.inv(A.T @ A)


def test_smoothing_is_the_batch_solution():
    for seed in range(3):
        dt, omega, accel = still_stream(seed)
        sigma0 = np.array([0.02, 0.02, 0.01, 0.01, 0.01, 0.01])
        state = AttitudeState(quat_wxyz=np.array([1.0, 0, 0, 0]), gyro_bias=np.zeros(3), covariance=np.diag(sigma0**2))
        stream = run_ukf(state, dt, omega, accel, settings=NOISE)
        result = smoothed(stream, dt, omega, settings=NOISE)
        wanted, covariance = batch_solution(dt, omega, accel, sigma0)
        turns = SO3.log(rotation_from_wxyz(result.quat_wxyz))
        np.testing.assert_allclose(turns[:, :2], wanted[:, :2], atol=2e-4)
        np.testing.assert_allclose(result.gyro_bias, wanted[:, 3:], atol=2e-4)
        variances = np.diag(covariance).reshape(-1, 6)
        found = np.diagonal(result.covariance, axis1=1, axis2=2)
        np.testing.assert_allclose(found[:, [0, 1, 3, 4]], variances[:, [0, 1, 3, 4]], rtol=0.02)


def test_last_sample_stays_and_no_variance_grows():
    dt, omega, accel = still_stream(7)
    state = AttitudeState(quat_wxyz=np.array([1.0, 0, 0, 0]), gyro_bias=np.zeros(3), covariance=0.01**2 * np.eye(6))
    stream = run_ukf(state, dt, omega, accel, settings=NOISE)
    before = stream.covariance.copy()
    result = smoothed(stream, dt, omega, settings=NOISE)
    np.testing.assert_array_equal(result.quat_wxyz[-1], stream.quat_wxyz[-1])
    np.testing.assert_array_equal(stream.covariance, before)
    gained = np.diagonal(stream.covariance - result.covariance, axis1=1, axis2=2)
    assert gained.min() > -1e-12
    assert np.linalg.eigvalsh(result.covariance).min() > 0


def turning_body(seed, seconds=30.0, rate_hz=100.0):
    """A body that turns about all axes, with the noise of `NOISE`; its IMU and true poses."""
    rng = np.random.default_rng(seed)
    n, dt = int(seconds * rate_hz), 1 / rate_hz
    t = np.arange(n) * dt
    rates = (t > 2.0)[:, None] * np.sin(rng.uniform(0.4, 1.2, 3) * t[:, None] + rng.uniform(0, 6, 3)) * [1.0, 1.2, 0.8]
    R = np.empty((n, 3, 3))
    R[0] = np.eye(3)
    for k, step in enumerate(SO3.exp(0.5 * (rates[1:] + rates[:-1]) * dt)):
        R[k + 1] = R[k] @ step
    bias = 0.01 * rng.normal(size=3) + np.cumsum(rng.normal(0, 1e-3 * np.sqrt(dt), (n, 3)), axis=0)
    white = rng.normal(0, 0.004 / np.sqrt(dt), (n, 3))
    accel = STANDARD_GRAVITY * (R[:, 2] + rng.normal(0, 0.05, (n, 3)))
    imu = Imu(stamps_s=t, angular_velocity=rates + bias + white, linear_acceleration=accel, T_base_imu=np.eye(4))
    poses = pose_from_rotation_translation(R, np.zeros((n, 3)))
    return imu, Trajectory(stamps_s=t, poses=poses, parent="ref", child="base")


def test_smoother_is_consistent_and_better_than_the_filter():
    nees, ratio = [], []
    for seed in range(8):
        imu, truth = turning_body(seed)
        forward, both = (estimate_attitude(imu, NOISE, method=method) for method in ("ukf", "smoother"))
        errors = [attitude_errors(each.trajectory, truth, covariance=each.covariance) for each in (forward, both)]
        nees.append(errors[1].nees)
        ratio.append(errors[1].tilt_deg / errors[0].tilt_deg)
    assert 1.5 < np.mean(nees) < 4.5
    assert np.mean(ratio) < 0.75


def test_gaps_of_the_gyro_are_bridged_from_both_sides():
    imu, truth = turning_body(3)
    omega = imu.angular_velocity.copy()
    omega[1500:1600] = np.nan
    broken = Imu(
        stamps_s=imu.stamps_s, angular_velocity=omega, linear_acceleration=imu.linear_acceleration,
        T_base_imu=imu.T_base_imu,
    )  # fmt: skip
    tilts = {}
    for method in ("ukf", "smoother"):
        R = estimate_attitude(broken, NOISE, method=method).rotations[1500:1600, 2]
        tilts[method] = np.linalg.norm(R - truth.poses[1500:1600, 2, :3], axis=1).mean()
    assert tilts["smoother"] < tilts["ukf"]


def test_smoothing_halves_the_tilt_errors_of_a_robot_on_ramps():
    log = drive(ramp_settings(seed=1, lidar=LidarSettings(beams=2)))
    forward, both = (estimate_attitude(log.imu, method=method) for method in ("ukf", "smoother"))
    errors = [attitude_errors(each.trajectory, log.truth).tilt_deg for each in (forward, both)]
    assert errors[1] < 0.9 * errors[0]
