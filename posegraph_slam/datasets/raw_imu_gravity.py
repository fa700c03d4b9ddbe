"""Zero and gains of an accelerometer from the size of gravity, in whatever poses a run visits."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from posegraph_slam.arrays import FloatArray
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu, ImuCalibration

BLOCK_S = 0.2
"""Forces are averaged over this time against vibration."""
SIZE_SCALE = 0.02
"""Excess of |a|/g that counts in full, or the median of the run; stronger motion counts less (Cauchy's loss)."""
BLOCK_WEIGHT = 0.1
"""A hand's motion lasts: ten blocks tell as much as one alone would."""
OFFSET_SIGMA = 0.15
"""g; prior of the zero: 0.05 V."""
GAIN_SIGMA = 0.02
LEVEL_SIGMA = float(np.sin(np.radians(2.0)))
"""g; what a start that is taken as level may lean."""
LEVEL_SIGMAS = 3.0


def calibrate_by_gravity(imu: Imu, at_start: FloatArray | None) -> tuple[ImuCalibration, bool]:
    """Find offsets and gains under which the forces have the size of gravity; tell whether the start is level.

    `at_start` (3,) is the mean force of a still start, None without one: where the fit agrees that it points up, that
    is taken for granted. Poses not visited leave offsets and gains at their priors (Titterton and Weston 2004, 8.3).
    """
    blocks = _means(imu)
    start = None if at_start is None else at_start / STANDARD_GRAVITY
    found, covariance = _fit(blocks, None)
    level = start is not None and _may_be_level(start, found, covariance)
    if level:
        found, _ = _fit(blocks, start)
    calibration = ImuCalibration(
        accelerometer_offset=found[:3] * STANDARD_GRAVITY,
        accelerometer_matrix=np.diag(1.0 + found[3:]),
        gyro_matrix=np.eye(3),
    )
    return calibration, level


def excess_of_gravity(imu: Imu) -> float:
    """Mean of log(1 + e^2) over the run, e = (|a|/s - 1) / 0.02, a a mean over 0.2 s and s the median of its size.

    An error common to all axes does not show, nor does it tilt the direction of the force.
    """
    size = np.linalg.norm(_means(imu), axis=1)
    return float(np.mean(np.log1p(np.square((size / np.median(size) - 1.0) / SIZE_SCALE))))


def _means(imu: Imu) -> FloatArray:
    """Mean forces (M, 3) in g of all blocks with samples."""
    block = np.unique(((imu.stamps_s - imu.stamps_s[0]) / BLOCK_S).astype(np.int64), return_inverse=True)[1]
    sums = np.stack([np.bincount(block, weights=axis) for axis in imu.linear_acceleration.T], axis=1)
    return np.asarray(sums / np.bincount(block)[:, None] / STANDARD_GRAVITY)


def _fit(blocks: FloatArray, start: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Offsets in g and gains less one (6,), and their covariance (6, 6); `start` (3,) g is level where given."""

    def residuals(x: FloatArray) -> FloatArray:
        excess = (np.linalg.norm((blocks - x[:3]) * (1.0 + x[3:]), axis=1) - 1.0) / scale
        level = np.zeros(0) if start is None else ((start - x[:3]) * (1.0 + x[3:]))[:2] / LEVEL_SIGMA
        return np.concatenate(
            [np.sqrt(BLOCK_WEIGHT * np.log1p(excess**2)), x[:3] / OFFSET_SIGMA, x[3:] / GAIN_SIGMA, level]
        )

    size = np.linalg.norm(blocks, axis=1)
    scale = max(SIZE_SCALE, float(np.median(np.abs(size - np.median(size)))))
    fit = least_squares(residuals, np.zeros(6))
    J = np.asarray(fit.jac, dtype=np.float64)
    return np.asarray(fit.x, dtype=np.float64), np.asarray(np.linalg.inv(J.T @ J), dtype=np.float64)


def _may_be_level(start: FloatArray, found: FloatArray, covariance: FloatArray) -> bool:
    """Whether the start points up within three sigma of the fit and of what a level start may lean."""
    force = (start - found[:3]) * (1.0 + found[3:])
    variance = covariance[:2, :2] + LEVEL_SIGMA**2 * np.eye(2)
    return bool(force[2] > 0 and force[:2] @ np.linalg.solve(variance, force[:2]) < LEVEL_SIGMAS**2)
