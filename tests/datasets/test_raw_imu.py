"""Raw ADC counts of the IMU board: conversion, gyro outages, and one clear error for every bad file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from posegraph_slam.datasets import read
from posegraph_slam.datasets.imu_vicon import detects
from posegraph_slam.datasets.raw_imu import BOARD, imu_from_counts
from posegraph_slam.datasets.raw_imu_states import GYRO_REFERENCE, find_rest, gyro_outages
from posegraph_slam.errors import InputError
from posegraph_slam.sensors import STANDARD_GRAVITY

COUNT_MV = 3300 / 1023
GYRO_ZERO = np.array([369.6, 373.6, 375.4])


def counts_of(omega: np.ndarray, accel_g: np.ndarray, offset_g: np.ndarray | None = None) -> np.ndarray:
    """Return what the ADC reads (6, N), with rounding, of rates rad/s and specific force in g (N, 3).

    By the known board, or by one with nominal gains whose accelerometer is off by `offset_g`.
    """
    if offset_g is None:
        accel_g = accel_g @ np.linalg.inv(BOARD.accelerometer_matrix).T
        offset_g = BOARD.accelerometer_offset / STANDARD_GRAVITY
        omega = omega @ np.linalg.inv(BOARD.gyro_matrix).T
    g_counts = 511.5 + 330 / COUNT_MV * (accel_g + offset_g) * [-1, -1, 1]
    w_counts = np.degrees(omega) * 3.33 / COUNT_MV
    return np.rint(np.vstack([g_counts.T, GYRO_ZERO[:, None] + w_counts.T[[2, 0, 1]]]))


def a_run(**changes: Any) -> dict[str, Any]:
    """Fields of a run: three seconds of rest, then a turn about x by 1 rad; None drops a field."""
    n = 500
    t = 1.3e9 + 0.01 * np.arange(n)
    omega = np.zeros((n, 3))
    omega[300:400, 0] = 1.0
    R = Rotation.from_rotvec(np.cumsum(omega, axis=0) * 0.01).as_matrix()
    fields = {
        "imu_raw": counts_of(omega, R[:, 2]).astype(np.uint16),
        "imu_stamps_s": t,
        "vicon_rotation": np.moveaxis(R[::2], 0, 2),
        "vicon_stamps_s": t[::2],
    }
    return {name: value for name, value in {**fields, **changes}.items() if value is not None}


def write(folder: Path, **changes: Any) -> Path:
    path = folder / "run.npz"
    np.savez(path, **a_run(**changes))
    return path


def test_counts_become_si_units_in_the_right_axes() -> None:
    n = 600
    t = 0.01 * np.arange(n)
    omega, accel = np.zeros((n, 3)), np.tile([0.0, 0.0, 1.0], (n, 1))
    omega[300:] = [1.0, -2.0, 0.5]
    accel[300:] = [0.6, -0.3, 0.74]
    imu, remarks = imu_from_counts(counts_of(omega, accel), t, where="test")
    # One count is 0.018 rad/s and 0.0096 g; the zero of a channel that never dithers is off by half a count. Stamps of
    # the board are 19.5 ms early: what it stamps 3.00 s happened at 3.02 s.
    changing = slice(299, 302)
    assert np.allclose(imu.linear_acceleration[300] / STANDARD_GRAVITY, accel[0], atol=0.012)
    assert np.allclose(imu.linear_acceleration[302] / STANDARD_GRAVITY, accel[-1], atol=0.012)
    actual, expected = np.delete(imu.angular_velocity, changing, 0), np.delete(omega, changing, 0)
    np.testing.assert_allclose(actual, expected, atol=0.02)
    actual, expected = np.delete(imu.linear_acceleration, changing, 0), np.delete(accel, changing, 0)
    np.testing.assert_allclose(actual / STANDARD_GRAVITY, expected, atol=0.012)
    assert remarks == ("zero rates from a still start of 3.0 s",)


@given(roll=st.floats(-90, 90), pitch=st.floats(-90, 90))
@settings(max_examples=20)
def test_the_known_board_may_start_in_any_pose(roll: float, pitch: float) -> None:
    tilted = np.tile(Rotation.from_euler("YX", [pitch, roll], degrees=True).as_matrix()[2], (300, 1))
    imu, remarks = imu_from_counts(counts_of(np.zeros((300, 3)), tilted), 0.01 * np.arange(300), where="test")
    np.testing.assert_allclose(imu.linear_acceleration / STANDARD_GRAVITY, tilted, atol=0.012)
    assert "not the known board" not in remarks[0]


def tumbling(seconds: float, *, first: Rotation, still_s: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (N,), rates and upward directions (N, 3) of a body that rests at `first`, then visits many poses."""
    t = 0.01 * np.arange(int(100 * seconds))
    rates = np.clip(t - still_s, 0, 1)[:, None] * np.sin(np.array([0.5, 0.8, 0.6]) * t[:, None] + [0.0, 1.0, 2.0])
    turned = [first]
    for turn in Rotation.from_rotvec(0.01 * rates[:-1]):
        turned.append(turned[-1] * turn)
    return t, rates, Rotation.concatenate(turned).as_matrix()[:, 2]


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0])
@pytest.mark.parametrize("offset_g", [(0.0, 0.0, 0.0), (0.1, -0.12, 0.08)])
def test_another_board_is_calibrated_by_gravity(tilt_deg: float, offset_g: tuple[float, ...]) -> None:
    t, omega, up = tumbling(30, first=Rotation.from_euler("x", tilt_deg, degrees=True))
    imu, remarks = imu_from_counts(counts_of(omega, up, np.array(offset_g)), t, where="test")
    np.testing.assert_allclose(imu.angular_velocity, omega, atol=0.02)
    np.testing.assert_allclose(imu.linear_acceleration / STANDARD_GRAVITY, up, atol=0.02)
    assert "not the known board" in remarks[0]
    assert "data sheet's axes and gyro" in remarks[0]
    assert ("level start" in remarks[0]) == (tilt_deg == 0)
    assert imu.gyro_gain_sigma == 0.1


