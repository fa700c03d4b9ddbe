"""Gains of a gyro from gravity alone: the vertical, seen from the turning body, has to stay where it was."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from posegraph_slam.arrays import FloatArray
from posegraph_slam.odometry.attitude.complementary import complementary_stream
from posegraph_slam.odometry.attitude.quaternions import rotation_from_wxyz
from posegraph_slam.odometry.attitude.settings import AttitudeSettings
from posegraph_slam.odometry.attitude.start import find_start
from posegraph_slam.odometry.attitude.steps import steps
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu

BLOCK_S = 1.0
"""Accelerations are averaged over this time in the integrated frame: those of a moving hand nearly cancel."""
LAG_BLOCKS = 2
VERTICAL_SIGMA = 0.07
"""Of the difference of two block means in g."""


def estimate_gyro_gain(imus: Sequence[Imu], *, prior_sigma: float = 0.06) -> tuple[FloatArray, FloatArray]:
    """Find the factors (3,) on the rates of several runs of one IMU, and their standard deviations (3,).

    Mean accelerations two seconds apart, turned into one frame by the integrated gyro, have to agree (robust least
    squares); the prior 1 +- `prior_sigma` holds axes whose turns do not move gravity. Blocks with NaN are left out.
    """
    runs = [_prepare(imu) for imu in imus]

    def residuals(offset: FloatArray) -> FloatArray:
        drifts = np.concatenate([_drift(*run, 1.0 + offset) for run in runs]) / VERTICAL_SIGMA
        robust = np.sign(drifts) * np.sqrt(2.0 * (np.sqrt(1.0 + drifts**2) - 1.0))  # pseudo-Huber
        return np.concatenate([robust, offset / prior_sigma])

    fit = least_squares(residuals, np.zeros(3))
    J = np.asarray(fit.jac, dtype=np.float64)
    return np.asarray(1.0 + fit.x), np.asarray(np.sqrt(np.diag(np.linalg.inv(J.T @ J))))


def _prepare(imu: Imu) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Stamps from zero (N,), step durations (N,), rates without bias (N, 3) and accelerations (N, 3) in g."""
    settings = AttitudeSettings()
    start = find_start(imu.stamps_s, imu.angular_velocity, imu.linear_acceleration, settings)
    dt, rates = steps(imu.stamps_s, imu.angular_velocity, settings.max_gap_s)
    elapsed = imu.stamps_s - imu.stamps_s[0]
    return elapsed, dt, rates - start.gyro_bias, imu.linear_acceleration / STANDARD_GRAVITY


def _drift(elapsed: FloatArray, dt: FloatArray, rates: FloatArray, accel: FloatArray, gain: FloatArray) -> FloatArray:
    """Differences (3 M,) of the mean accelerations of blocks `LAG_BLOCKS` apart.

    Left out where a rate between is unknown or a block has no samples.
    """
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    quat_wxyz = complementary_stream(dt, rates * gain, accel, 1.0, -1.0, np.inf, identity)
    world = np.einsum("nij,nj->ni", rotation_from_wxyz(quat_wxyz), accel)
    number, block = np.unique((elapsed / BLOCK_S).astype(np.int64), return_inverse=True)
    mean = np.stack([np.bincount(block, weights=axis) for axis in world.T], axis=1) / np.bincount(block)[:, None]
    unknown = np.cumsum(np.bincount(block, weights=~np.isfinite(rates).all(axis=1)))
    before = np.concatenate([[0.0], unknown])[: -LAG_BLOCKS - 1]
    known = (unknown[LAG_BLOCKS:] == before) & (number[LAG_BLOCKS:] - number[:-LAG_BLOCKS] == LAG_BLOCKS)
    return np.asarray((mean[LAG_BLOCKS:] - mean[:-LAG_BLOCKS])[known]).ravel()
