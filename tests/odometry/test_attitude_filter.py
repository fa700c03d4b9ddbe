"""The quaternion UKF: mean on the manifold, explicit state against the stream, consistency, an EKF as oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.attitude import attitude_errors
from posegraph_slam.geometry import SO3, Trajectory, pose_from_rotation_translation
from posegraph_slam.geometry.so3 import hat
from posegraph_slam.odometry.attitude import (
    AttitudeSettings,
    AttitudeState,
    estimate_attitude,
    predict,
    run_ukf,
    update,
)
from posegraph_slam.odometry.attitude.quaternions import mean_quaternion, rotation_from_wxyz, wxyz_from_rotation
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu

RATE_HZ = 100.0
UP = np.array([0.0, 0.0, 1.0])
NOISE = AttitudeSettings(
    gyro_noise_rad_per_sqrt_s=0.004,
    gyro_noise_rad_per_sqrt_rad=0.0,
    bias_walk_rad_s_per_sqrt_s=1e-4,
    accelerometer_sigma_rad=0.05,
    accelerometer_lasting_s=0.0,
    accelerometer_excess_factor=0.0,
    max_excess=10.0,
)
"""Settings that say exactly what `tumble` does, so that the filter has to be consistent."""


def tumble(seed: int, *, seconds: float = 40.0, still_s: float = 2.0) -> tuple[Imu, Trajectory, FloatArray]:
    """Simulate a body that rests and then turns about all axes; return its IMU, true poses and gyro biases (N, 3)."""
    rng = np.random.default_rng(seed)
    n, dt = int(seconds * RATE_HZ), 1 / RATE_HZ
    t = np.arange(n) * dt
    moving = (t > still_s)[:, None]
    phases, speeds = rng.uniform(0, 6, 3), rng.uniform(0.4, 1.2, 3)
    rates = moving * np.sin(speeds * t[:, None] + phases) * [1.0, 1.2, 0.8]
    R = np.empty((n, 3, 3))
    R[0] = np.eye(3)
    steps = SO3.exp(0.5 * (rates[1:] + rates[:-1]) * dt)
    for k in range(n - 1):
        R[k + 1] = R[k] @ steps[k]
    bias = 0.01 * rng.normal(size=3) + np.cumsum(rng.normal(0, 1e-4 * np.sqrt(dt), (n, 3)), axis=0)
    # The filter averages two samples a step: independent noise of each is half as strong in the mean.
    white = rng.normal(0, NOISE.gyro_noise_rad_per_sqrt_s / np.sqrt(dt), (n, 3))
    accel = STANDARD_GRAVITY * (R[:, 2] + rng.normal(0, NOISE.accelerometer_sigma_rad, (n, 3)))
    imu = Imu(stamps_s=t, angular_velocity=rates + bias + white, linear_acceleration=accel, T_base_imu=np.eye(4))
    poses = pose_from_rotation_translation(R, np.zeros((n, 3)))
    return imu, Trajectory(stamps_s=t, poses=poses, parent="ref", child="base"), bias


def a_state(R: FloatArray, sigma: float = 0.1) -> AttitudeState:
    return AttitudeState(
        quat_wxyz=wxyz_from_rotation(R), gyro_bias=np.zeros(3), covariance=np.diag([sigma] * 3 + [1e-3] * 3) ** 2
    )


def angle(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(SO3.log(a.T @ b)))


@given(seed=st.integers(0, 10_000), spread=st.floats(1e-6, 1.2))
def test_mean_has_vanishing_mean_error(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    centre = Rotation.random(random_state=rng).as_matrix()
    turns = rng.normal(size=(12, 3))
    turns *= spread / np.linalg.norm(turns, axis=1, keepdims=True)
    points = wxyz_from_rotation(SO3.exp(turns) @ centre) * rng.choice([-1.0, 1.0], (12, 1))  # q and -q are one rotation
    mean, errors = points[0].copy(), np.empty((12, 3))
    mean_quaternion(points, mean, errors)
    assert np.abs(errors.mean(axis=0)).max() < 1e-6
    expected = SO3.log(rotation_from_wxyz(points) @ rotation_from_wxyz(mean).T)
    np.testing.assert_allclose(errors, expected, atol=1e-7)


def test_mean_of_opposite_turns_is_the_centre() -> None:
    centre = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
    turns = np.array([[0.9, 0, 0], [-0.9, 0, 0], [0, 0.5, 0.5], [0, -0.5, -0.5]])
    mean, errors = wxyz_from_rotation(SO3.exp(turns[0]) @ centre), np.empty((4, 3))
    mean_quaternion(wxyz_from_rotation(SO3.exp(turns) @ centre), mean, errors)
    assert angle(rotation_from_wxyz(mean), centre) < 1e-8


@given(axis=st.sampled_from([0, 1, 2]), rate=st.floats(-3, 3), seconds=st.floats(0.1, 2))
@settings(max_examples=20)
def test_constant_rate_turns_by_rate_times_time(axis: int, rate: float, seconds: float) -> None:
    omega = np.eye(3)[axis] * rate
    start = Rotation.from_euler("xyz", [0.2, 0.4, -1.0]).as_matrix()
    state = a_state(start, sigma=1e-3)
    for _ in range(10):
        state = predict(state, omega, seconds / 10, AttitudeSettings())
    assert angle(state.rotation, start @ SO3.exp(omega * seconds)) < 1e-5


def test_no_drift_at_rest() -> None:
    n = 6000
    bias = np.array([0.02, -0.01, 0.005])
    accel = Rotation.from_euler("xyz", [0.1, -0.2, 0.0]).as_matrix().T @ UP * STANDARD_GRAVITY
    imu = Imu(stamps_s=np.arange(n) / RATE_HZ, angular_velocity=np.tile(bias, (n, 1)),
              linear_acceleration=np.tile(accel, (n, 1)), T_base_imu=np.eye(4))  # fmt: skip
    for method in ("ukf", "smoother", "complementary", "gyro"):
        R = estimate_attitude(imu, method=method).rotations
        assert angle(R[0], R[-1]) < 1e-6
        np.testing.assert_allclose(R[-1, 2], accel / STANDARD_GRAVITY, atol=1e-6)


def test_heading_variance_is_neither_seen_nor_leaked_by_gravity() -> None:
    """Corrections of the tilt must not make a doubtful heading certain, nor move it."""
    rng = np.random.default_rng(3)
    state = a_state(np.eye(3), sigma=0.02)
    P = state.covariance.copy()
    P[2, 2] = 0.5**2
    state = AttitudeState(quat_wxyz=state.quat_wxyz, gyro_bias=state.gyro_bias, covariance=P)
    for k in range(300):
        lean = SO3.exp(
            np.array([0.2 * np.sin(0.1 * k), 0.2 * np.cos(0.13 * k), 0.0]) + rng.normal(0, 0.02, 3) * [1, 1, 0]
        )
        state = update(state, STANDARD_GRAVITY * lean[2], AttitudeSettings())
        state = predict(state, np.zeros(3), 0.01, AttitudeSettings())
    assert 0.49 < np.sqrt(state.covariance[2, 2]) < 0.52
    assert abs(np.arctan2(state.rotation[1, 0], state.rotation[0, 0])) < 0.05


def test_unknown_rate_keeps_the_orientation_and_widens_it() -> None:
    state = a_state(np.eye(3), sigma=0.01)
    after = predict(state, np.full(3, np.nan), 1.0, AttitudeSettings(unknown_rate_rad_per_sqrt_s=0.3))
    assert angle(after.rotation, np.eye(3)) < 1e-9
    np.testing.assert_allclose(np.sqrt(np.diag(after.covariance)[:3]), 0.3, rtol=0.05)


@pytest.mark.parametrize("accel", [[0, 0, 20.0], [0, 0, 2.0], [0, 0, 0], [np.nan, 0, 9.8]])
def test_gate_leaves_the_state_as_it_was(accel: list[float]) -> None:
    state = a_state(np.eye(3))
    assert update(state, np.array(accel), AttitudeSettings()) is state


def test_explicit_state_equals_the_stream() -> None:
    imu, _, _ = tumble(1, seconds=5)
    omega, accel = imu.angular_velocity.copy(), imu.linear_acceleration
    omega[100:130] = np.nan
    dt = np.full(len(imu), 1 / RATE_HZ)
    dt[0] = 0.0
    state = a_state(np.eye(3))
    stream = run_ukf(state, dt, omega, accel, settings=NOISE)
    for k in range(len(imu)):
        if dt[k] > 0:
            state = predict(state, omega[k], dt[k], NOISE)
        state = update(state, accel[k], NOISE)
        np.testing.assert_array_equal(state.quat_wxyz, stream.quat_wxyz[k])
    np.testing.assert_array_equal(state.gyro_bias, stream.gyro_bias[-1])
    np.testing.assert_array_equal(state.covariance, stream.covariance[-1])


def test_samples_within_the_time_that_motion_lasts_share_the_weight_of_one() -> None:
    lasting = NOISE.model_copy(update={"accelerometer_lasting_s": 0.1})
    state, accel = a_state(np.eye(3), sigma=0.02), STANDARD_GRAVITY * np.array([0.02, -0.03, 1.0])
    once = update(state, accel, lasting, 0.1)
    assert update(state, accel, lasting, 0.0) is state
    np.testing.assert_array_equal(once.covariance, update(state, accel, NOISE).covariance)
    for count in (5, 20):
        many = state
        for _ in range(count):
            many = update(many, accel, lasting, 0.1 / count)
        assert angle(once.rotation, many.rotation) < 2e-4
        np.testing.assert_allclose(many.covariance, once.covariance, rtol=0.01, atol=1e-7)


def hand_held(seed: int, rate_hz: float) -> tuple[Imu, Trajectory]:
    """A body that tumbles slowly while a hand shakes it by 0.05 g for some tenths of a second, sampled at `rate_hz`."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 40, 1 / rate_hz)
    knots = np.arange(0, 40.2, 0.2)
    shake = CubicSpline(knots, rng.normal(0, 0.05, (len(knots), 3)))(t)
    turn = Rotation.from_euler("xyz", np.column_stack([0.8 * np.sin(0.7 * t), 0.6 * np.sin(0.5 * t), 0.3 * t]))
    R = turn.as_matrix()
    steps = SO3.log(R[:-1].transpose(0, 2, 1) @ R[1:]) * rate_hz
    rates = 0.5 * (np.vstack([steps[:1], steps]) + np.vstack([steps, steps[-1:]]))
    accel = STANDARD_GRAVITY * ((R.transpose(0, 2, 1) @ (shake + UP)[..., None])[..., 0])
    imu = Imu(stamps_s=t, angular_velocity=1.01 * rates, linear_acceleration=accel, T_base_imu=np.eye(4))
    poses = pose_from_rotation_translation(R, np.zeros((len(R), 3)))
    return imu, Trajectory(stamps_s=t, poses=poses, parent="ref", child="base")


