"""A world of ramps: the robot stands on its ground, its sensors feel the slope, and beams end at solid things."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from posegraph_slam.datasets.simulation import (
    EncoderSettings,
    ImuSettings,
    KinectSettings,
    LidarSettings,
    RampSettings,
    WorldSettings,
    ramp_settings,
    simulate_run,
)
from posegraph_slam.datasets.simulation.route import rotation_on_ground
from posegraph_slam.datasets.simulation.streams import lidar_poses
from posegraph_slam.datasets.simulation.terrain import patch_height
from posegraph_slam.geometry import SO3

QUIET = {
    "world": WorldSettings(kind="ramps", ramps=RampSettings(ceiling_m=1.4)),
    "encoders": EncoderSettings(sigma_scale=0, sigma_slip_m=0),
    "imu": ImuSettings(
        sigma_bias_rad_s=0, sigma_gyro_rad_s=0, sigma_scale=0, sigma_walk_rad_s=0, sigma_accelerometer_g=0,
        sigma_accelerometer_bias_g=0, missing_tail_s=0,
    ),
    "lidar": LidarSettings(beams=109, sigma_range_m=0, dropout_rate=0, no_return_rate=0, antennae=True),
}  # fmt: skip


@pytest.fixture(scope="module", params=[1, 2])
def quiet(request):
    return simulate_run(ramp_settings(seed=request.param, **QUIET))


def test_truth_climbs_slopes_of_18_to_20_degrees(quiet):
    poses = quiet.truth().poses
    slope = np.degrees(np.arcsin(poses[:, 2, 0]))
    assert np.ptp(poses[:, 2, 3]) > 0.35
    assert 17.5 < slope.max() <= 20.01
    assert -20.01 <= slope.min() < -17.5
    level = np.abs(slope) < 0.01
    gaps = np.abs(poses[level, 2, 3][:, None] - quiet.world.terrain.levels_m).min(axis=1)
    assert gaps.max() < 1e-3


def test_robot_stands_on_the_ground_of_the_world(quiet):
    poses = quiet.truth().poses
    ground = patch_height(quiet.world.terrain.patches, poses[:, :2, 3])
    assert np.abs(poses[:, 2, 3] - ground).max() < 0.02  # edges are rounded


def test_gradient_is_the_slope_of_the_height(quiet):
    terrain, points, step = quiet.world.terrain, quiet.motion.path.position_m[::50], 1e-5
    _, gradient = terrain.ground(points)
    for axis in range(2):
        shift = np.eye(2)[axis] * step
        slope = (terrain.ground(points + shift)[0] - terrain.ground(points - shift)[0]) / (2 * step)
        np.testing.assert_allclose(gradient[:, axis], slope, atol=1e-6)


def test_rotation_on_ground_is_a_rotation_over_the_heading():
    rng = np.random.default_rng(1)
    heading, gradient = rng.uniform(-3, 3, 50), rng.uniform(-0.5, 0.5, (50, 2))
    R = rotation_on_ground(heading, gradient)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(np.arctan2(R[:, 1, 0], R[:, 0, 0]), heading, atol=1e-12)
    normal = np.column_stack([-gradient, np.ones(50)])
    np.testing.assert_allclose(np.cross(R[:, :, 2], normal), 0.0, atol=1e-12)


def test_exact_wheels_roll_the_way_in_space(quiet):
    poses = quiet.motion.spatial_poses_at(np.linspace(0, quiet.motion.end_s, 20000))
    way = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    assert abs(quiet.counts.sum() * 0.0022 / 4 - way) < 0.02


def test_exact_gyro_integrates_to_the_attitude(quiet):
    times, R = quiet.imu_times_s, np.eye(3)
    truth = quiet.motion.spatial_poses_at(times)[:, :3, :3]
    R = truth[0]
    steps = SO3.exp(0.5 * (quiet.angular_velocity[1:] + quiet.angular_velocity[:-1]) * np.diff(times)[:, None])
    for step in steps:
        R = R @ step
    assert np.degrees(np.linalg.norm(SO3.log(R.T @ truth[-1]))) < 0.3


def test_exact_accelerometer_shows_the_acceleration_in_space(quiet):
    at = quiet.imu_times_s[(quiet.imu_times_s > 5) & (quiet.imu_times_s < quiet.motion.end_s - 3)]
    h = 0.06
    p = [quiet.motion.spatial_poses_at(at + shift) for shift in (-h, 0.0, h)]
    felt = (p[0][:, :3, 3] - 2 * p[1][:, :3, 3] + p[2][:, :3, 3]) / h**2 + [0, 0, 9.80665]
    in_body = np.einsum("nji,nj->ni", p[1][:, :3, :3], felt)
    measured = quiet.acceleration_g[np.isin(quiet.imu_times_s, at)] * 9.80665
    assert np.median(np.abs(in_body - measured)) < 0.02


def heights(run, points):
    """Height above the ground and below the ceiling."""
    ground = points[:, 2] - patch_height(run.world.terrain.patches, points[:, :2])
    return ground, run.world.terrain.ceiling_m - points[:, 2]


def gap_to_walls(run, points):
    """Distance in the plan view to the nearest obstacle."""
    a, along = run.world.segments[:, :2], run.world.segments[:, 2:] - run.world.segments[:, :2]
    u = np.clip(((points[:, None, :2] - a) * along).sum(-1) / (along**2).sum(-1), 0, 1)
    gap = np.linalg.norm(points[:, None, :2] - a - u[..., None] * along, axis=-1).min(axis=1)
    if len(run.world.circles):
        rim = np.linalg.norm(points[:, None, :2] - run.world.circles[:, :2], axis=-1) - run.world.circles[:, 2]
        gap = np.minimum(gap, np.abs(rim).min(axis=1))
    return gap


def test_beams_end_at_walls_ground_or_ceiling_and_pass_through_none(quiet):
    rows = np.arange(0, len(quiet.lidar_times_s), 11)
    T = lidar_poses(quiet.motion, quiet.lidar_times_s[rows], quiet.settings.lidar)[:, 0]
    bearings = np.linspace(-2.356194490192345, 2.356194490192345, 109)
    ranges = quiet.ranges_m[rows].astype(np.float64)
    rays = np.einsum("nij,bj->nbi", T[:, :3, :2], np.stack([np.cos(bearings), np.sin(bearings)], axis=1))
    hit = (ranges > 0.3) & (ranges < 30)
    assert hit.mean() > 0.9
    ends = T[:, None, :3, 3] + ranges[..., None] * rays
    ground, ceiling = heights(quiet, ends[hit])
    assert np.minimum(np.minimum(np.abs(ground), np.abs(ceiling)), gap_to_walls(quiet, ends[hit])).max() < 0.003
    assert (np.abs(ground) < 0.003).sum() > 20
    assert (np.abs(ceiling) < 0.003).sum() > 20
    for share in np.linspace(0.05, 0.95, 19):
        between = T[:, None, :3, 3] + (share * ranges)[..., None] * rays
        ground, ceiling = heights(quiet, between[hit])
        assert ground.min() > -0.003
        assert ceiling.min() > -0.003


def test_antennae_are_seen_in_every_scan_at_one_range(quiet):
    near = quiet.ranges_m < 0.3
    always = near.all(axis=0)
    assert 2 <= always.sum() <= 12
    assert np.ptp(quiet.ranges_m[:, always], axis=0).max() < 1e-6


def test_impossible_ramps_and_images_are_refused():
    with pytest.raises(ValidationError, match="does not fit"):
        WorldSettings(kind="ramps", ramps=RampSettings(rise_max_m=3.0))
    with pytest.raises(ValidationError, match="above rise_max_m"):
        RampSettings(rise_min_m=1.0)
    with pytest.raises(ValidationError, match="images are not rendered"):
        ramp_settings(kinect=KinectSettings())
