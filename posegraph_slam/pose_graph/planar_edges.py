"""Constraints in the plane, edge by edge in numba: chi-square, normal equations, and poses moved by a step.

r = log(T_i_j^-1 T_i^-1 T_j), dr/dj = B = Jr^-1(r), dr/di = -B A with A = Ad((T_i^-1 T_j)^-1). With H = B^T W B, the
blocks of the normal equations are H at (j, j), -A^T H at (i, j) and A^T H A at (i, i): `residuals` has the formulas.
"""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel

SMALL_ANGLE_RAD = 1e-4
"""Below this the coefficients come from their Taylor series."""
SIZE = 3


@kernel
def _planar_between(a: FloatArray, b: FloatArray) -> tuple[float, float, float, float]:
    """Return cosine, sine and translation of a^-1 b."""
    c, s = a[0, 0], a[1, 0]
    x, y = b[0, 2] - a[0, 2], b[1, 2] - a[1, 2]
    return c * b[0, 0] + s * b[1, 0], c * b[1, 0] - s * b[0, 0], c * x + s * y, c * y - s * x


@kernel
def _planar_error(now: tuple[float, float, float, float], z: FloatArray) -> tuple[float, float, float]:
    """Return log(z^-1 now)."""
    c, s = z[0, 0], z[1, 0]
    x, y = now[2] - z[0, 2], now[3] - z[1, 2]
    theta = np.arctan2(c * now[1] - s * now[0], c * now[0] + s * now[1])
    x, y = c * x + s * y, c * y - s * x
    half = 0.5 * theta
    cot = 1.0 - theta * theta / 12.0 if abs(theta) < SMALL_ANGLE_RAD else half / np.tan(half)
    return cot * x + half * y, cot * y - half * x, theta


@kernel
def planar_residuals(poses: FloatArray, i: IntArray, j: IntArray, T: FloatArray, residuals: FloatArray) -> None:
    """Write the residuals (E, 3)."""
    for e in range(len(i)):
        x, y, theta = _planar_error(_planar_between(poses[i[e]], poses[j[e]]), T[e])
        residuals[e, 0], residuals[e, 1], residuals[e, 2] = x, y, theta


@kernel
def planar_chi2(poses: FloatArray, i: IntArray, j: IntArray, T: FloatArray, information: FloatArray,
                result: FloatArray) -> None:  # fmt: skip
    """Write r^T information r (E,)."""
    for e in range(len(i)):
        x, y, theta = _planar_error(_planar_between(poses[i[e]], poses[j[e]]), T[e])
        W = information[e]
        result[e] = (
            x * (W[0, 0] * x + W[0, 1] * y + W[0, 2] * theta)
            + y * (W[1, 0] * x + W[1, 1] * y + W[1, 2] * theta)
            + theta * (W[2, 0] * x + W[2, 1] * y + W[2, 2] * theta)
        )


@kernel
def _planar_derivatives(now: tuple[float, float, float, float], r: tuple[float, float, float], A: FloatArray,
                        B: FloatArray) -> None:  # fmt: skip
    """Write A = Ad(now^-1) and B = Jr^-1(r) (3, 3), whose last rows are [0, 0, 1]."""
    x, y, theta = r
    if abs(theta) < SMALL_ANGLE_RAD:
        a, b, p, q = 1.0 - theta * theta / 6.0, 0.5 * theta, theta / 6.0, 0.5 - theta * theta / 24.0
    else:
        a, b = np.sin(theta) / theta, 2.0 * np.sin(0.5 * theta) ** 2 / theta
        p, q = (1.0 - a) / theta, b / theta
    u, v = p * x - q * y, q * x + p * y
    scale = 1.0 / (a * a + b * b)
    c, s = a * scale, b * scale  # Jr = [[a, b, u], [-b, a, v], [0, 0, 1]], inverted
    B[0, 0], B[0, 1], B[0, 2] = c, -s, s * v - c * u
    B[1, 0], B[1, 1], B[1, 2] = s, c, -s * u - c * v
    # [[R^T, w], [0, 1]] with w = (-R^T t turned by -90 degrees), see so2.adjoint_pose
    c, s = now[0], now[1]
    A[0, 0], A[0, 1], A[0, 2] = c, s, s * now[2] - c * now[3]
    A[1, 0], A[1, 1], A[1, 2] = -s, c, c * now[2] + s * now[3]


@kernel
def planar_equations(poses: FloatArray, i: IntArray, j: IntArray, T: FloatArray, information: FloatArray,
                     weights: FloatArray, gradient: FloatArray, diagonal: FloatArray,
                     off: FloatArray) -> None:  # fmt: skip
    """Add to gradient (N, 3) and diagonal blocks (N, 3, 3), write the blocks (i, j) (E, 3, 3)."""
    A, B, V = np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE)), np.empty((SIZE, SIZE))
    A[2, 2], B[2, 2] = 1.0, 1.0
    H, M, pull = np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE)), np.empty(SIZE)
    for e in range(len(i)):
        first, second, W, weight = i[e], j[e], information[e], weights[e]
        now = _planar_between(poses[first], poses[second])
        x, y, theta = _planar_error(now, T[e])
        _planar_derivatives(now, (x, y, theta), A, B)
        for a in range(SIZE):
            pull[a] = weight * (W[a, 0] * x + W[a, 1] * y + W[a, 2] * theta)
            for b in range(SIZE):
                V[a, b] = weight * (W[a, 0] * B[0, b] + W[a, 1] * B[1, b] + W[a, 2] * B[2, b])
        g0, g1 = B[0, 0] * pull[0] + B[1, 0] * pull[1], B[0, 1] * pull[0] + B[1, 1] * pull[1]
        g2 = B[0, 2] * pull[0] + B[1, 2] * pull[1] + pull[2]
        for a in range(SIZE):
            for b in range(SIZE):
                H[a, b] = B[0, a] * V[0, b] + B[1, a] * V[1, b] + B[2, a] * V[2, b]
        at_i, at_j, between = diagonal[first], diagonal[second], off[e]
        for a in range(SIZE):
            for b in range(SIZE):
                M[a, b] = A[0, a] * H[0, b] + A[1, a] * H[1, b] + A[2, a] * H[2, b]
                at_j[a, b] += H[a, b]
                between[a, b] = -M[a, b]
        for a in range(SIZE):
            gradient[first, a] -= A[0, a] * g0 + A[1, a] * g1 + A[2, a] * g2
            for b in range(SIZE):
                at_i[a, b] += M[a, 0] * A[0, b] + M[a, 1] * A[1, b] + M[a, 2] * A[2, b]
        gradient[second, 0] += g0
        gradient[second, 1] += g1
        gradient[second, 2] += g2


@kernel
def planar_moves(poses: FloatArray, delta: FloatArray) -> None:
    """Update every pose on the right by exp(delta)."""
    for k in range(len(poses)):
        T, theta = poses[k], delta[k, 2]
        if abs(theta) < SMALL_ANGLE_RAD:
            a, b = 1.0 - theta * theta / 6.0, 0.5 * theta
        else:
            a, b = np.sin(theta) / theta, 2.0 * np.sin(0.5 * theta) ** 2 / theta
        x, y = a * delta[k, 0] - b * delta[k, 1], b * delta[k, 0] + a * delta[k, 1]
        c, s = T[0, 0], T[1, 0]
        T[0, 2] += c * x - s * y
        T[1, 2] += s * x + c * y
        cd, sd = np.cos(theta), np.sin(theta)
        c, s = c * cd - s * sd, s * cd + c * sd
        T[0, 0], T[0, 1], T[1, 0], T[1, 1] = c, -s, s, c
