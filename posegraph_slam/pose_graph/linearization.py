"""Residuals and Jacobians of constraints edge by edge in numba, and the normal equations that they sum up to.

The same formulas as `residuals`, which works on whole arrays and is what the tests compare with: r = log(T_i_j^-1
T_i^-1 T_j), dr/dj = Jr^-1(r), dr/di = -Jr^-1(r) Ad((T_i^-1 T_j)^-1).
"""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.graph import Constraints

SMALL_ANGLE_RAD = 1e-4
"""Below this the planar coefficients come from their Taylor series."""
PLANAR, SPATIAL = 3, 6
"""Sizes of the tangent, known when the kernels are compiled, so that their inner loops are unrolled."""
SMALL_SQUARE = 1e-2
"""Squared angle below which the spatial coefficients come from their series, whose dropped terms are under 1e-16."""


def residuals_at(poses: FloatArray, constraints: Constraints) -> FloatArray:
    """Return the residuals (E, p) of constraints at poses (N, d+1, d+1)."""
    c = constraints
    run = _planar_residuals if poses.shape[-1] == 3 else _spatial_residuals
    residuals = np.empty(c.information.shape[:2])
    run(_writable(poses), c.i, c.j, c.T_i_j, residuals)
    return residuals


def jacobians_at(poses: FloatArray, constraints: Constraints) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (E, p) and their derivatives (E, p, p) by the right updates of nodes i and j."""
    c = constraints
    run = _planar_jacobians if poses.shape[-1] == 3 else _spatial_jacobians
    residuals, by_i, by_j = (
        np.empty(c.information.shape[:2]),
        np.empty_like(c.information),
        np.empty_like(c.information),
    )
    run(_writable(poses), c.i, c.j, c.T_i_j, residuals, by_i, by_j)
    return residuals, by_i, by_j


def moved_poses(poses: FloatArray, rows: IntArray, delta: FloatArray) -> FloatArray:
    """Return poses (N, d+1, d+1) with those at `rows` (n,) updated on the right by exp(delta), delta (n, p)."""
    result = np.array(poses)
    run = _planar_moves if poses.shape[-1] == 3 else _spatial_moves
    run(result, rows, delta)
    return result


def _writable(poses: FloatArray) -> FloatArray:
    """Return a copy of read-only poses: numba would compile every kernel a second time for them."""
    return poses if poses.flags.writeable else np.array(poses)


@kernel
def squared_lengths(residuals: FloatArray, information: FloatArray) -> FloatArray:
    """Return r^T information r (E,)."""
    count, p = residuals.shape
    result = np.empty(count)
    for e in range(count):
        total = 0.0
        for a in range(p):
            for b in range(p):
                total += residuals[e, a] * information[e, a, b] * residuals[e, b]
        result[e] = total
    return result


def normal_equations(count: int, i: IntArray, j: IntArray, residuals: FloatArray, by_i: FloatArray, by_j: FloatArray,
                     information: FloatArray,
                     weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return gradient (N, p), diagonal blocks (N, p, p) and blocks (i, j) (E, p, p) of the Gauss-Newton Hessian."""
    edges, p = residuals.shape
    gradient, diagonal, off = np.zeros((count, p)), np.zeros((count, p, p)), np.empty((edges, p, p))
    run = _planar_equations if p == PLANAR else _spatial_equations
    run(i, j, residuals, by_i, by_j, information, weights, gradient, diagonal, off)
    return gradient, diagonal, off


@kernel
def _planar_equations(i: IntArray, j: IntArray, residuals: FloatArray, by_i: FloatArray, by_j: FloatArray,
           information: FloatArray, weights: FloatArray, gradient: FloatArray, diagonal: FloatArray,
           off: FloatArray) -> None:  # fmt: skip
    at_i, at_j = np.empty((PLANAR, PLANAR)), np.empty((PLANAR, PLANAR))
    pull = np.empty(PLANAR)
    for e in range(len(i)):
        weight, A, B, W, first, second = weights[e], by_i[e], by_j[e], information[e], i[e], j[e]
        for a in range(PLANAR):
            total = 0.0
            for k in range(PLANAR):
                at_i[a, k], at_j[a, k] = 0.0, 0.0
            for b in range(PLANAR):
                w = weight * W[a, b]
                total += w * residuals[e, b]
                for k in range(PLANAR):
                    at_i[a, k] += w * A[b, k]
                    at_j[a, k] += w * B[b, k]
            pull[a] = total
        H_i, H_j, H = diagonal[first], diagonal[second], off[e]
        for k in range(PLANAR):
            for m in range(PLANAR):
                H[k, m] = 0.0
        for a in range(PLANAR):
            for k in range(PLANAR):
                x, y = A[a, k], B[a, k]
                gradient[first, k] += x * pull[a]
                gradient[second, k] += y * pull[a]
                for m in range(PLANAR):
                    H_i[k, m] += x * at_i[a, m]
                    H_j[k, m] += y * at_j[a, m]
                    H[k, m] += x * at_j[a, m]