@pytest.mark.parametrize("shift", [(8, -7, 8), (-6, 9, -5)])
def test_a_shifted_zero_leaves_the_axes_of_the_known_board(shift: tuple[int, ...]) -> None:
    t, omega, up = tumbling(40, first=Rotation.identity())
    counts = counts_of(omega, up)
    counts[:3] += np.array(shift)[:, None]
    imu, remarks = imu_from_counts(counts, t + 1e9, where="test")
    assert "the known board's axes and gyro" in remarks[0]
    late = np.stack([np.interp(t - BOARD.early_s, t, axis) for axis in up.T], axis=1)
    np.testing.assert_allclose(imu.linear_acceleration / STANDARD_GRAVITY, late, atol=0.025)


def test_another_board_in_one_tilted_pose_keeps_the_data_sheet() -> None:
    tilted = np.tile(Rotation.from_euler("x", 60, degrees=True).as_matrix()[2], (300, 1))
    counts = counts_of(np.zeros((300, 3)), tilted, np.array([0.05, -0.1, 0.1]))
    imu, remarks = imu_from_counts(counts, 0.01 * np.arange(300), where="test")
    assert "not the known board" in remarks[0]
    assert "level start" not in remarks[0]
    np.testing.assert_allclose(imu.linear_acceleration / STANDARD_GRAVITY, tilted, atol=0.12)


@pytest.mark.parametrize("noise", [0.6, 2.0, 3.0])
def test_rest_is_found_in_any_noise_and_anywhere(noise: float) -> None:
    rng = np.random.default_rng(4)
    t, omega, up = tumbling(12, first=Rotation.identity(), still_s=4.0)
    counts = np.rint(counts_of(omega, up) + rng.normal(0, noise, (6, len(t))))
    rest = find_rest(counts, t)
    assert rest is not None
    assert (rest.start, rest.stop) == (0, pytest.approx(415, abs=25))
    if noise < 1.0:
        rest = find_rest(counts[:, ::-1], t)
        assert rest is not None
        assert (rest.start, rest.stop) == (pytest.approx(785, abs=25), 1200)


def test_the_known_board_need_not_rest_and_another_one_must() -> None:
    t, omega, up = tumbling(20, first=Rotation.identity(), still_s=-1.0)
    imu, remarks = imu_from_counts(counts_of(omega, up), t, where="test")
    assert "never rests for 0.5 s: zero rates are those of the known board" in remarks[0]
    np.testing.assert_allclose(imu.angular_velocity[5:], omega[3:-2], atol=0.03)
    with pytest.raises(InputError, match=r"never rests for 0\.5 s; the gyros' zero levels cannot be found"):
        imu_from_counts(counts_of(omega, up, np.zeros(3)), t, where="test")


@pytest.mark.parametrize(("noise", "shift"), [(0.6, 0.0), (1.2, 0.0), (0.6, 8.0), (2.0, -6.0)])
def test_outages_are_found_in_noise_and_at_another_level(noise: float, shift: float) -> None:
    rng = np.random.default_rng(0)
    turning = 40 * np.sin(0.05 * np.arange(1000) + np.array([[0.0], [1.0], [2.0]]))
    counts = GYRO_ZERO[:, None] + shift + turning
    counts[:, 400:500] = GYRO_REFERENCE + shift + np.array([[0.7], [1.3], [2.3]])
    counts = np.rint(counts + rng.normal(0, noise, counts.shape))
    found = gyro_outages(counts, zero=GYRO_ZERO + shift, noise=noise)
    assert found[402:498].mean() > 0.97
    assert not found[:395].any()
    assert not found[505:].any()


