"""One pose a scan from every source, with step covariances that compose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.errors import ConfigurationError, InputError
from posegraph_slam.geometry import SE2, Trajectory, interpolate, pose_from_xyt, spatial_from_planar
from posegraph_slam.odometry import OdometryEstimate, OdometrySettings, StepNoise, chosen_source, odometry_at_scans
from posegraph_slam.odometry.differential_drive import integrate_motion
from posegraph_slam.odometry.estimate import covariance_between, resample, step_covariance
from posegraph_slam.sensors import Imu, LaserScans, RobotLog, WheelEncoders

NOISE = StepNoise()
UNKNOWN = np.diag([0.25, 0.25, 0.25])


def scans_at(stamps: np.ndarray) -> LaserScans:
    return LaserScans(
        stamps_s=stamps, ranges_m=np.ones((len(stamps), 3), np.float32), angle_min_rad=0.0, angle_increment_rad=0.1,
        range_min_m=0.1, range_max_m=30.0, T_base_lidar=np.eye(4),
    )  # fmt: skip


def wheels(stamps: np.ndarray) -> WheelEncoders:
    return WheelEncoders(
        stamps_s=stamps, ticks_left=np.full((len(stamps), 1), 20), ticks_right=np.full((len(stamps), 1), 24),
        metres_per_tick=0.001, track_width_m=0.5,
    )  # fmt: skip


def random_path(seed: int, count: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Poses (count, 3, 3) and covariances of their steps."""
    rng = np.random.default_rng(seed)
    distance, turn = rng.uniform(0, 0.5, count - 1), rng.normal(0, 0.4, count - 1)
    root = rng.normal(0, 0.03, (count - 1, 3, 3))
    poses = SE2.exp(rng.normal(0, 20, 3)) @ integrate_motion(distance, turn)
    return poses, root @ np.swapaxes(root, 1, 2) + 1e-6 * np.eye(3)


@given(st.integers(0, 2**32 - 1))
def test_composed_covariance_is_the_step_by_step_one_in_both_directions(seed: int) -> None:
    poses, covariance = random_path(seed)
    start, end = 4, 23
    expected = np.zeros((3, 3))
    for k in range(start, end):
        transport = SE2.adjoint(SE2.inverse(SE2.between(poses[k], poses[k + 1])))
        expected = transport @ expected @ transport.T + covariance[k]
    forward = covariance_between(poses, covariance, np.array([start]), np.array([end]))[0]
    np.testing.assert_allclose(forward, expected, rtol=1e-9, atol=1e-12)
    # T^-1 exp(-Ad_T d): the motion back has the covariance Ad_T C Ad_T^T
    back = SE2.adjoint(SE2.between(poses[start], poses[end]))
    backward = covariance_between(poses, covariance, np.array([end]), np.array([start]))[0]
    np.testing.assert_allclose(backward, back @ expected @ back.T, rtol=1e-9, atol=1e-12)


def test_transport_is_the_numerical_jacobian() -> None:
    poses, _ = random_path(5)
    k, end = 7, 20

    def motion(noise: np.ndarray) -> np.ndarray:
        return SE2.between(poses[0], poses[k]) @ SE2.exp(noise) @ SE2.between(poses[k], poses[end])

    h = 1e-6
    columns = [SE2.local(motion(-h * e), motion(h * e)) / (2 * h) for e in np.eye(3)]
    covariance = np.zeros((len(poses) - 1, 3, 3))
    covariance[k - 1] = np.diag([1.0, 4.0, 9.0])
    J = np.stack(columns, axis=1)
    composed = covariance_between(poses, covariance, np.array([0]), np.array([end]))[0]
    np.testing.assert_allclose(composed, J @ covariance[k - 1] @ J.T, rtol=1e-6, atol=1e-6)


def test_propagated_covariance_is_that_of_sampled_paths() -> None:
    rng = np.random.default_rng(11)
    distance, turn = np.full(40, 0.05), np.full(40, 0.04)
    poses, covariance = integrate_motion(distance, turn), step_covariance(distance, turn, NOISE)
    samples = 20000
    noise = rng.standard_normal((samples, 40, 3)) @ np.linalg.cholesky(covariance[0]).T
    pose = SE2.identity(samples)
    steps = SE2.between(poses[:-1], poses[1:])
    for k in range(40):
        pose = SE2.retract(pose @ steps[k], noise[:, k])
    sampled = np.cov(SE2.local(np.broadcast_to(poses[-1], pose.shape), pose).T)
    propagated = covariance_between(poses, covariance, np.array([0]), np.array([40]))[0]
    scale = np.sqrt(np.outer(np.diag(propagated), np.diag(propagated)))
    assert np.abs((sampled - propagated) / scale).max() < 0.04