def test_motion_that_lasts_is_not_believed_more_at_a_higher_rate() -> None:
    """With errors taken for white, four times the rate follows the hand, not gravity."""
    white = AttitudeSettings(accelerometer_lasting_s=0.0)

    def tilt(rate_hz: float, settings: AttitudeSettings) -> float:
        runs = (hand_held(seed, rate_hz) for seed in range(4))
        estimates = ((estimate_attitude(imu, settings), truth) for imu, truth in runs)
        return float(np.mean([attitude_errors(each.trajectory, truth).tilt_deg for each, truth in estimates]))

    slow, fast = (tilt(rate_hz, AttitudeSettings()) for rate_hz in (50.0, 200.0))
    assert abs(fast - slow) < 0.1 * slow
    slow_white, fast_white = (tilt(rate_hz, white) for rate_hz in (50.0, 200.0))
    assert fast_white > 1.15 * slow_white
    assert fast < 0.9 * fast_white


def test_bias_is_found_without_a_still_start() -> None:
    imu, _, bias = tumble(5, seconds=120, still_s=-1)
    estimate = estimate_attitude(imu, NOISE)
    assert "moves from the start" in estimate.remarks[0]
    assert np.abs(bias[-1]).max() > 5e-3
    assert np.abs(estimate.gyro_bias[-1] - bias[-1]).max() < 2e-3


