"""Constraints in space, edge by edge in numba: chi-square, normal equations, and poses moved by a step.

Formulas as in `planar_edges`, in blocks of 3 x 3: B = [[J, 0], [-N, J]] with N = J Q J, A = [[R^T, 0], [-R^T X, R^T]]
with T_i^-1 T_j = (R, t) and X = hat(t); tangents have the rotation first.
"""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.spatial_error import SMALL_SQUARE, inverse_right_jacobian, spatial_between, spatial_error

SIZE = 6


@kernel
def spatial_residuals(poses: FloatArray, i: IntArray, j: IntArray, T: FloatArray, residuals: FloatArray) -> None:
    """Write the residuals (E, 6)."""
    now, work = np.empty((3, 4)), np.empty((3, 4))
    for e in range(len(i)):
        spatial_between(poses[i[e]], poses[j[e]], now)
        spatial_error(now, T[e], work, residuals[e])


@kernel
def spatial_chi2(poses: FloatArray, i: IntArray, j: IntArray, T: FloatArray, information: FloatArray,
                 result: FloatArray) -> None:  # fmt: skip
    """Write r^T information r (E,)."""
    now, work, r = np.empty((3, 4)), np.empty((3, 4)), np.empty(SIZE)
    for e in range(len(i)):
        spatial_between(poses[i[e]], poses[j[e]], now)
        spatial_error(now, T[e], work, r)
        W, total = information[e], 0.0
        for a in range(SIZE):
            pull = (W[a, 0] * r[0] + W[a, 1] * r[1] + W[a, 2] * r[2]) + (
                W[a, 3] * r[3] + W[a, 4] * r[4] + W[a, 5] * r[5]
            )
            total += r[a] * pull
        result[e] = total


@kernel
def _weighted_product(W: FloatArray, weight: float, J: FloatArray, N: FloatArray, V: FloatArray) -> None:
    """Write V = weight W B."""
    for r in range(SIZE):
        for c in range(3):
            right = W[r, 3] * J[0, c] + W[r, 4] * J[1, c] + W[r, 5] * J[2, c]
            left = W[r, 0] * J[0, c] + W[r, 1] * J[1, c] + W[r, 2] * J[2, c]
            left -= W[r, 3] * N[0, c] + W[r, 4] * N[1, c] + W[r, 5] * N[2, c]
            V[r, c], V[r, c + 3] = weight * left, weight * right


@kernel
def _transposed_product(J: FloatArray, N: FloatArray, V: FloatArray, H: FloatArray) -> None:
    """Write H = B^T V, which is symmetric."""
    for r in range(3):
        for c in range(3):
            H[r, c] = J[0, r] * V[0, c] + J[1, r] * V[1, c] + J[2, r] * V[2, c]
            H[r, c] -= N[0, r] * V[3, c] + N[1, r] * V[4, c] + N[2, r] * V[5, c]
            H[r + 3, c] = J[0, r] * V[3, c] + J[1, r] * V[4, c] + J[2, r] * V[5, c]
            H[r + 3, c + 3] = J[0, r] * V[3, c + 3] + J[1, r] * V[4, c + 3] + J[2, r] * V[5, c + 3]
    for r in range(3):
        for c in range(3):
            H[r, c + 3] = H[c + 3, r]


@kernel
def _carried_back(now: FloatArray, H: FloatArray, M: FloatArray) -> None:
    """Write M = A^T H, A^T = [[R, X R], [0, R]]."""
    for r in range(3):
        for c in range(SIZE):
            M[r, c] = now[r, 0] * H[0, c] + now[r, 1] * H[1, c] + now[r, 2] * H[2, c]
            M[r + 3, c] = now[r, 0] * H[3, c] + now[r, 1] * H[4, c] + now[r, 2] * H[5, c]
    t0, t1, t2 = now[0, 3], now[1, 3], now[2, 3]
    for c in range(SIZE):
        M[0, c] += t1 * M[5, c] - t2 * M[4, c]
        M[1, c] += t2 * M[3, c] - t0 * M[5, c]
        M[2, c] += t0 * M[4, c] - t1 * M[3, c]


@kernel
def _add_carried(now: FloatArray, M: FloatArray, at_i: FloatArray) -> None:
    """Add M A to the upper block triangle of `at_i`, and its transpose below."""
    t0, t1, t2 = now[0, 3], now[1, 3], now[2, 3]
    for r in range(3):
        for c in range(3):
            at_i[r + 3, c + 3] += M[r + 3, 3] * now[c, 0] + M[r + 3, 4] * now[c, 1] + M[r + 3, 5] * now[c, 2]
        s0 = M[r, 3] * now[0, 0] + M[r, 4] * now[0, 1] + M[r, 5] * now[0, 2]
        s1 = M[r, 3] * now[1, 0] + M[r, 4] * now[1, 1] + M[r, 5] * now[1, 2]
        s2 = M[r, 3] * now[2, 0] + M[r, 4] * now[2, 1] + M[r, 5] * now[2, 2]
        at_i[r, 3] += s0
        at_i[r, 4] += s1
        at_i[r, 5] += s2
        at_i[3, r] += s0
        at_i[4, r] += s1
        at_i[5, r] += s2
        at_i[r, 0] += M[r, 0] * now[0, 0] + M[r, 1] * now[0, 1] + M[r, 2] * now[0, 2] + (s2 * t1 - s1 * t2)
        at_i[r, 1] += M[r, 0] * now[1, 0] + M[r, 1] * now[1, 1] + M[r, 2] * now[1, 2] + (s0 * t2 - s2 * t0)
        at_i[r, 2] += M[r, 0] * now[2, 0] + M[r, 1] * now[2, 1] + M[r, 2] * now[2, 2] + (s1 * t0 - s0 * t1)