@given(st.floats(0.01, 3.0), st.floats(-2.0, 2.0), st.integers(2, 50))
def test_the_noise_of_a_motion_does_not_depend_on_how_finely_it_is_cut(d: float, a: float, parts: int) -> None:
    whole = step_covariance(np.array([d]), np.array([a]), NOISE)[0]
    floor = np.diag([NOISE.floor_m**2, NOISE.floor_m**2, NOISE.floor_rad**2])
    part = step_covariance(np.full(parts, d / parts), np.full(parts, a / parts), NOISE)
    np.testing.assert_allclose((part - floor).sum(axis=0), whole - floor, rtol=1e-9, atol=1e-15)


def test_resampling_cuts_steps_and_keeps_their_noise() -> None:
    poses, covariance = random_path(2, 11)
    known = OdometryEstimate(
        trajectory=Trajectory(stamps_s=np.arange(11.0), poses=poses, parent="odom", child="base"),
        covariance=1e-4 * covariance, source="wheels",
    )  # fmt: skip
    stamps = np.array([0.0, 2.3, 2.3, 2.7, 10.0])
    floor = StepNoise(floor_m=1e-9, floor_rad=1e-9)
    at = resample(known, stamps, unknown_per_s=UNKNOWN, floor=floor)
    np.testing.assert_allclose(at.trajectory.poses, interpolate(known.trajectory, stamps).poses, atol=1e-12)
    assert at.covariance[1].max() < 1e-15  # two scans with one stamp: the floor alone
    np.testing.assert_allclose(at.covariance[2, 2, 2], 0.4e-4 * covariance[2, 2, 2], rtol=1e-6)  # 2.3 s to 2.7 s
    # the whole way has the noise of the whole way, whatever lies between, but for lever arms within a cut step
    ends = resample(known, stamps[[0, -1]], unknown_per_s=UNKNOWN, floor=floor).covariance[0]
    composed = covariance_between(at.trajectory.poses, at.covariance, np.array([0]), np.array([4]))[0]
    np.testing.assert_allclose(composed, ends, atol=0.01 * np.trace(ends))


def test_doubled_stamps_of_the_wheels_lose_no_motion() -> None:
    stamps = np.array([0.0, 0.1, 0.1, 0.2, 0.3])
    log = RobotLog(path=Path("log"), format="test", scans=scans_at(np.array([0.0, 0.3])), encoders=wheels(stamps))
    estimate = odometry_at_scans(log)
    expected = integrate_motion(np.full(4, 0.022), np.full(4, 0.008))[-1]
    np.testing.assert_allclose(estimate.trajectory.poses[-1], expected, atol=1e-12)
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0


def test_scans_outside_the_odometry_hold_it_with_a_remark_and_wide_noise() -> None:
    stamps = np.array([-1.0, 0.0, 5.0, 10.0, 12.0])
    log = RobotLog(path=Path("log"), format="test", scans=scans_at(stamps), encoders=wheels(np.arange(0, 10.01, 0.1)))
    estimate = odometry_at_scans(log)
    np.testing.assert_array_equal(estimate.trajectory.stamps_s, stamps)
    np.testing.assert_allclose(estimate.trajectory.poses[0], estimate.trajectory.poses[1], atol=1e-12)
    np.testing.assert_allclose(estimate.trajectory.poses[-1], estimate.trajectory.poses[-2], atol=1e-12)
    assert "1 scans before and 1 after" in estimate.remarks[-1]
    assert estimate.covariance[3, 2, 2] > 0.4  # 2 s without odometry


def logged(stamps: np.ndarray, xyt: np.ndarray, **streams: object) -> RobotLog:
    poses = Trajectory(stamps_s=stamps, poses=pose_from_xyt(xyt), parent="odom", child="base")
    return RobotLog(path=Path("log.clf"), format="carmen", scans=scans_at(stamps), scan_odometry=poses, **streams)  # type: ignore[arg-type]


def test_logged_poses_keep_their_file_order() -> None:
    stamps = np.array([0.0, 0.2, 0.1, 0.3])
    xyt = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0.1], [0.3, 0, 0.1]])
    estimate = odometry_at_scans(logged(stamps, xyt))
    assert estimate.source == "logged"
    np.testing.assert_array_equal(estimate.trajectory.stamps_s, stamps)
    np.testing.assert_allclose(estimate.trajectory.positions[:, 0], xyt[:, 0])
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0


def test_a_leap_of_the_logged_odometry_is_hardly_believed() -> None:
    xyt = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0, 1.3], [0.2, 0, 1.3]])
    estimate = odometry_at_scans(logged(np.arange(4.0), xyt))
    assert "leaps 1 times" in estimate.remarks[0]
    assert estimate.covariance[1, 2, 2] > 1.3**2
    assert estimate.covariance[0, 2, 2] < 0.01


