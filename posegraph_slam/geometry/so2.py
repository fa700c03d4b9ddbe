"""Closed forms of SO(2) and SE(2) on stacked arrays; SE(2) tangents are [x, y, theta] (Sola et al. 2018)."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry.spatial import pose_from_rotation_translation

SMALL_ANGLE_RAD = 1e-4
"""Below this the Taylor series, here cut after the fourth power, is exact to double precision."""


def transpose(R: FloatArray) -> FloatArray:
    """Invert stacked rotations."""
    return np.swapaxes(R, -1, -2)


def exp_rotation(theta: FloatArray) -> FloatArray:
    """Rotations (..., 2, 2) from angles (..., 1)."""
    c, s = np.cos(theta[..., 0]), np.sin(theta[..., 0])
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def log_rotation(R: FloatArray) -> FloatArray:
    """Angles (..., 1) in (-pi, pi] of rotations (..., 2, 2)."""
    return np.asarray(np.arctan2(R[..., 1, 0], R[..., 0, 0])[..., None])


def adjoint_rotation(R: FloatArray) -> FloatArray:
    """The adjoint of SO(2), and its Jacobians, are one: (..., 1, 1) for rotations or tangents."""
    batch = R.shape[:-2] if R.ndim >= 2 and R.shape[-1] == 2 else R.shape[:-1]
    return np.ones((*batch, 1, 1))


def _series(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """sin(theta)/theta and (1 - cos(theta))/theta, stable at zero."""
    small = np.abs(theta) < SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, theta)
    a = np.where(small, 1 - theta**2 / 6, np.sin(safe) / safe)
    b = np.where(small, theta / 2 - theta**3 / 24, 2 * np.sin(safe / 2) ** 2 / safe)
    return a, b


def exp_pose(xi: FloatArray) -> FloatArray:
    """Poses (..., 3, 3) from tangents (..., 3)."""
    a, b = _series(xi[..., 2])
    x, y = xi[..., 0], xi[..., 1]
    return pose_from_rotation_translation(exp_rotation(xi[..., 2:]), np.stack([a * x - b * y, b * x + a * y], -1))


def log_pose(T: FloatArray) -> FloatArray:
    """Tangents (..., 3) of poses (..., 3, 3)."""
    theta = np.arctan2(T[..., 1, 0], T[..., 0, 0])
    half = theta / 2
    small = np.abs(theta) < SMALL_ANGLE_RAD
    cot = np.where(small, 1 - theta**2 / 12, half / np.tan(np.where(small, 1.0, half)))
    x, y = T[..., 0, 2], T[..., 1, 2]
    return np.stack([cot * x + half * y, -half * x + cot * y, theta], -1)


def adjoint_pose(T: FloatArray) -> FloatArray:
    """Adjoint (..., 3, 3) of poses: T exp(d) T^-1 = exp(Ad d)."""
    result = np.zeros_like(T)
    result[..., :2, :2] = T[..., :2, :2]
    result[..., 0, 2], result[..., 1, 2], result[..., 2, 2] = T[..., 1, 2], -T[..., 0, 2], 1.0
    return result


def right_jacobian_pose(xi: FloatArray) -> FloatArray:
    """Right Jacobian (..., 3, 3) of SE(2) at xi (Sola et al. 2018, eq. 163)."""
    x, y, theta = xi[..., 0], xi[..., 1], xi[..., 2]
    a, b = _series(theta)
    small = np.abs(theta) < SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, theta)
    # (theta - sin theta)/theta^2 and (1 - cos theta)/theta^2
    p = np.where(small, theta / 6, (safe - np.sin(safe)) / safe**2)
    q = np.where(small, 0.5 - theta**2 / 24, b / safe)
    result = np.zeros((*theta.shape, 3, 3))
    result[..., 0, 0], result[..., 0, 1], result[..., 0, 2] = a, b, p * x - q * y
    result[..., 1, 0], result[..., 1, 1], result[..., 1, 2] = -b, a, q * x + p * y
    result[..., 2, 2] = 1.0
    return result
