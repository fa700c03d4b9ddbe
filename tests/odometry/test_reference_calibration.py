"""Calibration against a reference orientation: known errors are found again, and each real run confirms the others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from posegraph_slam.datasets import read
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.attitude import AttitudeErrors, attitude_errors
from posegraph_slam.geometry import SO3, Trajectory, pose_from_rotation_translation
from posegraph_slam.odometry.attitude import calibrate_against_reference, clock_offset, estimate_attitude
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu, RobotLog

GYRO = np.array([[1.08, 0.02, -0.01], [0.0, 0.95, 0.03], [0.01, 0.0, 1.02]])
ACCELEROMETER = np.array([[1.02, 0.02, -0.03], [0.0, 1.01, -0.01], [-0.02, 0.0, 0.99]])
OFFSET = np.array([0.2, -0.4, 0.1])


def a_run(seed: int, *, late_s: float, faults: bool = True) -> tuple[Imu, Trajectory]:
    """A minute of tumbling after a rest, as a miscalibrated IMU and a reference `late_s` behind it see it."""
    rng = np.random.default_rng(seed)
    n, dt = 6000, 0.01
    t = dt * np.arange(n)
    rates = (t > 2.0)[:, None] * np.sin(rng.uniform(0.3, 0.9, 3) * t[:, None] + rng.uniform(0, 6, 3))
    R = np.tile(np.eye(3), (n, 1, 1))
    for k, step in enumerate(SO3.exp(0.5 * (rates[1:] + rates[:-1]) * dt)):
        R[k + 1] = R[k] @ step
    force = STANDARD_GRAVITY * R[:, 2] + rng.normal(0, 0.05, (n, 3))
    measured = rates @ np.linalg.inv(GYRO).T + [0.01, -0.02, 0.005] + rng.normal(0, 0.01, (n, 3))
    if faults:
        force[1000:1300] += 3.0
        R[4000:4040] = R[4000:4040] @ SO3.exp(np.array([0.3, 0.0, 0.1]))
        measured[2000:2100] = np.nan
    imu = Imu(
        stamps_s=t,
        angular_velocity=measured,
        linear_acceleration=force @ np.linalg.inv(ACCELEROMETER).T + OFFSET,
        T_base_imu=np.eye(4),
    )
    poses = pose_from_rotation_translation(R, np.zeros((n, 3)))
    return imu, Trajectory(stamps_s=t + late_s, poses=poses, parent="ref", child="base")


def test_known_errors_are_found_despite_faults_and_clocks() -> None:
    runs = [a_run(1, late_s=0.026), a_run(2, late_s=-0.013)]
    found = calibrate_against_reference(runs)
    np.testing.assert_allclose(found.gyro_matrix, GYRO, atol=0.005)
    np.testing.assert_allclose(found.accelerometer_matrix, ACCELEROMETER, atol=0.002)
    np.testing.assert_allclose(found.accelerometer_offset, OFFSET, atol=0.02)
    assert found.early_s == pytest.approx(0.5 * (0.026 - 0.013), abs=0.002)
    at_rest = found.apply(runs[0][0]).linear_acceleration[:200].mean(axis=0)
    np.testing.assert_allclose(at_rest, [0.0, 0.0, STANDARD_GRAVITY], atol=0.03)


@pytest.mark.parametrize("late_s", [-0.05, 0.0, 0.0262])
def test_clock_offset_is_how_late_the_reference_is(late_s: float) -> None:
    imu, reference = a_run(3, late_s=late_s)
    assert clock_offset(imu, reference) == pytest.approx(late_s, abs=0.002)


def test_early_stamps_are_brought_to_the_clock_of_the_reference() -> None:
    imu, reference = a_run(3, late_s=0.0262, faults=False)
    found = calibrate_against_reference([(imu, reference)])
    applied = found.apply(imu)
    np.testing.assert_array_equal(applied.stamps_s, imu.stamps_s)
    assert clock_offset(applied, reference) == pytest.approx(0.0, abs=0.002)
    same = replace(found, early_s=0.0).apply(imu)
    assert clock_offset(same, reference) == pytest.approx(0.0262, abs=0.002)


def test_stamps_that_repeat_do_not_tell_a_rate() -> None:
    imu, reference = a_run(5, late_s=0.03, faults=False)
    held = reference.restamped(np.repeat(reference.stamps_s[::6], 6))
    assert clock_offset(imu, held) == clock_offset(imu, reference.select(np.arange(0, len(reference), 6))) != 0.0


def test_runs_of_different_times_are_refused() -> None:
    imu, reference = a_run(4, late_s=0.0, faults=False)
    assert clock_offset(replace(imu, stamps_s=imu.stamps_s + 1e4), reference) == 0.0
    with pytest.raises(InputError, match="only 0 of its stamps are covered by the IMU"):
        calibrate_against_reference([(replace(imu, stamps_s=imu.stamps_s + 1e4), reference)])


@pytest.mark.data
def test_each_real_run_is_as_good_with_the_calibration_of_the_others(psg_data: Path) -> None:
    """Their clocks differ by up to 20 ms from that of the one left out, 0.3 deg where it turns by 15 deg/s."""
    logs = [read(psg_data / "orientation" / f"imu_vicon_{k}.npz") for k in (1, 2, 3)]
    for left_out, log in enumerate(logs):
        others = [(each.imu, each.truth) for k, each in enumerate(logs) if k != left_out and each.imu and each.truth]
        assert log.imu is not None
        known, again = _errors(log, log.imu), _errors(log, calibrate_against_reference(others).apply(log.imu))
        assert abs(again.tilt_deg - known.tilt_deg) < 0.3
        assert abs(again.heading_deg - known.heading_deg) < 0.4
        assert max(again.roll_deg, again.pitch_deg) < 3.0
        assert again.yaw_deg < 8.0


def _errors(log: RobotLog, imu: Imu) -> AttitudeErrors:
    assert log.truth is not None
    as_calibrated = replace(imu, gyro_gain_sigma=0.0)
    return attitude_errors(estimate_attitude(as_calibrated).trajectory, log.truth)