@kernel
def _spatial_equations(i: IntArray, j: IntArray, residuals: FloatArray, by_i: FloatArray, by_j: FloatArray,
           information: FloatArray, weights: FloatArray, gradient: FloatArray, diagonal: FloatArray,
           off: FloatArray) -> None:  # fmt: skip
    at_i, at_j = np.empty((SPATIAL, SPATIAL)), np.empty((SPATIAL, SPATIAL))
    pull = np.empty(SPATIAL)
    for e in range(len(i)):
        weight, A, B, W, first, second = weights[e], by_i[e], by_j[e], information[e], i[e], j[e]
        for a in range(SPATIAL):
            total = 0.0
            for k in range(SPATIAL):
                at_i[a, k], at_j[a, k] = 0.0, 0.0
            for b in range(SPATIAL):
                w = weight * W[a, b]
                total += w * residuals[e, b]
                for k in range(SPATIAL):
                    at_i[a, k] += w * A[b, k]
                    at_j[a, k] += w * B[b, k]
            pull[a] = total
        H_i, H_j, H = diagonal[first], diagonal[second], off[e]
        for k in range(SPATIAL):
            for m in range(SPATIAL):
                H[k, m] = 0.0
        for a in range(SPATIAL):
            for k in range(SPATIAL):
                x, y = A[a, k], B[a, k]
                gradient[first, k] += x * pull[a]
                gradient[second, k] += y * pull[a]
                for m in range(SPATIAL):
                    H_i[k, m] += x * at_i[a, m]
                    H_j[k, m] += y * at_j[a, m]
                    H[k, m] += x * at_j[a, m]


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
def _planar_residuals(poses: FloatArray, i: IntArray, j: IntArray, T: FloatArray, residuals: FloatArray) -> None:
    for e in range(len(i)):
        x, y, theta = _planar_error(_planar_between(poses[i[e]], poses[j[e]]), T[e])
        residuals[e, 0], residuals[e, 1], residuals[e, 2] = x, y, theta


@kernel
def _planar_jacobians(poses: FloatArray, i: IntArray, j: IntArray, T: FloatArray, residuals: FloatArray,
                      by_i: FloatArray, by_j: FloatArray) -> None:  # fmt: skip
    for e in range(len(i)):
        now = _planar_between(poses[i[e]], poses[j[e]])
        x, y, theta = _planar_error(now, T[e])
        residuals[e, 0], residuals[e, 1], residuals[e, 2] = x, y, theta
        if abs(theta) < SMALL_ANGLE_RAD:
            a, b, p, q = 1.0 - theta * theta / 6.0, 0.5 * theta, theta / 6.0, 0.5 - theta * theta / 24.0
        else:
            a, b = np.sin(theta) / theta, 2.0 * np.sin(0.5 * theta) ** 2 / theta
            p, q = (1.0 - a) / theta, b / theta
        u, v = p * x - q * y, q * x + p * y
        scale = 1.0 / (a * a + b * b)
        c, s = a * scale, b * scale  # Jr = [[a, b, u], [-b, a, v], [0, 0, 1]], inverted
        J = by_j[e]
        J[0, 0], J[0, 1], J[0, 2] = c, -s, s * v - c * u
        J[1, 0], J[1, 1], J[1, 2] = s, c, -s * u - c * v
        J[2, 0], J[2, 1], J[2, 2] = 0.0, 0.0, 1.0
        # Ad(now^-1) = [[R^T, w], [0, 1]] with w = (-R^T t turned by -90 degrees), see so2.adjoint_pose
        cn, sn = now[0], now[1]
        tx, ty = -(cn * now[2] + sn * now[3]), sn * now[2] - cn * now[3]
        for row in range(3):
            j0, j1, j2 = J[row, 0], J[row, 1], J[row, 2]
            by_i[e, row, 0] = -(j0 * cn - j1 * sn)
            by_i[e, row, 1] = -(j0 * sn + j1 * cn)
            by_i[e, row, 2] = -(j0 * ty - j1 * tx + j2)


@kernel
def _planar_moves(poses: FloatArray, rows: IntArray, delta: FloatArray) -> None:
    for k in range(len(rows)):
        T, theta = poses[rows[k]], delta[k, 2]
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


@kernel
def _spatial_moves(poses: FloatArray, rows: IntArray, delta: FloatArray) -> None:
    """With K = hat(phi): R <- R (1 + a K + b K^2), t <- t + R (1 + b K + c K^2) rho."""
    turn, shift, old = np.empty(3), np.empty(3), np.empty((3, 3))
    for k in range(len(rows)):
        T, phi, rho = poses[rows[k]], delta[k, :3], delta[k, 3:]
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


@kernel
def _product(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    for r in range(3):
        for c in range(3):
            out[r, c] = a[r, 0] * b[0, c] + a[r, 1] * b[1, c] + a[r, 2] * b[2, c]


@kernel
def _hat(v: FloatArray, out: FloatArray) -> None:
    out[0, 0], out[1, 1], out[2, 2] = 0.0, 0.0, 0.0
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]


