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
from posegraph_slam.datasets.raw_imu import (
    BOARD,
    GYRO_REFERENCE,
    gyro_outages,
    imu_from_counts,
)
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
    accel[300:] = [0.6, -0.3, 0.7]
    imu, remarks = imu_from_counts(counts_of(omega, accel), t, where="test")
    # One count is 0.018 rad/s and 0.0096 g; the zero of a channel that never dithers is off by half a count.
    np.testing.assert_allclose(imu.angular_velocity, omega, atol=0.02)
    np.testing.assert_allclose(imu.linear_acceleration / STANDARD_GRAVITY, accel, atol=0.012)
    assert remarks == ("zero rates from a still start of 3.0 s",)


@given(roll=st.floats(-90, 90), pitch=st.floats(-90, 90))
@settings(max_examples=20)
def test_the_known_board_may_start_in_any_pose(roll: float, pitch: float) -> None:
    tilted = np.tile(Rotation.from_euler("YX", [pitch, roll], degrees=True).as_matrix()[2], (300, 1))
    imu, remarks = imu_from_counts(counts_of(np.zeros((300, 3)), tilted), 0.01 * np.arange(300), where="test")
    np.testing.assert_allclose(imu.linear_acceleration / STANDARD_GRAVITY, tilted, atol=0.012)
    assert "level" not in remarks[0]


def test_another_board_has_nominal_gains_and_a_level_start() -> None:
    t = 0.01 * np.arange(600)
    omega, accel = np.zeros((600, 3)), np.tile([0.0, 0.0, 1.0], (600, 1))
    omega[300:], accel[300:] = [1.0, -2.0, 0.5], [0.6, -0.3, 0.7]
    imu, remarks = imu_from_counts(counts_of(omega, accel, np.array([0.1, -0.2, 0.15])), t, where="test")
    np.testing.assert_allclose(imu.angular_velocity, omega, atol=0.02)
    np.testing.assert_allclose(imu.linear_acceleration / STANDARD_GRAVITY, accel, atol=0.012)
    assert "not the known board" in remarks[0]


def test_another_board_that_is_not_level_falls_back_to_the_data_sheet() -> None:
    tilted = np.tile(Rotation.from_euler("x", 60, degrees=True).as_matrix()[2], (300, 1))
    counts = counts_of(np.zeros((300, 3)), tilted, np.array([0.05, -0.1, 0.1]))
    imu, remarks = imu_from_counts(counts, 0.01 * np.arange(300), where="test")
    assert "not level" in remarks[0]
    np.testing.assert_allclose(imu.linear_acceleration / STANDARD_GRAVITY, tilted, atol=0.11)


def test_outages_are_found_and_ordinary_noise_is_not() -> None:
    rng = np.random.default_rng(0)
    counts = np.rint(GYRO_ZERO[:, None] + rng.normal(0, 0.6, (3, 1000)))
    counts[:, 400:500] = np.rint(GYRO_REFERENCE + np.array([[0.7], [1.3], [2.3]]))
    found = gyro_outages(counts)
    assert found[402:498].all()
    assert not found[:398].any()
    assert not found[502:].any()
    turning = np.rint(GYRO_REFERENCE + rng.normal(0, 2.0, (3, 1000)))
    assert not gyro_outages(turning).any()
    assert not gyro_outages(counts[:, :5]).any()


def test_rates_of_an_outage_are_unknown(tmp_path: Path) -> None:
    raw = a_run()["imu_raw"]
    raw[3:, 420:480] = 382
    log = read(write(tmp_path, imu_raw=raw))
    assert log.imu is not None
    assert np.isnan(log.imu.angular_velocity[420:480]).all()
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
        ({"imu_raw": np.tile(np.arange(500), (6, 1))}, "moves from the start"),
        ({"imu_stamps_s": np.r_[T[:100], T[50:450]]}, "runs backwards at index 100"),
        ({"imu_stamps_s": np.r_[T[:-1], np.nan]}, "'imu_stamps_s' is not finite at index 499"),
        ({"imu_stamps_s": np.zeros(0), "imu_raw": np.zeros((6, 0))}, "expected"),
        ({"vicon_stamps_s": None}, "no field 'vicon_stamps_s'"),
        ({"vicon_stamps_s": T}, "'vicon_rotation' has shape"),
        ({"vicon_rotation": np.ones((3, 3, 250))}, "holds no rotation at index 0"),
        ({"vicon_rotation": np.full((3, 3, 250), np.nan)}, "holds no rotation at index 0"),
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
