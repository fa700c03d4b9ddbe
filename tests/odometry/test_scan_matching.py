"""The scan-matching stage on simulated logs with known truth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.simulation import drive, tiny_settings
from posegraph_slam.evaluation.ape import absolute_pose_error
from posegraph_slam.evaluation.rpe import relative_pose_error
from posegraph_slam.geometry import SE2, Trajectory, planar_from_spatial, pose_from_xyt, xyt_from_pose
from posegraph_slam.odometry import odometry_at_scans
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.scan_matching import (
    ScanMatchingResult,
    ScanMatchingSettings,
    match_scans,
    select_keyframes,
)
from posegraph_slam.odometry.scan_to_scan import chain
from posegraph_slam.pipeline.executors import ThreadExecutor
from posegraph_slam.registration.beam_scans import BeamScans, BeamScanSettings, prepare_beam_scans
from posegraph_slam.sensors import RobotLog


@pytest.fixture(scope="module")
def log() -> RobotLog:
    return drive(tiny_settings(duration_s=20.0))


def prepared(log: RobotLog) -> BeamScans:
    assert log.scans is not None
    return prepare_beam_scans(log.scans, BeamScanSettings())


def rmse(log: RobotLog, result: ScanMatchingResult) -> float:
    assert log.truth is not None
    return absolute_pose_error(result.trajectory, log.truth).translation_m.rmse


def test_local_map_beats_odometry_and_scan_to_scan(log: RobotLog) -> None:
    odometry = odometry_at_scans(log)
    local = match_scans(prepared(log), odometry, ScanMatchingSettings())
    pairs = match_scans(prepared(log), odometry, ScanMatchingSettings(matcher="scan_to_scan"))
    alone = match_scans(prepared(log), odometry, ScanMatchingSettings(matcher="none"))
    assert rmse(log, local) < 0.02
    assert rmse(log, local) < rmse(log, alone)
    assert rmse(log, pairs) < 0.1
    assert (alone.trajectory.poses == odometry.trajectory.poses).all()
    for result in (local, pairs, alone):
        assert result.keyframes[0] == 0
        assert (np.diff(result.keyframes) > 0).all()
        assert np.linalg.eigvalsh(result.keyframe_information).min() > 0
        np.testing.assert_allclose(result.trajectory.poses[0], odometry.trajectory.poses[0], atol=1e-12)


def test_keyframes_come_after_distance_or_turn(log: RobotLog) -> None:
    settings = ScanMatchingSettings(keyframe_distance_m=0.4, keyframe_turn_rad=0.3)
    result = match_scans(prepared(log), odometry_at_scans(log), settings)
    poses = result.trajectory.poses[result.keyframes]
    step = xyt_from_pose(SE2.between(poses[:-1], poses[1:]))
    moved = (np.hypot(step[:, 0], step[:, 1]) >= 0.4) | (np.abs(step[:, 2]) >= 0.3)
    assert moved.all()
    chosen = select_keyframes(result.trajectory.poses, settings)
    assert chosen[0] == 0
    assert abs(len(chosen) - len(result.keyframes)) <= 0.5 * len(chosen)


@pytest.mark.parametrize("turn", [1.1, -1.4])
def test_an_odometry_leap_is_recovered(log: RobotLog, turn: float) -> None:
    """Odometry of old robots stalls and then leaps by 60 to 85 degrees within one scan."""
    odometry = odometry_at_scans(log)
    poses = np.array(odometry.trajectory.poses)
    leap = pose_from_xyt(np.array([0.0, 0.0, turn]))
    at = 40
    poses[at:] = poses[at - 1] @ leap @ SE2.between(np.broadcast_to(poses[at - 1], poses[at:].shape), poses[at:])
    broken = OdometryEstimate(
        trajectory=odometry.trajectory.with_poses(poses), covariance=odometry.covariance, source="logged"
    )
    result = match_scans(prepared(log), broken, ScanMatchingSettings())
    assert len(result.searched) > 0
    assert rmse(log, result) < 0.05


def test_without_odometry_scans_alone_give_the_motion(log: RobotLog) -> None:
    bare = dataclasses.replace(log, encoders=None, imu=None)
    result = match_scans(prepared(bare), odometry_at_scans(bare), ScanMatchingSettings())
    assert rmse(log, result) < 0.05


def test_a_logger_that_knows_no_odometry_is_coasted(log: RobotLog) -> None:
    assert log.scans is not None
    still = log.scans.stamps_s, np.tile(np.eye(3), (len(log.scans), 1, 1))
    zero = Trajectory(stamps_s=still[0], poses=still[1], parent="odom", child="base")
    bare = dataclasses.replace(log, encoders=None, imu=None, scan_odometry=zero)
    odometry = odometry_at_scans(bare)
    assert odometry.source == "none"
    assert rmse(log, match_scans(prepared(bare), odometry, ScanMatchingSettings())) < 0.05


def test_heading_does_not_drift_to_one_side() -> None:
    """Matches whose errors prefer a side turn a long corridor into a bow."""
    turned: list[float] = []
    for seed in range(1, 5):
        log = drive(tiny_settings(seed=seed, duration_s=20.0))
        assert log.truth is not None
        result = match_scans(prepared(log), odometry_at_scans(log), ScanMatchingSettings())
        truth: FloatArray = planar_from_spatial(log.truth.poses)
        error = SE2.inverse(SE2.between(truth[0], truth[-1])) @ SE2.between(
            result.trajectory.poses[0], result.trajectory.poses[-1]
        )
        turned.append(float(np.degrees(xyt_from_pose(error)[2])))
    assert np.abs(turned).max() < 0.5
    assert abs(np.mean(turned)) < 0.2


def test_workers_do_not_change_the_chain(log: RobotLog) -> None:
    settings = ScanMatchingSettings(matcher="scan_to_scan")
    one = match_scans(prepared(log), odometry_at_scans(log), settings)
    with ThreadExecutor(2) as executor:
        two = match_scans(prepared(log), odometry_at_scans(log), settings, executor=executor)
    assert one.trajectory.poses.tobytes() == two.trajectory.poses.tobytes()


def test_chained_steps_equal_their_product() -> None:
    rng = np.random.default_rng(1)
    steps = SE2.exp(rng.normal(0, 0.5, (30, 3)))
    start = pose_from_xyt(np.array([3.0, -1.0, 2.0]))
    expected = [start]
    for step in steps:
        expected.append(expected[-1] @ step)
    np.testing.assert_allclose(chain(start, steps), expected, atol=1e-12)


def test_relative_error_of_neighbours_is_millimetres(log: RobotLog) -> None:
    assert log.truth is not None
    result = match_scans(prepared(log), odometry_at_scans(log), ScanMatchingSettings())
    trajectory: Trajectory = result.trajectory
    error = relative_pose_error(trajectory, log.truth, distances_m=(1.0,))
    over = error.over(1.0)
    assert over is not None
    assert over.translation_m is not None
    assert over.translation_m.rmse < 0.02