@kernel
def _spatial_between(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
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
def _spatial_error(now: FloatArray, z: FloatArray, work: FloatArray, residual: FloatArray) -> None:
    """Write log(z^-1 now) [rotation, translation]; `work` (3, 4) is overwritten."""
    _spatial_between(z, now, work)
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
def _spatial_residuals(poses: FloatArray, i: IntArray, j: IntArray, T: FloatArray, residuals: FloatArray) -> None:
    now, work = np.empty((3, 4)), np.empty((3, 4))
    for e in range(len(i)):
        _spatial_between(poses[i[e]], poses[j[e]], now)
        _spatial_error(now, T[e], work, residuals[e])


@kernel
def _mixed_jacobian(phi: FloatArray, rho: FloatArray, K: FloatArray, P: FloatArray, M: FloatArray, N: FloatArray,
                    Q: FloatArray) -> None:  # fmt: skip
    """Write Q of Barfoot (2017, eq. 7.86) for (-phi, -rho); K, P, M, N (3, 3) are overwritten."""
    square = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2
    if square < SMALL_SQUARE:
        c2 = 1.0 / 6.0 + square * (-1.0 / 120.0 + square * (1.0 / 5040.0 - square / 362880.0))
        c3 = -1.0 / 24.0 + square * (1.0 / 720.0 + square * (-1.0 / 40320.0 + square / 3628800.0))
        c4 = 1.0 / 120.0 + square * (-1.0 / 2520.0 + square * (1.0 / 120960.0 - square / 9979200.0))
    else:
        a = np.sqrt(square)
        sine, cosine = np.sin(a), np.cos(a)
        c2 = (a - sine) / (a * square)
        c3 = (1.0 - 0.5 * square - cosine) / (square * square)
        c4 = (2.0 * a - 3.0 * sine + a * cosine) / (2.0 * square * square * a)
    for k in range(3):
        phi[k], rho[k] = -phi[k], -rho[k]
    _hat(phi, K)
    _hat(rho, P)
    for k in range(3):
        phi[k], rho[k] = -phi[k], -rho[k]
    _product(K, P, M)  # KP; PK = (KP)^T since both are skew
    _product(M, K, N)  # KPK
    for r in range(3):
        for c in range(3):
            Q[r, c] = 0.5 * P[r, c] + c2 * (M[r, c] + M[c, r] + N[r, c]) + 3.0 * c3 * N[r, c]
    for r in range(3):
        for c in range(3):
            kkp, pkk = 0.0, 0.0
            kpkk, kkpk = 0.0, 0.0
            for k in range(3):
                kkp += K[r, k] * M[k, c]
                pkk += M[k, r] * K[k, c]
                kpkk += N[r, k] * K[k, c]
                kkpk += K[r, k] * N[k, c]
            Q[r, c] += -c3 * (kkp + pkk) + c4 * (kpkk + kkpk)


@kernel
def _spatial_jacobians(poses: FloatArray, i: IntArray, j: IntArray, T: FloatArray, residuals: FloatArray,
                       by_i: FloatArray, by_j: FloatArray) -> None:  # fmt: skip
    now, work = np.empty((3, 4)), np.empty((3, 4))
    K, P, M, N, Q, J, A = (np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)),
                           np.empty((3, 3)), np.empty((3, 3)))  # fmt: skip
    R_t, X, t = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for e in range(len(i)):
        _spatial_between(poses[i[e]], poses[j[e]], now)
        _spatial_error(now, T[e], work, residuals[e])
        phi = residuals[e, :3]
        _mixed_jacobian(phi, residuals[e, 3:], K, P, M, N, Q)
        _hat(phi, K)
        _product(K, K, M)
        k = _inverse_coefficient(phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2)
        for r in range(3):
            for c in range(3):
                J[r, c] = (1.0 if r == c else 0.0) + 0.5 * K[r, c] + k * M[r, c]
        _product(J, Q, M)
        _product(M, J, N)  # Jr^-1 of SE(3) is [[J, 0], [-J Q J, J]]
        # Ad(now^-1) = [[R^T, 0], [hat(-R^T t) R^T, R^T]], and hat(-R^T t) R^T = -R^T hat(t)
        for r in range(3):
            t[r] = now[r, 3]
            for c in range(3):
                R_t[r, c] = now[c, r]
        _hat(t, X)
        _product(R_t, X, A)
        _product(J, R_t, P)
        _product(N, R_t, K)
        _product(J, A, M)
        for r in range(3):
            for c in range(3):
                by_j[e, r, c], by_j[e, r, c + 3] = J[r, c], 0.0
                by_j[e, r + 3, c], by_j[e, r + 3, c + 3] = -N[r, c], J[r, c]
                by_i[e, r, c], by_i[e, r, c + 3] = -P[r, c], 0.0
                by_i[e, r + 3, c], by_i[e, r + 3, c + 3] = K[r, c] + M[r, c], -P[r, c]