@kernel
def _add_gradients(now: FloatArray, J: FloatArray, N: FloatArray, pull: FloatArray, g: FloatArray, at_i: FloatArray,
                   at_j: FloatArray) -> None:  # fmt: skip
    """Add g = B^T pull to `at_j` and -A^T g to `at_i`."""
    for r in range(3):
        g[r] = J[0, r] * pull[0] + J[1, r] * pull[1] + J[2, r] * pull[2]
        g[r] -= N[0, r] * pull[3] + N[1, r] * pull[4] + N[2, r] * pull[5]
        g[r + 3] = J[0, r] * pull[3] + J[1, r] * pull[4] + J[2, r] * pull[5]
    for r in range(SIZE):
        at_j[r] += g[r]
    for r in range(3):
        pull[r] = now[r, 0] * g[0] + now[r, 1] * g[1] + now[r, 2] * g[2]
        pull[r + 3] = now[r, 0] * g[3] + now[r, 1] * g[4] + now[r, 2] * g[5]
    at_i[0] -= pull[0] + (now[1, 3] * pull[5] - now[2, 3] * pull[4])
    at_i[1] -= pull[1] + (now[2, 3] * pull[3] - now[0, 3] * pull[5])
    at_i[2] -= pull[2] + (now[0, 3] * pull[4] - now[1, 3] * pull[3])
    for r in range(3, SIZE):
        at_i[r] -= pull[r]


@kernel
def spatial_equations(poses: FloatArray, i: IntArray, j: IntArray, T: FloatArray, information: FloatArray,
                      weights: FloatArray, gradient: FloatArray, diagonal: FloatArray,
                      off: FloatArray) -> None:  # fmt: skip
    """Add to gradient (N, 6) and diagonal blocks (N, 6, 6), write the blocks (i, j) (E, 6, 6)."""
    now, work, squares = np.empty((3, 4)), np.empty((3, 4)), np.empty((2, 3, 3))
    J, N, residual, pull, g = np.empty((3, 3)), np.empty((3, 3)), np.empty(SIZE), np.empty(SIZE), np.empty(SIZE)
    V, H, M = np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE))
    for e in range(len(i)):
        first, second, W, weight = i[e], j[e], information[e], weights[e]
        spatial_between(poses[first], poses[second], now)
        spatial_error(now, T[e], work, residual)
        inverse_right_jacobian(residual[:3], residual[3:], J, N, squares)
        for a in range(SIZE):
            pull[a] = W[a, 0] * residual[0] + W[a, 1] * residual[1] + W[a, 2] * residual[2]
            pull[a] = weight * (pull[a] + W[a, 3] * residual[3] + W[a, 4] * residual[4] + W[a, 5] * residual[5])
        _weighted_product(W, weight, J, N, V)
        _transposed_product(J, N, V, H)
        _carried_back(now, H, M)
        _add_carried(now, M, diagonal[first])
        _add_gradients(now, J, N, pull, g, gradient[first], gradient[second])
        at_j, between = diagonal[second], off[e]
        for a in range(SIZE):
            for b in range(SIZE):
                at_j[a, b] += H[a, b]
                between[a, b] = -M[a, b]


@kernel
def spatial_moves(poses: FloatArray, delta: FloatArray) -> None:
    """Update every pose on the right by exp(delta).

    With K = hat(phi): R <- R (1 + a K + b K^2), t <- t + R (1 + b K + c K^2) rho.
    """
    turn, shift, old = np.empty(3), np.empty(3), np.empty((3, 3))
    for k in range(len(poses)):
        T, phi, rho = poses[k], delta[k, :3], delta[k, 3:]
        square = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2
        if square < SMALL_SQUARE:
            a = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0)))
            b = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0 * (1.0 - square / 90.0)))
            c = 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0 * (1.0 - square / 110.0)))
        else:
            angle = np.sqrt(square)
            a, b = np.sin(angle) / angle, 2.0 * np.sin(0.5 * angle) ** 2 / square
            c = (1.0 - a) / square
        for r in range(3):
            for m in range(3):
                old[r, m] = T[r, m]
        for column in range(4):
            v0 = rho[0] if column == 3 else (1.0 if column == 0 else 0.0)
            v1 = rho[1] if column == 3 else (1.0 if column == 1 else 0.0)
            v2 = rho[2] if column == 3 else (1.0 if column == 2 else 0.0)
            turn[0] = phi[1] * v2 - phi[2] * v1
            turn[1] = phi[2] * v0 - phi[0] * v2
            turn[2] = phi[0] * v1 - phi[1] * v0
            first, second = (b, c) if column == 3 else (a, b)
            shift[0] = v0 + first * turn[0] + second * (phi[1] * turn[2] - phi[2] * turn[1])
            shift[1] = v1 + first * turn[1] + second * (phi[2] * turn[0] - phi[0] * turn[2])
            shift[2] = v2 + first * turn[2] + second * (phi[0] * turn[1] - phi[1] * turn[0])
            for r in range(3):
                value = old[r, 0] * shift[0] + old[r, 1] * shift[1] + old[r, 2] * shift[2]
                T[r, column] = T[r, 3] + value if column == 3 else value
