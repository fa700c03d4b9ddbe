"""The world can be driven, and beams end at its obstacles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.datasets.simulation import (
    DriveSettings,
    SimulationSettings,
    WorldSettings,
    simulate_run,
    tiny_settings,
)
from posegraph_slam.datasets.simulation.motion import drive_path
from posegraph_slam.datasets.simulation.raycast import cast_scans
from posegraph_slam.datasets.simulation.route import plan_path
from posegraph_slam.datasets.simulation.run import generator
from posegraph_slam.datasets.simulation.streams import lidar_poses
from posegraph_slam.datasets.simulation.world import build_world
from posegraph_slam.geometry import xyt_from_pose


def slow_ranges(pose, bearings, segments, circles):
    """Cast every beam against every obstacle: solve 2 x 2 systems and quadratics, one matrix for all."""
    directions = np.stack([np.cos(pose[2] + bearings), np.sin(pose[2] + bearings)], axis=1)
    best = np.full(len(bearings), np.inf)
    for k, d in enumerate(directions):
        for xa, ya, xb, yb in segments:
            system = np.array([[d[0], xa - xb], [d[1], ya - yb]])
            if abs(np.linalg.det(system)) > 1e-12:
                t, u = np.linalg.solve(system, [xa - pose[0], ya - pose[1]])
                if t >= 0 and -1e-12 <= u <= 1 + 1e-12:
                    best[k] = min(best[k], t)
        for x, y, radius in circles:
            offset = np.array([pose[0] - x, pose[1] - y])
            roots = np.roots([1.0, 2 * d @ offset, offset @ offset - radius**2])
            if np.isreal(roots).all() and roots.real.min() >= 0:
                best[k] = min(best[k], roots.real.min())
    return best


@given(seed=st.integers(0, 10**6), heading=st.floats(-40, 40))
def test_cast_agrees_with_a_slow_oracle(seed, heading):
    rng = np.random.default_rng(seed)
    segments, circles = (
        rng.uniform(-5, 5, (6, 4)),
        np.column_stack([rng.uniform(-5, 5, (3, 2)), rng.uniform(0.1, 1, 3)]),
    )
    pose = np.array([*rng.uniform(-2, 2, 2), heading])
    bearings = -2.356 + 0.15 * np.arange(32)
    cast = cast_scans(pose[None, None], np.array([-2.356, 0.15]), 32, segments, circles)[0]
    if (np.hypot(circles[:, 0] - pose[0], circles[:, 1] - pose[1]) > circles[:, 2]).all():
        np.testing.assert_allclose(cast, slow_ranges(pose, bearings, segments, circles), rtol=1e-7)


def test_sectors_of_a_still_sweep_equal_one_scan():
    world = build_world(WorldSettings(), np.random.default_rng(3))
    fan, pose = np.array([-2.356, 0.004]), np.array([0.1, 0.05, 7.0])
    once = cast_scans(pose[None, None], fan, 1081, world.segments, world.circles)
    sectors = cast_scans(np.tile(pose, (1, 27, 1)), fan, 1081, world.segments, world.circles)
    np.testing.assert_allclose(sectors, once, atol=1e-9)
    assert once.max() < 30


def test_no_beam_passes_a_wall():
    run = simulate_run(tiny_settings(duration_s=30.0))
    poses = xyt_from_pose(lidar_poses(run.motion, run.lidar_times_s[::15], run.settings.lidar)[:, 0])
    bearings = np.linspace(-2.356194490192345, 2.356194490192345, 361)
    ranges = run.ranges_m[::15].astype(np.float64)
    hit = ranges < 30
    assert hit.mean() > 0.95
    ranges = np.where(hit & (ranges > 0.1), ranges - 0.06, 0.0)  # six sigma
    angles = poses[:, 2:] + bearings
    ends = poses[:, None, :2] + ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    a, b = run.world.segments[:, :2], run.world.segments[:, 2:]

    def side(p, q, r):
        u, v = q - p, r - p
        return np.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    p, q = poses[:, None, None, :2], ends[:, :, None]
    crossed = (side(p, q, a) != side(p, q, b)) & (side(a, b, p) != side(a, b, q))
    assert not crossed.any()


@pytest.mark.parametrize(
    "world",
    [
        WorldSettings(),
        WorldSettings(clutter=2.0),
        WorldSettings(blocks_across=2, blocks_up=2, rooms_across=2),
        WorldSettings(rooms_across=1, passable_fraction=0, corridor_width_m=1.6, room_width_m=2.5, door_width_m=2.0),
    ],
)
def test_drive_keeps_clear_of_everything(world):
    for seed in range(3):
        settings = SimulationSettings(seed=seed, world=world, drive=DriveSettings(laps=3, wander_m=0.1))
        built = build_world(world, generator(settings, "world"))
        path = plan_path(built.plan, settings.drive, generator(settings, "route"))
        points = path.position_m[::10, None]
        a, along = built.segments[:, :2], built.segments[:, 2:] - built.segments[:, :2]
        u = np.clip(((points - a) * along).sum(-1) / (along**2).sum(-1), 0, 1)
        gap = np.linalg.norm(points - a - u[..., None] * along, axis=-1).min()
        if len(built.circles):
            round_gap = np.linalg.norm(points - built.circles[:, :2], axis=-1) - built.circles[:, 2]
            gap = min(gap, round_gap.min())
        assert gap > 0.33


def test_drive_starts_at_the_origin_ends_near_it_and_obeys_its_bounds():
    settings = SimulationSettings()
    world = build_world(settings.world, generator(settings, "world"))
    motion = drive_path(plan_path(world.plan, settings.drive, generator(settings, "route")), settings.drive)
    times = np.arange(0.0, motion.end_s, 0.05)
    xyt = motion.xyt_at(times)
    speed = np.linalg.norm(np.diff(xyt[:, :2], axis=0), axis=1) / 0.05
    np.testing.assert_allclose(xyt[times <= 3.0], 0.0, atol=1e-6)
    assert 0.2 < np.linalg.norm(xyt[-1, :2]) < 0.6
    assert speed.max() < settings.drive.speed_m_s * 1.01
    assert np.abs(np.diff(xyt[:, 2])).max() / 0.05 < settings.drive.yaw_rate_rad_s * 1.02
    assert np.abs(np.diff(speed)).max() / 0.05 < settings.drive.acceleration_m_s2 * 1.5
    # tangent to its path: the robot never slides sideways
    ahead = np.stack([np.cos(xyt[:-1, 2]), np.sin(xyt[:-1, 2])], axis=1)
    step = np.diff(xyt[:, :2], axis=0)
    assert np.abs(ahead[:, 0] * step[:, 1] - ahead[:, 1] * step[:, 0]).max() < 0.003


def test_more_laps_are_longer_and_revisit():
    settings = SimulationSettings()
    plan = build_world(settings.world, generator(settings, "world")).plan
    lengths = [
        plan_path(plan, DriveSettings(laps=laps), generator(settings, "route")).distance_m[-1] for laps in (1, 2, 4, 8)
    ]
    assert 1.6 < lengths[1] / lengths[0] < 2.8
    assert 3.4 < lengths[3] / lengths[1] < 4.6
    assert lengths[2] < lengths[3]
