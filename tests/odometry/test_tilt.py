"""Roll, pitch, heading and height of a wheeled robot on ramps, and its scans made level."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from posegraph_slam.datasets.simulation import DriveSettings, ImuSettings, LidarSettings, drive, ramp_settings
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.attitude import euler_rpy
from posegraph_slam.geometry import Trajectory, inverse_pose
from posegraph_slam.odometry import OdometrySettings, wheel_imu_odometry
from posegraph_slam.odometry.levelling import LevellingSettings, level_laser
from posegraph_slam.odometry.spatial import SpatialOdometrySettings, spatial_odometry_at_scans
from posegraph_slam.odometry.tilt import TiltSettings, estimate_tilt, without_heading
from posegraph_slam.sensors import LaserScans

LIDAR = LidarSettings(beams=271, antennae=True)


@pytest.fixture(scope="module", params=[1, 6])
def log(request):
    return drive(ramp_settings(seed=request.param, lidar=LIDAR))


@pytest.fixture(scope="module")
def odometry(log):
    return spatial_odometry_at_scans(log, OdometrySettings(), SpatialOdometrySettings())


def tilt_errors(log, settings):
    """Errors (N, 2) of roll and pitch in degrees at the scans."""
    tilt = estimate_tilt(log.encoders, log.imu, settings)
    found = euler_rpy(tilt.at(log.scans.stamps_s))[:, :2]
    return np.degrees(found - euler_rpy(without_heading(log.truth.poses[:, :3, :3]))[:, :2])


def test_tilt_of_a_robot_on_ramps(log):
    errors = tilt_errors(log, TiltSettings())
    assert np.sqrt((errors**2).mean(axis=0)).max() < 0.3
    assert np.abs(errors).max() < 1.5


def test_acceleration_of_the_wheels_and_the_level_start_both_help():
    log = drive(ramp_settings(seed=2, lidar=LIDAR, imu=ImuSettings(sigma_accelerometer_bias_g=0.02)))
    best, plain, tilted = (
        np.sqrt((tilt_errors(log, TiltSettings(**change)) ** 2).mean())
        for change in ({}, {"wheel_acceleration": False}, {"level_start": False})
    )
    assert best < 0.6 * plain
    assert best < 0.4 * tilted


def test_a_start_at_an_even_acceleration_is_not_taken_for_a_tilt():
    log = drive(ramp_settings(seed=11, lidar=LIDAR, drive=DriveSettings(still_s=0.0)))
    errors = tilt_errors(log, TiltSettings())
    assert np.sqrt((errors**2).mean()) < 0.6


def test_a_noisy_accelerometer_still_shows_its_bias_at_the_start():
    noisy = ImuSettings(sigma_accelerometer_g=0.05, sigma_accelerometer_bias_g=0.02, sigma_gyro_rad_s=0.02)
    log = drive(ramp_settings(seed=4, lidar=LIDAR, imu=noisy))
    assert np.sqrt((tilt_errors(log, TiltSettings()) ** 2).mean()) < 0.4


def test_sigma_of_the_tilt_covers_its_error(log, odometry):
    errors = np.radians(tilt_errors(log, TiltSettings()))
    assert (np.abs(errors).max(axis=1) < 3 * odometry.tilt_sigma_rad).mean() > 0.97


def test_a_start_on_a_slope_is_not_taken_off(log):
    accel = log.imu.linear_acceleration @ np.array([[0.94, 0, 0.342], [0, 1, 0], [-0.342, 0, 0.94]])
    imu = dataclasses.replace(log.imu, linear_acceleration=accel)
    tilt = estimate_tilt(log.encoders, imu, TiltSettings())
    assert "taken for a slope" in tilt.remarks[0]
    assert abs(np.degrees(euler_rpy(tilt.rotations[:1])[0, 1])) > 15


def test_heights_follow_the_ramps(log, odometry):
    error = odometry.trajectory.poses[:, 2, 3] - log.truth.poses[:, 2, 3]
    assert np.ptp(log.truth.poses[:, 2, 3]) > 0.4
    assert np.abs(error).max() < 0.15


def test_plan_view_is_shorter_than_the_way_and_the_flat_one_is_not(log):
    true_m = np.linalg.norm(np.diff(log.truth.poses[:, :2, 3], axis=0), axis=1).sum()
    flat = wheel_imu_odometry(log.encoders, log.imu).trajectory.path_length_m
    tilt = estimate_tilt(log.encoders, log.imu, TiltSettings())
    level = wheel_imu_odometry(log.encoders, log.imu, tilt=tilt).trajectory.path_length_m
    slopes = np.linalg.norm(np.diff(log.truth.positions, axis=0), axis=1).sum() - true_m
    assert slopes > 0.1
    assert flat - level == pytest.approx(slopes, rel=0.1)


def test_lifting_the_plan_view_gives_the_odometry_back(odometry):
    planar = odometry.plan_view(odometry.trajectory)
    np.testing.assert_allclose(planar.poses, odometry.planar.trajectory.poses, atol=1e-9)
    np.testing.assert_allclose(odometry.lift(planar).poses, odometry.trajectory.poses, atol=1e-9)


def test_ground_and_ceiling_are_dropped_on_ramps_and_walls_elsewhere_kept(log, odometry):
    level = level_laser(log.scans, odometry, LevellingSettings(self_returns={"enabled": False})).scans
    slope = np.abs(log.truth.poses[:, 2, 0])
    on_ramp, far = np.flatnonzero(slope > 0.2), np.flatnonzero(np.abs(log.truth.poses[:, 1, 3]) < 0.3)
    kept, raw = ([scans.returns(rows).sum() for rows in (on_ramp, far)] for scans in (level, log.scans))
    assert 0.4 * raw[0] < kept[0] < 0.95 * raw[0]
    assert kept[1] > 0.97 * raw[1]


def test_ground_is_known_from_nearby_way_while_odometry_drifts(log, odometry):
    """A drift in height by which later laps pass over the earlier ones must not hide walls, nor show the ramps."""
    travel = odometry.travel_m
    drifted = odometry.trajectory.poses.copy()
    drifted[:, 2, 3] += np.linspace(0.0, 1.2, len(travel))
    bent = dataclasses.replace(odometry, trajectory=odometry.trajectory.with_poses(drifted))
    settings = LevellingSettings(ground_way_m=6.0, self_returns={"enabled": False})
    right = level_laser(log.scans, odometry, settings).scans.returns()
    near = level_laser(log.scans, bent, settings).scans.returns()
    everywhere = level_laser(log.scans, bent, settings.model_copy(update={"ground_way_m": 1e6})).scans.returns()
    assert np.mean(near != right) < 0.5 * np.mean(everywhere != right)
    optimised = level_laser(log.scans, bent, settings, path=odometry.trajectory).scans.returns()
    assert np.mean(optimised != right) < 0.02


def test_levelling_a_level_scan_changes_nothing(odometry, log):
    still = Trajectory(
        stamps_s=log.scans.stamps_s, poses=np.tile(np.eye(4), (len(log.scans), 1, 1)), parent="odom", child="base"
    )
    flat = dataclasses.replace(odometry, trajectory=still)
    settings = LevellingSettings(ground_reach_m=0.0, self_returns={"enabled": False})
    level = level_laser(log.scans, flat, settings).scans
    returns = log.scans.returns()
    np.testing.assert_allclose(level.ranges_m[returns], log.scans.ranges_m[returns], atol=1e-5)
    np.testing.assert_array_equal(level.returns(), returns)


def test_levelled_points_of_a_known_tilt(odometry, log):
    """A post straight ahead and one aside, seen at a pitch of 19 degrees."""
    pitch = np.radians(-19.0)
    R = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    poses = np.tile(np.eye(4), (1, 1, 1))
    poses[0, :3, :3] = R
    angles = np.linspace(-np.pi / 2, np.pi / 2, 181)
    ranges = np.zeros((1, 181), dtype=np.float32)
    ranges[0, [0, 90, 180]] = [4.0, 2.0, 30.0]
    scans = LaserScans(
        stamps_s=np.zeros(1), ranges_m=ranges, angle_min_rad=float(angles[0]), angle_increment_rad=float(np.pi / 180),
        range_min_m=0.1, range_max_m=40.0, T_base_lidar=np.eye(4),
    )  # fmt: skip
    at = dataclasses.replace(
        odometry, trajectory=Trajectory(stamps_s=np.zeros(1), poses=poses, parent="odom", child="base"),
        travel_m=np.zeros(1), tilt_sigma_rad=np.zeros(1), T_base_lidar=np.eye(4),
        planar=dataclasses.replace(
            odometry.planar, trajectory=odometry.planar.trajectory.select(np.arange(1)), covariance=np.zeros((0, 3, 3))
        ),
    )  # fmt: skip
    settings = LevellingSettings(ground_reach_m=0.0, box_above_m=0.7)
    level = level_laser(scans, at, settings).scans.ranges_m[0]
    assert level[90] == pytest.approx(2.0 * np.cos(pitch), abs=1e-5)
    assert level[0] == pytest.approx(4.0, abs=1e-5)
    low = level_laser(scans, at, settings.model_copy(update={"box_above_m": 0.6})).scans.ranges_m[0]
    assert low[90] == 0.0  # 2 m ahead and 0.65 m up: the ceiling, as far as the box goes


@pytest.mark.parametrize(("stream", "message"), [("imu", "has no IMU"), ("encoders", "has no wheel encoders")])
def test_missing_streams_are_named(log, stream, message):
    with pytest.raises(InputError, match=message):
        spatial_odometry_at_scans(
            dataclasses.replace(log, **{stream: None}), OdometrySettings(), SpatialOdometrySettings()
        )


def test_the_gyro_may_end_early(log):
    late = drive(ramp_settings(seed=1, lidar=LIDAR, imu=ImuSettings(missing_tail_s=3.0)))
    odometry = spatial_odometry_at_scans(late, OdometrySettings(), SpatialOdometrySettings())
    relative = inverse_pose(odometry.trajectory.poses) @ late.truth.poses
    assert np.linalg.norm(relative[:, :3, 3], axis=1).max() < 1.5
