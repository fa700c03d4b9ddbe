"""Closed forms of SO(3) and SE(3) on stacked arrays; SE(3) tangents are [rotation, translation] (Barfoot 2017)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry.spatial import pose_from_rotation_translation

SMALL_ANGLE_RAD = 1e-2
"""Below this the coefficients come from their Taylor series, whose dropped terms are under 1e-16."""


def hat(v: FloatArray) -> FloatArray:
    """Skew-symmetric matrices (..., 3, 3) with hat(v) w = v x w."""
    result = np.zeros((*v.shape[:-1], 3, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return result - np.swapaxes(result, -1, -2)


def _coefficients(phi: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """sin(a)/a, (1-cos a)/a^2, (a-sin a)/a^3 and (1 - a^2/2 - cos a)/a^4 for a = |phi|, each (..., 1, 1)."""
    a2 = np.sum(phi**2, axis=-1)[..., None, None]
    a = np.sqrt(a2)
    small = a < SMALL_ANGLE_RAD
    s = np.where(small, 1.0, a)
    c0 = np.where(small, 1 - a2 / 6 + a2**2 / 120 - a2**3 / 5040, np.sin(s) / s)
    c1 = np.where(small, 0.5 - a2 / 24 + a2**2 / 720 - a2**3 / 40320, 2 * np.sin(s / 2) ** 2 / s**2)
    c2 = np.where(small, 1 / 6 - a2 / 120 + a2**2 / 5040, (s - np.sin(s)) / s**3)
    c3 = np.where(small, -1 / 24 + a2 / 720 - a2**2 / 40320, (1 - s**2 / 2 - np.cos(s)) / s**4)
    return c0, c1, c2, c3


def exp_rotation(phi: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) from rotation vectors (..., 3) by Rodrigues' formula."""
    c0, c1, _, _ = _coefficients(phi)
    K = hat(phi)
    return np.eye(3) + c0 * K + c1 * (K @ K)


def log_rotation(R: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3) with angle in [0, pi] of rotations (..., 3, 3), exact near 0 and near pi."""
    return np.asarray(Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec()).reshape(*R.shape[:-2], 3)


def adjoint_rotation(R: FloatArray) -> FloatArray:
    """The adjoint of SO(3) is the rotation itself."""
    return R


def left_jacobian(phi: FloatArray) -> FloatArray:
    """Left Jacobian (..., 3, 3) of SO(3)."""
    _, c1, c2, _ = _coefficients(phi)
    K = hat(phi)
    return np.eye(3) + c1 * K + c2 * (K @ K)


def right_jacobian_rotation(phi: FloatArray) -> FloatArray:
    """Right Jacobian (..., 3, 3) of SO(3)."""
    return left_jacobian(-phi)


def exp_pose(xi: FloatArray) -> FloatArray:
    """Poses (..., 4, 4) from tangents (..., 6)."""
    phi, rho = xi[..., :3], xi[..., 3:]
    return pose_from_rotation_translation(exp_rotation(phi), (left_jacobian(phi) @ rho[..., None])[..., 0])


def log_pose(T: FloatArray) -> FloatArray:
    """Tangents (..., 6) of poses (..., 4, 4)."""
    phi = log_rotation(T[..., :3, :3])
    rho = np.linalg.solve(left_jacobian(phi), T[..., :3, 3, None])[..., 0]
    return np.concatenate([phi, rho], -1)


def adjoint_pose(T: FloatArray) -> FloatArray:
    """Adjoint (..., 6, 6) of poses (..., 4, 4)."""
    R = T[..., :3, :3]
    result = np.zeros((*T.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = R
    result[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return result


def right_jacobian_pose(xi: FloatArray) -> FloatArray:
    """Right Jacobian (..., 6, 6) of SE(3) at xi (Barfoot 2017, eq. 7.85-7.86, mirrored)."""
    phi, rho = -xi[..., :3], -xi[..., 3:]
    J = left_jacobian(phi)
    _, _, c2, c3 = _coefficients(phi)
    P, K = hat(rho), hat(phi)
    a2 = np.sum(phi**2, axis=-1)[..., None, None]
    a = np.sqrt(a2)
    small = a < SMALL_ANGLE_RAD
    s = np.where(small, 1.0, a)
    c4 = np.where(small, 1 / 120 - a2 / 2520, (2 * s - 3 * np.sin(s) + s * np.cos(s)) / (2 * s**5))
    KP, PK, KK = K @ P, P @ K, K @ K
    KPK = KP @ K
    Q = (0.5 * P + c2 * (KP + PK + KPK) - c3 * (KK @ P + PK @ K - 3 * KPK)
         + c4 * (KPK @ K + K @ KPK))  # fmt: skip
    result = np.zeros((*xi.shape[:-1], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = J
    result[..., 3:, :3] = Q
    return result
