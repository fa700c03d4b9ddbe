"""The error of a constraint in space and its derivative: logarithm and inverse right Jacobian of SE(3), in numba."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel

SMALL_SQUARE = 1e-2
"""Squared angle below which coefficients come from their series, whose dropped terms are under 1e-16."""


@kernel
def _product(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    for r in range(3):
        for c in range(3):
            out[r, c] = a[r, 0] * b[0, c] + a[r, 1] * b[1, c] + a[r, 2] * b[2, c]


@kernel
def spatial_between(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Write the upper three rows of a^-1 b."""
    for r in range(3):
        for c in range(3):
            out[r, c] = a[0, r] * b[0, c] + a[1, r] * b[1, c] + a[2, r] * b[2, c]
        out[r, 3] = 0.0
        for k in range(3):
            out[r, 3] += a[k, r] * (b[k, 3] - a[k, 3])


@kernel
def _rotation_vector(R: FloatArray, out: FloatArray) -> None:
    """Write the rotation vector of R by way of its quaternion, whose largest entry is computed first."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    k = 0
    if R[1, 1] > R[0, 0]:
        k = 1
    if R[2, 2] > R[k, k]:
        k = 2
    if trace > R[k, k]:
        w = 1.0 + trace
        out[0], out[1], out[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        m, n = (k + 1) % 3, (k + 2) % 3
        out[k] = 1.0 + R[k, k] - R[m, m] - R[n, n]
        out[m], out[n] = R[m, k] + R[k, m], R[n, k] + R[k, n]
        w = R[n, m] - R[m, n]
    if w < 0.0:
        w = -w
        out[0], out[1], out[2] = -out[0], -out[1], -out[2]
    sine = np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    ratio = sine / w if w > 0.0 else np.inf
    scale = 2.0 / w * (1.0 - ratio * ratio / 3.0) if ratio < 1e-4 else 2.0 * np.arctan2(sine, w) / sine
    out[0], out[1], out[2] = scale * out[0], scale * out[1], scale * out[2]


@kernel
def _inverse_coefficient(square: float) -> float:
    """Return 1/a^2 - (1 + cos a)/(2 a sin a) for a^2 = square: the factor of K^2 in the inverse Jacobian of SO(3)."""
    if square < SMALL_SQUARE:
        return 1.0 / 12.0 + square * (1.0 / 720.0 + square * (1.0 / 30240.0 + square / 1209600.0))
    angle = np.sqrt(square)
    half = 0.5 * angle
    return float((1.0 - half / np.tan(half)) / square)


@kernel
def spatial_error(now: FloatArray, z: FloatArray, work: FloatArray, residual: FloatArray) -> None:
    """Write log(z^-1 now) [rotation, translation]; `work` (3, 4) is overwritten."""
    spatial_between(z, now, work)
    phi, rho = residual[:3], residual[3:]
    _rotation_vector(work, phi)
    t0, t1, t2 = work[0, 3], work[1, 3], work[2, 3]
    k = _inverse_coefficient(phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2)
    # rho = t - phi x t / 2 + k phi x (phi x t)
    c0, c1, c2 = phi[1] * t2 - phi[2] * t1, phi[2] * t0 - phi[0] * t2, phi[0] * t1 - phi[1] * t0
    rho[0] = t0 - 0.5 * c0 + k * (phi[1] * c2 - phi[2] * c1)
    rho[1] = t1 - 0.5 * c1 + k * (phi[2] * c0 - phi[0] * c2)
    rho[2] = t2 - 0.5 * c2 + k * (phi[0] * c1 - phi[1] * c0)


@kernel
def _mixed_coefficients(square: float) -> tuple[float, float, float]:
    """Return (a - sin a)/a^3, (1 - a^2/2 - cos a)/a^4 and (2a - 3 sin a + a cos a)/(2 a^5) for a^2 = square."""
    if square < SMALL_SQUARE:
        return (
            1.0 / 6.0 + square * (-1.0 / 120.0 + square * (1.0 / 5040.0 - square / 362880.0)),
            -1.0 / 24.0 + square * (1.0 / 720.0 + square * (-1.0 / 40320.0 + square / 3628800.0)),
            1.0 / 120.0 + square * (-1.0 / 2520.0 + square * (1.0 / 120960.0 - square / 9979200.0)),
        )
    a = np.sqrt(square)
    sine, cosine = np.sin(a), np.cos(a)
    return (
        (a - sine) / (a * square),
        (1.0 - 0.5 * square - cosine) / (square * square),
        (2.0 * a - 3.0 * sine + a * cosine) / (2.0 * square * square * a),
    )


@kernel
def inverse_right_jacobian(phi: FloatArray, rho: FloatArray, J: FloatArray, N: FloatArray, work: FloatArray) -> None:
    """Write J and N = J Q J (3, 3) of Jr^-1 = [[J, 0], [-N, J]] at (phi, rho); `work` (2, 3, 3) is overwritten.

    Q is that of Barfoot (2017, eq. 7.86) at (-phi, -rho). With K = hat(phi), P = hat(rho), s = phi.rho its products
    fold: KP + PK = phi rho^T + rho phi^T - 2s, KPK = -s K, KKP + PKK = -s K - phi^2 P and KPKK = -s K^2.
    """
    square = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2
    s = phi[0] * rho[0] + phi[1] * rho[1] + phi[2] * rho[2]
    c2, c3, c4 = _mixed_coefficients(square)
    k = _inverse_coefficient(square)
    by_shift, by_turn, by_square = -(0.5 + c3 * square), s * (c2 + 2.0 * c3), -2.0 * c4 * s
    level = -2.0 * c2 * s - by_square * square
    Q, M = work[0], work[1]
    for r in range(3):
        for c in range(3):
            outer = phi[r] * phi[c]
            Q[r, c] = c2 * (phi[r] * rho[c] + rho[r] * phi[c]) + by_square * outer
            J[r, c] = k * outer
        Q[r, r] += level
        J[r, r] += 1.0 - k * square
    for r in range(3):
        m, n = (r + 1) % 3, (r + 2) % 3
        skew = by_shift * rho[r] + by_turn * phi[r]
        Q[n, m] += skew
        Q[m, n] -= skew
        J[n, m] += 0.5 * phi[r]
        J[m, n] -= 0.5 * phi[r]
    _product(J, Q, M)
    _product(M, J, N)
