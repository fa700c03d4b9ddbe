"""Wheels and gyro together: alignment of streams, bridged gaps, noise, and bad input."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, Trajectory, interpolate
from posegraph_slam.odometry import OdometrySettings, wheel_imu_odometry
from posegraph_slam.sensors import Imu, WheelEncoders

SETTINGS = OdometrySettings()
METRES_PER_TICK = 1e-6  # so fine that rounding to ticks does not matter
WIDTH = 0.6


def true_path(stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed and yaw rate of a robot that stands for 3 s and then weaves."""
    moving = np.clip(stamps - 3.0, 0.0, 1.0)
    return 0.6 * moving, moving * 0.8 * np.sin(0.7 * stamps)


def simulate(*, bias: float = 0.0, imu_stamps: np.ndarray | None = None) -> tuple[WheelEncoders, Imu, Trajectory]:
    fine = np.linspace(0, 30, 30001)
    speed, rate = true_path(fine)
    dt = fine[1] - fine[0]
    twist = np.stack([speed, 0 * speed, rate], axis=1)
    poses = SE2.identity(len(fine))
    for k, step in enumerate(SE2.exp(0.5 * dt * (twist[1:] + twist[:-1]))):
        poses[k + 1] = poses[k] @ step
    truth = Trajectory(stamps_s=fine, poses=poses, parent="ref", child="base")
    stamps = np.arange(0, 30, 0.025) + 0.004
    distance = np.concatenate([[0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt)])
    heading = np.concatenate([[0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * dt)])
    s, a = np.interp(stamps, fine, distance), np.interp(stamps, fine, heading)
    left = np.diff(np.rint((s - a * WIDTH / 2) / METRES_PER_TICK), prepend=0)
    right = np.diff(np.rint((s + a * WIDTH / 2) / METRES_PER_TICK), prepend=0)
    encoders = WheelEncoders(
        stamps_s=stamps + 1e9, ticks_left=np.stack([left, left], 1), ticks_right=np.stack([right, right], 1),
        metres_per_tick=METRES_PER_TICK, track_width_m=0.4,
    )  # fmt: skip
    imu_s = np.arange(0, 30, 0.0101) if imu_stamps is None else imu_stamps
    omega = np.zeros((len(imu_s), 3))
    omega[:, 2] = np.interp(imu_s, fine, rate) + bias
    imu = Imu(
        stamps_s=imu_s + 1e9, angular_velocity=omega, linear_acceleration=np.zeros_like(omega), T_base_imu=np.eye(4)
    )  # fmt: skip
    return encoders, imu, truth.restamped(fine + 1e9)


def error(trajectory: Trajectory, truth: Trajectory) -> np.ndarray:
    """Error [x, y, theta] of every pose, the first pose being known."""
    at = interpolate(truth, trajectory.stamps_s).poses
    relative = SE2.between(np.broadcast_to(at[0], at.shape), at)
    return SE2.local(relative, trajectory.poses)


@pytest.mark.parametrize("bias", [0.0, 0.02, -0.05])
def test_the_path_is_recovered_and_the_bias_removed(bias: float) -> None:
    encoders, imu, truth = simulate(bias=bias)
    estimate = wheel_imu_odometry(encoders, imu, SETTINGS)
    assert estimate.source == "wheels_imu"
    assert len(estimate.trajectory) == len(encoders)
    off = error(estimate.trajectory, truth)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 5e-3
    assert np.abs(off[:, 2]).max() < 1e-3


def without(start: float, end: float) -> np.ndarray:
    stamps = np.arange(0, 30, 0.0101)
    return stamps[(stamps < start) | (stamps > end)]