def test_a_leap_is_spread_over_the_stall_before_it() -> None:
    xyt = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [0.9, 0.0, 1.2], [1.0, 0, 1.2]])
    estimate = odometry_at_scans(logged(np.arange(7.0), xyt))
    steps = SE2.log(estimate.steps)
    np.testing.assert_allclose(steps[1:5], np.broadcast_to(steps[1], (4, 3)), atol=1e-12)
    np.testing.assert_allclose(steps[1, 2], 0.3)
    np.testing.assert_allclose(estimate.trajectory.poses[[0, 1, 5, 6]], pose_from_xyt(xyt[[0, 1, 5, 6]]), atol=1e-12)
    assert estimate.covariance[1:5, 2, 2] == pytest.approx(1.2**2 / 4, rel=0.05)
    assert estimate.covariance[0, 2, 2] < 0.01


def test_spatial_logged_poses_are_taken_in_the_plane() -> None:
    log = logged(np.arange(3.0), np.array([[0, 0, 0], [1, 2, 0.5], [2, 2, 1.0]]))
    assert log.scan_odometry is not None
    spatial = log.scan_odometry.with_poses(spatial_from_planar(log.scan_odometry.poses))
    lifted = RobotLog(path=log.path, format="test", scans=log.scans, scan_odometry=spatial)
    np.testing.assert_allclose(
        odometry_at_scans(lifted).trajectory.poses, odometry_at_scans(log).trajectory.poses, atol=1e-12
    )


def test_the_loggers_stream_serves_where_scans_carry_no_pose() -> None:
    stream = Trajectory(
        stamps_s=np.array([0.0, 2.0, 1.0]), poses=pose_from_xyt(np.array([[0, 0, 0], [2, 0, 0], [1.0, 0, 0]])),
        parent="odom", child="base",
    )  # fmt: skip
    log = RobotLog(path=Path("log"), format="test", scans=scans_at(np.array([0.5, 1.5])), odometry=stream)
    estimate = odometry_at_scans(log)
    assert estimate.source == "logged"
    np.testing.assert_allclose(estimate.trajectory.positions, [[0.5, 0], [1.5, 0]], atol=1e-12)


def test_no_odometry_is_a_robot_that_stays_put_with_a_wide_covariance() -> None:
    stamps = np.array([0.0, 0.001, 0.002, 0.7, 0.65])  # bursts and disorder
    log = RobotLog(path=Path("log"), format="test", scans=scans_at(stamps))
    estimate = odometry_at_scans(log)
    np.testing.assert_array_equal(estimate.trajectory.poses, SE2.identity(5))
    assert estimate.source == "none"
    assert "no odometry" in estimate.remarks[0]
    assert np.sqrt(estimate.covariance[:, 2, 2]).min() > 0.1


def test_the_source_is_chosen_by_what_the_log_has() -> None:
    stamps = np.arange(0, 5, 0.1)
    imu = Imu(
        stamps_s=stamps, angular_velocity=np.zeros((50, 3)), linear_acceleration=np.zeros((50, 3)),
        T_base_imu=np.eye(4),
    )  # fmt: skip
    moving = np.column_stack([stamps, np.zeros((50, 2))])
    everything = logged(stamps, moving, encoders=wheels(stamps), imu=imu)
    assert chosen_source(everything) == "logged"
    for source in ("logged", "wheels_imu", "wheels", "none"):
        assert odometry_at_scans(everything, OdometrySettings(source=source)).source == source
    bare = RobotLog(path=Path("log"), format="test", scans=scans_at(stamps), encoders=wheels(stamps))
    assert chosen_source(bare) == "wheels"
    assert chosen_source(logged(stamps, np.zeros((50, 3)), encoders=wheels(stamps))) == "wheels"
    assert chosen_source(logged(stamps, np.zeros((50, 3)))) == "none"
    with pytest.raises(ConfigurationError, match=r"odometry.source: 'logged' is not in log; choose auto, wheels, none"):
        odometry_at_scans(bare, OdometrySettings(source="logged"))


def test_a_log_without_scans_is_refused() -> None:
    for scans in (None, scans_at(np.zeros(0))):
        with pytest.raises(InputError, match="no laser scans"):
            odometry_at_scans(RobotLog(path=Path("log"), format="test", scans=scans, encoders=wheels(np.arange(5.0))))


def test_logged_poses_that_are_not_finite_or_too_few_are_refused() -> None:
    xyt = np.zeros((4, 3))
    xyt[2, 0] = np.nan
    with pytest.raises(InputError, match="odometry pose 2 is not finite"):
        odometry_at_scans(logged(np.arange(4.0), xyt))
    log = logged(np.arange(4.0), np.column_stack([np.arange(4.0), np.zeros((4, 2))]))
    short = RobotLog(path=log.path, format="carmen", scans=scans_at(np.arange(5.0)), scan_odometry=log.scan_odometry)
    with pytest.raises(InputError, match="4 odometry poses for 5 scans"):
        odometry_at_scans(short)


def test_one_scan_is_enough() -> None:
    log = RobotLog(path=Path("log"), format="test", scans=scans_at(np.array([0.5])), encoders=wheels(np.arange(3.0)))
    assert odometry_at_scans(log).covariance.shape == (0, 3, 3)
