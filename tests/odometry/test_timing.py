"""The lag of odometry and the duration of a sweep, on scans of a room cast beam by beam while the laser moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE2, Trajectory, pose_from_xyt
from posegraph_slam.mapping.occupancy import OccupancySettings, build_occupancy
from posegraph_slam.odometry.estimate import OdometryEstimate, diagonal_covariance
from posegraph_slam.odometry.scan_matching import ScanMatchingSettings
from posegraph_slam.odometry.timing import (
    TimingSettings,
    estimate_lag,
    estimate_timing,
    shifted,
    sweep_motion,
    turning_stretch,
    without_lag,
)
from posegraph_slam.registration.beam_scans import BeamScanSettings, prepare_beam_scans
from posegraph_slam.sensors import LaserScans

BEAMS, INCREMENT = 181, np.deg2rad(1.0)
CORNERS = np.array([[-4, -3], [5, -3], [5, 1], [3, 1], [3, 4], [-2, 4], [-2, 2], [-4, 2], [-4, -3]], dtype=float)
SETTINGS = TimingSettings(scans=300)


def path(stamps: FloatArray) -> FloatArray:
    """Planar poses [x, y, theta] of a laser that turns to and fro on a small circle; stamps count scans."""
    heading = 1.5 * np.sin(0.06 * stamps) + 0.3 * np.sin(0.21 * stamps)
    return np.stack([0.8 * np.cos(0.02 * stamps), 0.8 * np.sin(0.02 * stamps), heading], axis=-1)


def cast(xyt: FloatArray, bearing: FloatArray) -> FloatArray:
    """Ranges of rays (R,) from poses (R, 3) at `bearing` to the walls of the room."""
    angle = xyt[:, 2] + bearing
    d = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None]
    a, e = CORNERS[:-1][None] - xyt[:, None, :2], np.diff(CORNERS, axis=0)[None]
    det = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
    det = np.where(det == 0, 1e-300, det)
    along = (a[..., 0] * e[..., 1] - a[..., 1] * e[..., 0]) / det
    on = (a[..., 0] * d[..., 1] - a[..., 1] * d[..., 0]) / det
    return np.where((along > 0) & (on >= 0) & (on <= 1), along, np.inf).min(axis=1)


def from_walls(points: FloatArray) -> FloatArray:
    """Distance (P,) of points (P, 2) to the nearest line that a wall lies on."""
    walls = np.diff(CORNERS, axis=0)
    normals = np.stack([-walls[:, 1], walls[:, 0]], axis=1) / np.hypot(*walls.T)[:, None]
    return np.abs(np.einsum("pwi,wi->pw", points[:, None] - CORNERS[:-1], normals)).min(axis=1)


def room_scans(count: int, sweep: float, sigma_m: float = 0.01) -> LaserScans:
    """Scans of which beam b is cast (b + 1/2) / B - 1/2 sweeps after the scan's own time."""
    scan, beam = np.repeat(np.arange(count), BEAMS), np.tile(np.arange(BEAMS), count)
    ranges = cast(path(scan + sweep * ((beam + 0.5) / BEAMS - 0.5)), -np.pi / 2 + INCREMENT * beam)
    ranges += np.random.default_rng(1).normal(0, sigma_m, len(ranges)) if sigma_m else 0.0
    return LaserScans(
        stamps_s=0.1 * np.arange(count),
        ranges_m=ranges.reshape(count, BEAMS),
        angle_min_rad=-np.pi / 2,
        angle_increment_rad=INCREMENT,
        range_min_m=0.1,
        range_max_m=20.0,
        T_base_lidar=np.eye(4),
    )


def odometry_of(count: int, late: float = 0.0) -> OdometryEstimate:
    """True motion with a little noise, as it was `late` scans before each scan."""
    poses = pose_from_xyt(path(np.arange(count) - late))
    noise = np.random.default_rng(2).normal(0, [0.003, 0.003, 0.003], (count, 3))
    steps = SE2.retract(SE2.between(poses[:-1], poses[1:]), noise[1:])
    chain = [poses[0]]
    for step in steps:
        chain.append(chain[-1] @ step)
    return OdometryEstimate(
        trajectory=Trajectory(stamps_s=0.1 * np.arange(count), poses=np.array(chain), parent="odom", child="base"),
        covariance=diagonal_covariance(np.full(count - 1, 1e-5), np.full(count - 1, 1e-5)),
        source="logged",
    )


@pytest.mark.parametrize("sweep", [0.25, -0.25, 0.1])
def test_the_duration_of_a_sweep_is_found(sweep: float) -> None:
    scans = prepare_beam_scans(room_scans(300, sweep), BeamScanSettings())
    found = estimate_timing(scans, odometry_of(300), ScanMatchingSettings(), SETTINGS).sweep
    assert found.significant(SETTINGS)
    assert found.share == pytest.approx(sweep, rel=0.2)
    assert abs(found.share - sweep) < 5 * found.sigma + 0.02


def test_instant_scans_show_no_sweep_and_exact_odometry_no_lag() -> None:
    scans = prepare_beam_scans(room_scans(300, 0.0), BeamScanSettings())
    timing = estimate_timing(scans, odometry_of(300), ScanMatchingSettings(), SETTINGS)
    assert not timing.sweep.significant(SETTINGS)
    assert not timing.lag.significant(SETTINGS)


