"""Bias of the gyro from still stretches, its exact integral, and the effective track width."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.odometry import GyroBiasSettings, estimate_gyro_bias
from posegraph_slam.odometry.gyro_bias import wheels_at_rest, yaw_rate
from posegraph_slam.odometry.gyro_integral import integrate_rate
from posegraph_slam.odometry.track_width import estimate_track_width
from posegraph_slam.sensors import Imu, WheelEncoders

SETTINGS = GyroBiasSettings()


def encoders_that_rest(stretches: list[tuple[float, float]], duration_s: float = 20.0) -> WheelEncoders:
    stamps = 1e9 + np.arange(0, duration_s, 0.025)
    ticks = np.full((len(stamps), 2), 10)
    for start, end in stretches:
        ticks[(stamps - 1e9 > start) & (stamps - 1e9 <= end)] = 0
    return WheelEncoders(
        stamps_s=stamps, ticks_left=ticks, ticks_right=ticks, metres_per_tick=0.001, track_width_m=0.5
    )  # fmt: skip


def imu_with(rate: np.ndarray, stamps: np.ndarray, R_base_imu: np.ndarray | None = None) -> Imu:
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if R_base_imu is None else R_base_imu
    omega = np.stack([np.zeros_like(rate), np.zeros_like(rate), rate], axis=1) @ T[:3, :3]
    return Imu(
        stamps_s=stamps, angular_velocity=omega, linear_acceleration=np.zeros_like(omega), T_base_imu=T
    )  # fmt: skip


def test_the_bias_is_found_within_its_standard_error() -> None:
    encoders = encoders_that_rest([(-1, 4), (12, 15)])
    stamps = 1e9 + np.arange(0, 20, 0.01)
    moving = ~(((stamps - 1e9) < 4) | ((stamps - 1e9 > 12) & (stamps - 1e9 < 15)))
    scores = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        rate = 0.013 + rng.normal(0, 0.004, len(stamps)) + 0.5 * moving
        bias = estimate_gyro_bias(encoders, imu_with(rate, stamps), SETTINGS)
        assert len(bias.still_s) == 2
        scores.append((bias.rad_s - 0.013) / bias.sigma_rad_s)
    # the standard error is right: neither much too small nor much too large
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.15
    assert np.abs(scores).max() < 4
    np.testing.assert_allclose(bias.noise_density, 0.004 * np.sqrt(0.01), rtol=0.1)


def test_stretches_that_disagree_widen_the_standard_error() -> None:
    encoders = encoders_that_rest([(-1, 4), (12, 15)])
    stamps = 1e9 + np.arange(0, 20, 0.01)
    noise = np.random.default_rng(1).normal(0, 0.004, len(stamps))
    steady = estimate_gyro_bias(encoders, imu_with(0.01 + noise, stamps), SETTINGS)
    drifting = estimate_gyro_bias(encoders, imu_with(0.01 + noise + 2e-4 * (stamps - 1e9), stamps), SETTINGS)
    assert drifting.sigma_rad_s > 2 * steady.sigma_rad_s


def test_a_stretch_is_found_between_its_first_and_last_tick() -> None:
    encoders = encoders_that_rest([(5, 9)])
    (still,) = wheels_at_rest(encoders, SETTINGS) - 1e9
    np.testing.assert_allclose(still, [5 + SETTINGS.margin_s, 9 - SETTINGS.margin_s], atol=0.026)


def test_a_robot_that_is_turned_by_hand_does_not_stand_still() -> None:
    encoders = encoders_that_rest([(-1, 21)])
    stamps = 1e9 + np.arange(0, 20, 0.01)
    bias = estimate_gyro_bias(encoders, imu_with(0.4 * np.sin(stamps), stamps), SETTINGS)
    assert bias.rad_s == 0.0
    assert bias.sigma_rad_s == SETTINGS.unknown_sigma_rad_s


def test_a_robot_that_never_stands_still_gets_no_bias_and_a_remark() -> None:
    stamps = 1e9 + np.arange(0, 20, 0.01)
    bias = estimate_gyro_bias(encoders_that_rest([]), imu_with(np.full(len(stamps), 0.1), stamps), SETTINGS)
    assert bias.rad_s == 0.0
    assert len(bias.still_s) == 0
    assert "never stands still" in bias.remarks[0]


def test_an_imu_mounted_upside_down_reports_the_base_rate() -> None:
    stamps = np.arange(5.0)
    imu = imu_with(np.full(5, 0.3), stamps, np.diag([1.0, -1.0, -1.0]))
    assert imu.angular_velocity[0, 2] == -0.3
    np.testing.assert_allclose(yaw_rate(imu), 0.3)


@given(st.integers(0, 2**32 - 1))
def test_the_integral_is_exact_for_a_rate_linear_between_samples(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.concatenate([[0.0], np.cumsum(rng.uniform(0.005, 0.05, 60))])
    rates = rng.normal(0, 1, 61)
    gyro = integrate_rate(stamps, rates, max_gap_s=1.0)
    start, end = np.sort(rng.uniform(0, stamps[-1], 2))
    fine = np.union1d(np.linspace(start, end, 50), stamps[(stamps > start) & (stamps < end)])
    angle, covered = gyro.at(np.array([start, end]))
    np.testing.assert_allclose(np.diff(angle)[0], np.trapezoid(np.interp(fine, stamps, rates), fine), atol=1e-12)
    np.testing.assert_allclose(np.diff(covered)[0], end - start, atol=1e-12)


def test_gaps_and_the_time_outside_are_not_covered() -> None:
    gyro = integrate_rate(np.array([1.0, 1.05, 2.0, 2.05, 2.05]), np.ones(5), max_gap_s=0.1)
    angle, covered = gyro.at(np.array([0.0, 1.0, 1.025, 1.5, 2.0, 2.05, 9.0]))
    np.testing.assert_allclose(covered, [0, 0, 0.025, 0.05, 0.05, 0.1, 0.1], atol=1e-12)
    np.testing.assert_allclose(angle, covered, atol=1e-12)


def test_the_track_width_is_found_in_spite_of_slip() -> None:
    rng = np.random.default_rng(3)
    stamps = np.arange(0, 60, 0.025)
    turn = 0.5 * np.sin(stamps) * 0.025
    difference = 0.7 * turn + rng.normal(0, 2e-4, len(turn))
    difference[400:500] += 0.004  # the robot is stuck and one side spins for 2.5 s
    width = estimate_track_width(stamps, difference, turn, nominal_m=0.5)
    assert width.fitted
    assert abs(width.metres - 0.7) < 0.02
    assert abs(width.metres - 0.7) < 4 * width.sigma_m


def test_the_track_width_of_the_log_is_kept_where_nothing_can_be_said() -> None:
    stamps = np.arange(0, 60, 0.025)
    turn = 0.5 * np.sin(stamps) * 0.025
    straight = estimate_track_width(stamps, 0 * turn, 0.001 * turn, nominal_m=0.5)
    swapped = estimate_track_width(stamps, -0.7 * turn, turn, nominal_m=0.5)
    nothing = estimate_track_width(stamps[:0], turn[:0], turn[:0], nominal_m=0.5)
    for width in (straight, swapped, nothing):
        assert not width.fitted
        assert width.metres == 0.5
    assert "hardly turns" in straight.remark
    assert "which side is left" in swapped.remark
