"""Wheels calibrated against scans: the scale and its error, what does not count, and when nothing is said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from posegraph_slam.geometry import SE2, Trajectory
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.settings import OdometrySettings
from posegraph_slam.odometry.wheel_calibration import (
    UNCALIBRATED,
    WayByScans,
    WheelCalibration,
    WheelCalibrationSettings,
    calibrate_wheels,
)
from posegraph_slam.sensors import WheelEncoders

STEP_M, SIGMA_M = 0.1, 0.01


def chain(steps):
    poses = [np.eye(3)]
    for step in SE2.exp(steps):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def drive(*, scale, noise=0.003, count=600, seed=0, shown=None, direction=1.0):
    """Scans and odometry of a winding drive whose wheels roll 1 / scale of the way; where not shown scans repeat it."""
    rng = np.random.default_rng(seed)
    steps = np.zeros((count, 3))
    steps[:, 0], steps[:, 2] = direction * STEP_M, 0.05 * np.sin(np.arange(count) / 20)
    wheels = steps.copy()
    wheels[:, 0] = (steps[:, 0] + noise * np.sqrt(STEP_M) * rng.normal(size=count)) / scale
    shown = np.ones(count, dtype=bool) if shown is None else shown
    matched = np.where(shown[:, None], steps, wheels)
    information = np.tile(np.diag([4e4, 4e4, 4e5]), (count + 1, 1, 1))
    information[1:][~shown, 0, 0] = 10.0
    trajectory = Trajectory(stamps_s=np.arange(count + 1.0), poses=chain(wheels), parent="odom", child="base")
    covariance = np.tile(np.diag([1e-5, 1e-5, 1e-6]), (count, 1, 1))
    odometry = OdometryEstimate(trajectory=trajectory, covariance=covariance, source="wheels_imu")
    scans = WayByScans(poses=chain(matched), information=information, keyframes=np.arange(0, count + 1, 3))
    return scans, odometry


def calibrated(*, min_way=10.0, **kinds):
    return calibrate_wheels(*drive(**kinds), SIGMA_M, WheelCalibrationSettings(way_min_m=min_way))


@settings(max_examples=20, deadline=None)
@given(scale=st.floats(0.92, 1.08), direction=st.sampled_from([-1.0, 1.0]))
def test_scale_of_the_way_is_found(scale, direction):
    found = calibrated(scale=scale, direction=direction)
    assert found.known
    assert abs(found.scale - scale) < 5 * found.sigma
    assert found.sigma < 1e-3
    assert found.noise_per_sqrt_m == pytest.approx(0.003, rel=0.6)


def test_sigma_is_that_of_the_errors():
    found = [calibrated(scale=1.02, seed=seed, count=400) for seed in range(60)]
    normal = np.array([(each.scale - 1.02) / each.sigma for each in found])
    assert 0.7 < np.sqrt(np.mean(normal**2)) < 1.4


def test_scans_that_only_repeat_the_wheels_do_not_count():
    shown = (np.arange(600) // 60) % 2 == 0
    scans, odometry = drive(scale=1.05, shown=shown)
    found = calibrate_wheels(scans, odometry, SIGMA_M, WheelCalibrationSettings())
    assert abs(found.scale - 1.05) < 0.002
    believed = WayByScans(
        poses=scans.poses, information=np.tile(np.diag([4e4, 4e4, 4e5]), (601, 1, 1)), keyframes=scans.keyframes
    )
    assert calibrate_wheels(believed, odometry, SIGMA_M, WheelCalibrationSettings()).scale < 1.045


def test_slips_now_and_then_bend_the_noise_and_not_the_scale():
    scans, odometry = drive(scale=1.01)
    steps = SE2.log(odometry.steps)
    steps[::120, 0] += 0.1  # the wheels spin: 5 of 60 m
    poses = chain(steps)
    slipped = OdometryEstimate(
        trajectory=odometry.trajectory.with_poses(poses), covariance=odometry.covariance, source="wheels_imu"
    )
    found = calibrate_wheels(scans, slipped, SIGMA_M, WheelCalibrationSettings())
    assert abs(found.scale - 1.01) < 0.002
    assert found.noise_per_sqrt_m > 1.3 * calibrated(scale=1.01).noise_per_sqrt_m


@pytest.mark.parametrize(
    "kinds",
    [
        {"scale": 1.02, "count": 90},
        {"scale": 1.02, "shown": np.arange(600) < 80},
        {"scale": 1.3},
    ],
    ids=["short drive", "hardly shown", "unbelievable"],
)
def test_what_the_log_does_not_show_is_left_alone(kinds):
    assert calibrated(**kinds) is UNCALIBRATED
    assert not UNCALIBRATED.known


def test_a_robot_that_stands_is_left_alone():
    scans, odometry = drive(scale=1.0, count=50, direction=0.0, noise=0.0)
    assert not calibrate_wheels(scans, odometry, SIGMA_M, WheelCalibrationSettings()).known


def test_encoders_and_noise_take_the_calibration():
    ticks = np.full((5, 2), 100)
    encoders = WheelEncoders(
        stamps_s=np.arange(5.0), ticks_left=ticks, ticks_right=ticks, metres_per_tick=0.002, track_width_m=0.7
    )
    found = WheelCalibration(scale=1.01, sigma=1e-4, noise_per_sqrt_m=0.004)
    np.testing.assert_allclose(found.applied(encoders).travel_m, 1.01 * encoders.travel_m)
    noise = OdometrySettings()
    assert found.noise(noise, 0.002).wheels_imu_noise.translation_per_sqrt_m == 0.004
    assert found.noise(noise, 0.01).wheels_imu_noise.translation_per_sqrt_m == 0.01
    assert UNCALIBRATED.noise(noise, 0.01).wheels_imu_noise.translation_per_sqrt_m == 0.03
    assert "1.0100" in found.remark