def test_consistent_and_better_than_baselines_on_simulated_data() -> None:
    nees, errors = [], {"ukf": [], "complementary": [], "gyro": []}
    for seed in range(12):
        imu, truth, _ = tumble(seed)
        for method, values in errors.items():
            estimate = estimate_attitude(imu, NOISE, method=method)
            result = attitude_errors(estimate.trajectory, truth, covariance=estimate.covariance)
            values.append(result.tilt_deg)
            if result.nees is not None:
                nees.append(result.nees)
    # Errors are correlated over seconds: 12 runs hold some 100 independent ones, so that 3 is known to 15 per cent.
    assert 1.8 < np.mean(nees) < 4.2
    assert np.mean(errors["ukf"]) < np.mean(errors["complementary"]) < np.mean(errors["gyro"])
    assert np.mean(errors["ukf"]) < 1.0


def extended_filter(imu: Imu, state: AttitudeState, noise: AttitudeSettings) -> tuple[FloatArray, FloatArray]:
    """Slow oracle: error-state EKF with axis-angle errors in the body and the analytic Jacobians (Sola 2017, ch. 6)."""
    R, b, P = state.rotation, state.gyro_bias.copy(), state.covariance.copy()
    Q = np.diag([noise.gyro_noise_rad_per_sqrt_s**2] * 3 + [noise.bias_walk_rad_s_per_sqrt_s**2] * 3)
    rotations = []
    for k in range(len(imu)):
        if k > 0:
            dt = imu.stamps_s[k] - imu.stamps_s[k - 1]
            step = (0.5 * (imu.angular_velocity[k] + imu.angular_velocity[k - 1]) - b) * dt
            F = np.eye(6)
            F[:3, :3], F[:3, 3:] = SO3.exp(-step), -SO3.right_jacobian(step) * dt
            R, P = R @ SO3.exp(step), F @ (P + Q * dt) @ F.T
        H = np.hstack([hat(R.T @ UP), np.zeros((3, 3))])
        up = imu.linear_acceleration[k] / np.linalg.norm(imu.linear_acceleration[k])
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(3) * noise.accelerometer_sigma_rad**2)
        d = K @ (up - R.T @ UP)
        R, b, P = R @ SO3.exp(d[:3]), b + d[3:], P - K @ H @ P
        G = np.eye(6)
        G[:3, :3] = SO3.exp(-d[:3])  # the heading's direction in the body moves with the correction
        P = G @ P @ G.T
        rotations.append(R)
    return np.array(rotations), P