def test_rest_at_the_reference_and_slow_turns_are_no_outages() -> None:
    """Data sheets put the zero of a gyro at its reference, and a body may turn slowly and steadily about all axes."""
    rng = np.random.default_rng(1)
    for zero, rate in ((GYRO_REFERENCE, 0.0), (GYRO_ZERO, 9.0), (375.0, 6.0)):
        at = np.arange(2000) - 800
        turning = rate * np.clip(at / 100, 0, 1)  # steady at 6 to 9 deg/s after a second
        counts = np.rint(np.broadcast_to(zero, 3)[:, None] + turning + rng.normal(0, 0.6, (3, 2000)))
        assert not gyro_outages(counts, zero=np.broadcast_to(zero, 3), noise=0.6).any()


def test_outages_are_found_and_ordinary_noise_is_not() -> None:
    rng = np.random.default_rng(0)
    counts = np.rint(GYRO_ZERO[:, None] + rng.normal(0, 0.6, (3, 1000)))
    counts[:, 400:500] = np.rint(GYRO_REFERENCE + np.array([[0.7], [1.3], [2.3]]))
    found = gyro_outages(counts, zero=GYRO_ZERO, noise=0.6)
    assert found[402:498].all()
    assert not found[:398].any()
    assert not found[502:].any()
    turning = np.rint(GYRO_REFERENCE + rng.normal(0, 2.0, (3, 1000)))
    assert not gyro_outages(turning, zero=GYRO_ZERO, noise=0.6).any()
    assert not gyro_outages(counts[:, :5], zero=GYRO_ZERO, noise=0.6).any()


def test_rates_of_an_outage_are_unknown(tmp_path: Path) -> None:
    raw = a_run()["imu_raw"]
    raw[3:, 420:480] = 382
    log = read(write(tmp_path, imu_raw=raw))
    assert log.imu is not None
    assert np.isnan(log.imu.angular_velocity[422:481]).all()
    assert np.isfinite(log.imu.angular_velocity[:415]).all()
    assert "reference voltage for 0.60 s, first at 4.20 s" in log.remarks[1]


def test_run_is_recognised_and_read(tmp_path: Path) -> None:
    path = write(tmp_path)
    log = read(path)
    assert detects(path)
    assert log.format == "imu_vicon"
    assert log.imu is not None
    assert log.truth is not None
    assert (len(log.imu), len(log.truth)) == (500, 250)
    without = read(write(tmp_path, vicon_rotation=None, vicon_stamps_s=None))
    assert without.truth is None


def test_stamps_without_truth_are_left_out(tmp_path: Path) -> None:
    R = a_run()["vicon_rotation"].copy()
    R[:, :, 20:25], R[:, :, 60] = np.nan, 0.0
    log = read(write(tmp_path, vicon_rotation=R))
    assert log.truth is not None
    assert len(log.truth) == 244
    assert "no truth at 6 of 250 of its stamps, first at 0.40 s" in log.remarks[-1]
    assert np.isfinite(log.truth.poses).all()


def test_rates_beyond_the_range_are_told(tmp_path: Path) -> None:
    raw = a_run()["imu_raw"].copy()
    raw[4, 350:360] = 1023
    told = read(write(tmp_path, imu_raw=raw)).remarks
    assert "the gyros are at the end of their range for 0.10 s, first at 3.50 s" in told[1]
    assert not any("end of their range" in remark for remark in read(write(tmp_path)).remarks)


T = 1.3e9 + 0.01 * np.arange(500)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"imu_stamps_s": None}, "no field 'imu_stamps_s'; it holds imu_raw"),
        ({"imu_raw": np.zeros((6, 499))}, "'imu_raw' has shape"),
        ({"imu_raw": np.zeros((5, 500))}, "'imu_raw' has shape"),
        ({"imu_raw": np.full((6, 500), 2000)}, "outside 0 to 1023"),
        ({"imu_raw": np.full((6, 500), np.nan)}, "'imu_raw' is not finite at index 0"),
        ({"imu_raw": np.full((6, 500), "a")}, "not a number"),
        ({"imu_raw": np.tile(np.arange(500), (6, 1))}, "never rests"),
        ({"imu_stamps_s": np.r_[T[:100], T[50:450]]}, "runs backwards at index 100"),
        ({"imu_stamps_s": np.r_[T[:-1], np.nan]}, "'imu_stamps_s' is not finite at index 499"),
        ({"imu_stamps_s": np.zeros(0), "imu_raw": np.zeros((6, 0))}, "expected"),
        ({"vicon_stamps_s": None}, "no field 'vicon_stamps_s'"),
        ({"vicon_stamps_s": T}, "'vicon_rotation' has shape"),
        ({"vicon_rotation": np.ones((3, 3, 250))}, "no rotation at 250 of 250 stamps, first at index 0"),
        ({"vicon_rotation": np.full((3, 3, 250), np.nan)}, "no rotation at 250 of 250 stamps"),
        ({"vicon_rotation": np.ones((250, 3, 3))}, "'vicon_rotation' has shape"),
    ],
)
def test_bad_fields_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = write(tmp_path, **changes)
    with pytest.raises(InputError) as caught:
        read(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.97])
def test_truncated_files_are_refused(tmp_path: Path, share: float) -> None:
    path = write(tmp_path)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(InputError, match=r"run\.npz: cannot be read as an \.npz archive"):
        read(path)
