"""Calibration of an IMU against a reference orientation: gains, axes and offsets from runs under motion capture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d
from scipy.optimize import minimize_scalar

from posegraph_slam.arrays import BoolArray, FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SO3, Trajectory, interpolate
from posegraph_slam.odometry.attitude.settings import AttitudeSettings
from posegraph_slam.odometry.attitude.start import find_start
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu, ImuCalibration

MAX_CLOCK_OFFSET_S = 0.1
CLOCK_STEP_S = 0.005
RATE_SPAN = 2
"""True rates are differences over this many stamps to either side."""
RATE_SCALE = 0.2
"""rad/s; residuals of the rate beyond it count less: leaps of the reference are far larger, errors of gain smaller."""
FORCE_SCALE = 0.05
"""m/s^2; the same of the specific force, which a moving hand exceeds by far."""
MEAN_SAMPLES = 11
"""Specific forces and true verticals are averaged over this many samples (0.1 s), against vibration."""
ITERATIONS = 30
MIN_SAMPLES = 100


def calibrate_against_reference(runs: Sequence[tuple[Imu, Trajectory]]) -> ImuCalibration:
    """Fit the calibration under which the IMU of all runs agrees with their true orientations.

    Each run is an IMU, still at its start, and the poses of the body in a world whose z axis points up. Robust linear
    regression of true rates on measured ones, and of measured specific forces on g times the true vertical seen from
    the body: the hand's own accelerations are taken to cancel over a run. The clocks of each run may differ by a
    constant (`clock_offset`), whose mean is the calibration's. The accelerometer needs poses in which each axis is
    tilted far (Titterton and Weston 2004, section 8.3). Raises `InputError` for runs that overlap by less than a
    hundred samples.
    """
    verticals, forces, measured, true = [], [], [], []
    offsets = [clock_offset(imu, reference) for imu, reference in runs]
    for (imu, reference), offset in zip(runs, offsets, strict=True):
        rates_in, rates_out = _rates(imu, reference, offset)
        if len(rates_in) < MIN_SAMPLES:
            problem = f"only {len(rates_in)} of its stamps are covered by the IMU"
            raise InputError("reference", problem, "check that both use one clock")
        measured.append(rates_in)
        true.append(rates_out)
        vertical, force = _forces(imu, reference, offset)
        verticals.append(vertical)
        forces.append(force)
    gyro, _ = _regression(np.concatenate(measured), np.concatenate(true), RATE_SCALE)
    constant = np.concatenate([np.concatenate(verticals), np.ones((sum(map(len, verticals)), 1))], axis=1)
    accelerometer, _ = _regression(constant, np.concatenate(forces), FORCE_SCALE)
    return ImuCalibration(
        accelerometer_offset=accelerometer[:, 3],
        accelerometer_matrix=np.asarray(np.linalg.inv(accelerometer[:, :3]), dtype=np.float64),
        gyro_matrix=gyro,
        early_s=float(np.mean(offsets)),
    )


def clock_offset(imu: Imu, reference: Trajectory) -> float:
    """Seconds by which the stamps of the reference are later than those of the IMU: where their rates agree best.

    Zero where no offset of up to 0.1 s fits better than both a smaller and a larger one, or less than a hundred stamps
    are shared.
    """

    def cost(offset: float) -> float:
        measured, true = _rates(imu, reference, offset)
        return _regression(measured, true, RATE_SCALE)[1] if len(measured) >= MIN_SAMPLES else np.inf

    steps = int(MAX_CLOCK_OFFSET_S / CLOCK_STEP_S)
    grid = CLOCK_STEP_S * np.arange(-steps, steps + 1)
    best = int(np.argmin([cost(offset) for offset in grid]))
    if best in (0, len(grid) - 1):
        return 0.0
    bounds = (grid[best - 1], grid[best + 1])
    return float(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-4}).x)


def _rates(imu: Imu, reference: Trajectory, offset: float) -> tuple[FloatArray, FloatArray]:
    """Measured rates without bias and true rates (n, 3) at the stamps of the reference that the IMU covers."""
    stamps, first = np.unique(reference.stamps_s, return_index=True)
    R = reference.poses[first, :3, :3]
    turns = SO3.log(R[: -2 * RATE_SPAN].transpose(0, 2, 1) @ R[2 * RATE_SPAN :])
    true = turns / (stamps[2 * RATE_SPAN :] - stamps[: -2 * RATE_SPAN])[:, None]
    at = stamps[RATE_SPAN:-RATE_SPAN] - offset
    start = find_start(imu.stamps_s, imu.angular_velocity, imu.linear_acceleration, AttitudeSettings())
    rates = imu.angular_velocity - start.gyro_bias
    unknown = np.asarray(~np.isfinite(rates).all(axis=1))
    smooth = uniform_filter1d(np.where(unknown[:, None], 0.0, rates), 2 * RATE_SPAN + 1, axis=0)
    measured = np.stack([np.interp(at, imu.stamps_s, axis) for axis in smooth.T], axis=1)
    nearly_unknown = maximum_filter1d(unknown.astype(np.float64), 2 * RATE_SPAN + 3)
    kept = _covered(at, imu.stamps_s) & (np.interp(at, imu.stamps_s, nearly_unknown) < 0.01)
    return measured[kept], true[kept]


def _forces(imu: Imu, reference: Trajectory, offset: float) -> tuple[FloatArray, FloatArray]:
    """True verticals in the body times g and mean specific forces (n, 3) m/s^2 at the IMU stamps under reference."""
    at = imu.stamps_s + offset
    vertical = STANDARD_GRAVITY * interpolate(reference, at).poses[:, 2, :3]
    mean_vertical, mean_force = (
        uniform_filter1d(each, MEAN_SAMPLES, axis=0) for each in (vertical, imu.linear_acceleration)
    )
    known = np.isfinite(mean_force).all(axis=1) & _covered(at, reference.stamps_s)
    return mean_vertical[known], mean_force[known]


def _covered(stamps: FloatArray, by: FloatArray) -> BoolArray:
    return np.asarray((stamps > by[0]) & (stamps < by[-1]), dtype=np.bool_)


def _regression(X: FloatArray, Y: FloatArray, scale: float) -> tuple[FloatArray, float]:
    """Matrix M (k, p) with Y (n, k) near X (n, p) M^T under the Cauchy loss, and the mean loss in units of scale.

    A prior as weak as one sample of size `scale` holds what X does not show at the identity.
    """
    weight, prior = np.ones(len(X)), scale**2 * np.eye(X.shape[1])
    for _ in range(ITERATIONS):
        weighted = X * weight[:, None]
        M_T = np.linalg.solve(weighted.T @ X + prior, weighted.T @ Y + prior[:, : Y.shape[1]])
        residuals = np.linalg.norm(Y - X @ M_T, axis=1) / scale
        weight = 1.0 / (1.0 + residuals**2)
    return np.asarray(M_T.T, dtype=np.float64), float(np.mean(np.log1p(residuals**2)))