@pytest.mark.parametrize("seed", [2, 7])
def test_agrees_with_an_extended_filter(seed: int) -> None:
    imu, _, _ = tumble(seed, seconds=15)
    estimate = estimate_attitude(imu, NOISE)
    R0 = estimate.rotations[0]
    start = a_state(R0, sigma=0.02)
    dt = np.diff(imu.stamps_s, prepend=0.0)
    rates = 0.5 * (imu.angular_velocity + np.vstack([imu.angular_velocity[:1], imu.angular_velocity[:-1]]))
    stream = run_ukf(start, dt, rates, imu.linear_acceleration, settings=NOISE)
    expected, P = extended_filter(imu, start, NOISE)
    actual = rotation_from_wxyz(stream.quat_wxyz)
    apart = np.linalg.norm(SO3.log(expected.transpose(0, 2, 1) @ actual), axis=1)
    assert np.degrees(apart).max() < 0.1
    R = actual[-1]
    np.testing.assert_allclose(R.T @ stream.covariance[-1, :3, :3] @ R, P[:3, :3], rtol=0.1, atol=2e-6)


def test_uncertain_gains_are_found_from_gravity() -> None:
    imu, truth, _ = tumble(8)
    true = np.array([1.05, 0.94, 1.0])
    wrong = replace(imu, angular_velocity=imu.angular_velocity / true)
    found = estimate_attitude(replace(wrong, gyro_gain_sigma=0.1), NOISE)
    left = estimate_attitude(wrong, NOISE)
    assert "gravity shows the gyro's gains to be off" in found.remarks[-1]
    assert len(left.remarks) == 1
    angle_found, angle_left = (attitude_errors(each.trajectory, truth).angle_deg for each in (found, left))
    assert angle_found < 0.5 * angle_left


def test_mounting_turns_the_imu_into_the_base() -> None:
    imu, _, _ = tumble(4, seconds=10)
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_euler("xyz", [0.5, -0.3, 2.0]).as_matrix()
    R = mount[:3, :3]
    mounted = Imu(stamps_s=imu.stamps_s, angular_velocity=imu.angular_velocity @ R,
                  linear_acceleration=imu.linear_acceleration @ R, T_base_imu=mount)  # fmt: skip
    np.testing.assert_allclose(
        estimate_attitude(mounted, NOISE).rotations, estimate_attitude(imu, NOISE).rotations, atol=1e-9
    )


def test_unusable_imus_are_refused() -> None:
    imu, _, _ = tumble(1, seconds=3)

    def changed(**fields: FloatArray) -> Imu:
        names = ("stamps_s", "angular_velocity", "linear_acceleration", "T_base_imu")
        return Imu(**{name: fields.get(name, getattr(imu, name)) for name in names})

    with pytest.raises(InputError, match="no samples"):
        estimate_attitude(changed(stamps_s=np.zeros(0), angular_velocity=np.zeros((0, 3)),
                                  linear_acceleration=np.zeros((0, 3))))  # fmt: skip
    with pytest.raises(InputError, match="clock runs backwards"):
        estimate_attitude(changed(stamps_s=imu.stamps_s[::-1]))
    with pytest.raises(InputError, match="no acceleration"):
        estimate_attitude(changed(linear_acceleration=np.zeros((len(imu), 3))))
