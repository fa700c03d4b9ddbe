"""Simulated encoders, IMU and ranges tell the truth within the errors that were asked for."""

from __future__ import annotations

import numpy as np

from posegraph_slam.datasets.simulation import (
    EncoderSettings,
    ImuSettings,
    LidarSettings,
    SimulationSettings,
    drive,
    simulate_run,
    tiny_settings,
)
from posegraph_slam.datasets.simulation.raycast import cast_scans
from posegraph_slam.datasets.simulation.streams import lidar_increment, lidar_poses
from posegraph_slam.geometry import xyt_from_pose
from posegraph_slam.sensors import STANDARD_GRAVITY

EXACT = {
    "encoders": EncoderSettings(sigma_scale=0, sigma_slip_m=0),
    "imu": ImuSettings(
        sigma_bias_rad_s=0,
        sigma_gyro_rad_s=0,
        sigma_scale=0,
        sigma_walk_rad_s=0,
        sigma_accelerometer_g=0,
        sigma_accelerometer_bias_g=0,
    ),
    "lidar": LidarSettings(beams=61, rate_hz=5, sigma_range_m=0, dropout_rate=0, no_return_rate=0),
}


def dead_reckon(log):
    """Integrate wheels alone, one arc a step, in a plain loop."""
    x, y, theta, poses = 0.0, 0.0, 0.0, []
    for left, right in log.encoders.travel_m:
        turn, way = (right - left) / log.encoders.track_width_m, (left + right) / 2
        x, y = x + way * np.cos(theta + turn / 2), y + way * np.sin(theta + turn / 2)
        theta += turn
        poses.append((x, y, theta))
    return np.array(poses)


def test_exact_wheels_integrate_to_the_truth():
    settings = SimulationSettings(**EXACT)
    run = simulate_run(settings)
    log = run.log()
    truth = run.motion.xyt_at(run.encoder_times_s)
    error = dead_reckon(log) - truth
    # 2 ticks of four wheels: 4.4 mm over the track 0.75 m is 6 mrad, for ever bounded; positions drift with it
    assert np.abs(error[:, 2]).max() < 0.012
    assert np.abs(error[:, :2]).max() < 0.25
    ticks = log.encoders.ticks_left.sum(axis=0) * log.encoders.metres_per_tick
    last = run.encoder_times_s[-1:]
    way = run.motion.distance_at(last) - 0.375 * run.motion.heading_at(last)
    np.testing.assert_allclose(ticks, np.repeat(way, 2), atol=0.0045)


def test_slip_stays_within_its_bounds():
    settings = tiny_settings(duration_s=60.0)
    run = simulate_run(settings)
    log = run.log()
    rolled = log.encoders.travel_m.sum()
    way = 2 * run.motion.distance_at(run.encoder_times_s[-1:])[0]
    slip = settings.encoders
    assert abs(rolled / way - 1) < 4 * (slip.sigma_scale + slip.sigma_slip_m / np.sqrt(way))
    assert abs(rolled / way - 1) > 1e-5


def test_gyro_integrates_to_the_heading_and_gravity_is_up():
    run = simulate_run(SimulationSettings(**EXACT))
    log = run.log()
    stamps, rate = log.imu.stamps_s, log.imu.angular_velocity[:, 2]
    turned = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(stamps))])
    assert np.abs(turned - run.motion.heading_at(run.imu_times_s)).max() < 0.01
    np.testing.assert_allclose(log.imu.linear_acceleration[:, 2], STANDARD_GRAVITY)
    speed = np.cumsum(log.imu.linear_acceleration[:, 0]) * 0.01
    assert abs(speed.max() - 1.2) < 0.05


def test_bias_shows_in_the_still_begin_and_the_stream_ends_early():
    settings = SimulationSettings(lidar=EXACT["lidar"])
    log = drive(settings)
    still = log.imu.stamps_s < settings.start_epoch_s + settings.drive.still_s
    bias = log.imu.angular_velocity[still].mean(axis=0)
    assert (np.abs(bias) < 4 * settings.imu.sigma_bias_rad_s).all()
    assert abs(log.imu.angular_velocity[still, 2].std() - settings.imu.sigma_gyro_rad_s) < 0.001
    assert 0.9 < log.encoders.stamps_s[-1] - log.imu.stamps_s[-1] < 1.1
    assert (log.encoders.ticks_left[log.encoders.stamps_s < settings.start_epoch_s + settings.drive.still_s] == 0).all()
    for stream in (log.scans, log.encoders, log.imu):
        assert (np.diff(stream.stamps_s) > 0).all()


def test_ranges_have_the_noise_and_the_losses_asked_for():
    settings = tiny_settings(duration_s=40.0)
    run = simulate_run(settings)
    fan = np.array([-2.356194490192345, lidar_increment(settings.lidar)])
    poses = xyt_from_pose(lidar_poses(run.motion, run.lidar_times_s, settings.lidar))
    exact = cast_scans(poses, fan, 361, run.world.segments, run.world.circles)
    lost, no_return = run.ranges_m == np.float32(0.001), run.ranges_m == 60
    assert abs(lost.mean() - settings.lidar.dropout_rate) < 0.002
    assert abs(no_return.mean() - settings.lidar.no_return_rate) < 0.002
    error = (run.ranges_m - exact)[~lost & ~no_return]
    assert abs(error.std() - settings.lidar.sigma_range_m) < 0.0005
    assert abs(error.mean()) < 0.0005


def test_sweep_moves_the_beams_with_the_robot():
    swept, still = (
        simulate_run(SimulationSettings(**{**EXACT, "lidar": EXACT["lidar"].model_copy(update={"sweep_s": sweep})}))
        for sweep in (0.1, 0.0)
    )
    difference = np.abs(swept.ranges_m - still.ranges_m)
    standing = swept.lidar_times_s < 2.8
    assert difference[standing].max() < 0.0015
    assert difference[~standing].max() > 0.05


def test_seeds_and_parts_are_independent():
    base = tiny_settings()
    one, other = drive(base), drive(base.model_copy(update={"seed": 2}))
    assert one.truth.poses.shape != other.truth.poses.shape or (one.truth.poses != other.truth.poses).any()
    quiet = drive(base.model_copy(update={"imu": EXACT["imu"]}))
    np.testing.assert_array_equal(quiet.scans.ranges_m, one.scans.ranges_m)
    np.testing.assert_array_equal(quiet.encoders.ticks_left, one.encoders.ticks_left)
    assert (quiet.imu.angular_velocity != one.imu.angular_velocity).any()