@pytest.mark.parametrize(("start", "end"), [(20.0, 99.0), (-1.0, 6.0), (12.0, 14.0)], ids=["tail", "late", "gap"])
def test_missing_stretches_of_the_gyro_are_bridged_without_a_jump(start: float, end: float) -> None:
    encoders, imu, truth = simulate(imu_stamps=without(start, end))
    estimate = wheel_imu_odometry(encoders, imu, SETTINGS)
    off = error(estimate.trajectory, truth)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.05
    assert np.abs(off[:, 2]).max() < 0.02
    steps = SE2.log(estimate.steps)
    _, rate = true_path(estimate.trajectory.stamps_s - 1e9)
    assert np.abs(steps[:, 2] / 0.025 - 0.5 * (rate[1:] + rate[:-1])).max() < 0.05  # nowhere a leap or a lull
    assert any("gyro is missing" in remark for remark in estimate.remarks)
    assert any("effective track width 0.6" in remark for remark in estimate.remarks)
    at = estimate.trajectory.stamps_s[1:] - 1e9
    bridged = (at > start + 0.1) & (at < end - 0.1) & (at > 4.5)
    complete = wheel_imu_odometry(*simulate()[:2], SETTINGS)
    assert np.all(estimate.covariance[bridged, 2, 2] > 5 * complete.covariance[bridged, 2, 2])


def test_noise_grows_with_distance_and_turn() -> None:
    encoders, imu, _ = simulate()
    estimate = wheel_imu_odometry(encoders, imu, SETTINGS)
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0
    steps = SE2.log(estimate.steps)
    still, fast = steps[:, 0] < 1e-6, steps[:, 0] > 0.014
    assert estimate.covariance[fast, 0, 0].min() > estimate.covariance[still, 0, 0].max()
    turning = np.abs(steps[:, 2]) > 0.019
    straight = fast & (np.abs(steps[:, 2]) < 0.001)
    assert estimate.covariance[turning, 2, 2].min() > estimate.covariance[straight, 2, 2].max()


def test_the_wheels_alone_use_the_track_width_of_the_log() -> None:
    encoders, _, _ = simulate()
    estimate = wheel_imu_odometry(encoders, None, SETTINGS)
    assert estimate.source == "wheels"
    turn = np.diff(encoders.travel_m, axis=1)[1:, 0] / 0.4
    np.testing.assert_allclose(SE2.log(estimate.steps)[:, 2], turn, atol=1e-12)


def test_an_imu_of_another_time_leaves_the_wheels() -> None:
    encoders, imu, _ = simulate()
    elsewhen = Imu(
        stamps_s=imu.stamps_s + 500, angular_velocity=imu.angular_velocity,
        linear_acceleration=imu.linear_acceleration, T_base_imu=imu.T_base_imu,
    )  # fmt: skip
    estimate = wheel_imu_odometry(encoders, elsewhen, SETTINGS)
    np.testing.assert_allclose(
        estimate.trajectory.poses, wheel_imu_odometry(encoders, None, SETTINGS).trajectory.poses, atol=1e-9
    )
    assert any("gyro is missing" in remark for remark in estimate.remarks)


def broken(stamps: np.ndarray | None = None, rows: int | None = None) -> WheelEncoders:
    times = np.arange(10.0) if stamps is None else stamps
    count = len(times) if rows is None else rows
    ticks = np.ones((count, 2))
    return WheelEncoders(
        stamps_s=times[:count], ticks_left=ticks, ticks_right=ticks, metres_per_tick=0.01, track_width_m=0.5
    )


@pytest.mark.parametrize(
    ("encoders", "message"),
    [
        (broken(rows=0), "0 samples are too few"),
        (broken(stamps=np.array([0.0, 1, 2, 1.5, 3])), "runs backwards at sample 3"),
        (broken(stamps=np.array([0.0, np.nan, 2])), "sample 1 is not finite"),
    ],
    ids=["empty", "backwards", "nan"],
)
def test_bad_encoders_are_named(encoders: WheelEncoders, message: str) -> None:
    with pytest.raises(InputError, match=message):
        wheel_imu_odometry(encoders, None, SETTINGS)


def test_bad_gyro_values_are_named() -> None:
    encoders, imu, _ = simulate()
    omega = imu.angular_velocity.copy()
    omega[17] = np.nan
    bad = Imu(
        stamps_s=imu.stamps_s, angular_velocity=omega, linear_acceleration=imu.linear_acceleration,
        T_base_imu=imu.T_base_imu,
    )  # fmt: skip
    with pytest.raises(InputError, match="imu: sample 17 is not finite"):
        wheel_imu_odometry(encoders, bad, SETTINGS)