@pytest.mark.parametrize("late", [0.4, -0.6])
def test_the_lag_of_odometry_is_found_and_taken_away(late: float) -> None:
    odometry, true = odometry_of(400, late), pose_from_xyt(path(np.arange(400.0)))
    found = estimate_lag(true, odometry.trajectory.poses, SETTINGS)
    assert found.significant(SETTINGS)
    assert found.share == pytest.approx(late, abs=0.08)

    def wrong_turn(poses: FloatArray) -> float:
        steps = SE2.log(SE2.between(poses[:-1], poses[1:])) - SE2.log(SE2.between(true[:-1], true[1:]))
        return float(np.std(steps[1:-1, 2]))

    corrected = without_lag(odometry, found.share).trajectory.poses
    assert wrong_turn(corrected) < 0.7 * wrong_turn(odometry.trajectory.poses)


@pytest.mark.parametrize("lag", [0.4, -0.6])
def test_both_parts_of_a_shifted_leap_are_unsure(lag: float) -> None:
    odometry = odometry_of(30)
    covariance = odometry.covariance.copy()
    covariance[12] *= 1e4
    leaping = replace(odometry, covariance=covariance)
    unsure = np.flatnonzero(without_lag(leaping, lag).covariance[:, 2, 2] > 1e-3)
    assert unsure.tolist() == ([11, 12] if lag > 0 else [12, 13])
    assert without_lag(leaping, 0.0) is leaping


def test_a_log_without_odometry_or_motion_shows_nothing() -> None:
    odometry = odometry_of(60)
    still = OdometryEstimate(
        trajectory=odometry.trajectory.with_poses(SE2.identity(60)), covariance=odometry.covariance, source="none"
    )
    scans = prepare_beam_scans(room_scans(60, 0.0).select(np.zeros(60, dtype=np.int64)), BeamScanSettings())
    timing = estimate_timing(scans, still, ScanMatchingSettings(), SETTINGS)
    assert np.isnan(timing.lag.share)
    assert np.isnan(timing.sweep.share)
    assert not timing.sweep.significant(SETTINGS)
    assert np.isnan(estimate_lag(SE2.identity(60), SE2.identity(60), SETTINGS).share)


def test_the_stretch_holds_the_turns_but_no_leap() -> None:
    turn = np.zeros(200)
    turn[120:140], turn[20] = 0.2, 3.0
    poses = pose_from_xyt(np.stack([np.zeros(200), np.zeros(200), np.cumsum(turn)], axis=1))
    odometry = odometry_of(200)
    turning = OdometryEstimate(
        trajectory=odometry.trajectory.with_poses(poses), covariance=odometry.covariance, source="logged"
    )
    part = turning_stretch(turning, TimingSettings(scans=50))
    assert part.stop - part.start == 50
    assert part.start < 120
    assert part.stop >= 140
    assert len(turning.part(part).covariance) == 49


def test_shifting_by_a_whole_scan_gives_the_next_and_the_last_pose() -> None:
    poses = pose_from_xyt(path(np.arange(20.0)))
    np.testing.assert_allclose(shifted(poses, 1.0)[:-1], poses[1:], atol=1e-12)
    np.testing.assert_allclose(shifted(poses, -1.0)[1:], poses[:-1], atol=1e-12)


def test_undistorted_scans_are_those_of_a_laser_at_rest() -> None:
    count, sweep = 40, 0.3
    moving, still = room_scans(count, sweep, 0.0), room_scans(count, 0.0, 0.0)
    lidar = pose_from_xyt(path(np.arange(float(count))))
    motion = sweep_motion(lidar, sweep, SETTINGS)

    def off_the_walls(points: FloatArray) -> float:
        world = np.einsum("nij,nbj->nbi", lidar[:, :2, :2], points) + lidar[:, None, :2, 2]
        return float(np.quantile(from_walls(world.reshape(-1, 2)), 0.9))

    plain = prepare_beam_scans(moving, BeamScanSettings()).points.astype(float)
    undone = prepare_beam_scans(moving, BeamScanSettings(), motion=motion).points.astype(float)
    assert off_the_walls(plain) > 0.01
    assert off_the_walls(undone) < 0.15 * off_the_walls(plain)
    at_rest = prepare_beam_scans(still, BeamScanSettings(), motion=np.zeros((count, 3)))
    assert at_rest.points.tobytes() == prepare_beam_scans(still, BeamScanSettings()).points.tobytes()


def test_maps_undo_the_sweep_too() -> None:
    count, sweep = 200, 0.4
    scans, lidar = room_scans(count, sweep, 0.0), pose_from_xyt(path(np.arange(200.0)))
    trajectory = Trajectory(stamps_s=scans.stamps_s, poses=lidar, parent="map", child="base")
    settings = OccupancySettings(resolution_m=0.02)

    def smeared(motion: FloatArray | None) -> int:
        grid = build_occupancy(scans, trajectory, settings, motion=motion)
        row, column = np.nonzero(grid.occupied)
        centres = grid.geometry.origin_m + grid.geometry.resolution_m * (np.stack([column, row], axis=1) + 0.5)
        return int((from_walls(centres) > 0.03).sum())

    assert smeared(None) > 100
    assert smeared(sweep_motion(lidar, sweep, SETTINGS)) < 0.1 * smeared(None)
