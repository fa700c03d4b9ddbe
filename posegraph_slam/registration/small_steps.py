"""Rigid steps of one registration round on 4 x 4 poses, in kernels; the plane is space without its third axis."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel


@kernel
def robust_weight(loss: int, u: float) -> float:
    """Weight of a residual of u standard deviations: 0 none, 1 Huber, 2 Cauchy, 3 Geman-McClure, 4 Tukey."""
    if loss == 1:
        return 1.345 / max(u, 1.345)
    if loss == 2:
        return 1.0 / (1.0 + (u / 2.3849) ** 2)
    if loss == 3:
        return 1.0 / (1.0 + (u / 3.7874) ** 2) ** 2
    if loss == 4:
        return max(1.0 - (u / 4.6851) ** 2, 0.0) ** 2
    return 1.0


@kernel
def robust_slope(loss: int, u: float) -> float:
    """Curvature of the loss at u standard deviations, in the order of `robust_weight`."""
    if loss == 1:
        return 1.0 if u <= 1.345 else 0.0
    if loss == 2:
        x = (u / 2.3849) ** 2
        return (1.0 - x) / (1.0 + x) ** 2
    if loss == 3:
        x = (u / 3.7874) ** 2
        return (1.0 - 3.0 * x) / (1.0 + x) ** 3
    if loss == 4:
        x = min((u / 4.6851) ** 2, 1.0)
        return (1.0 - x) * (1.0 - 5.0 * x)
    return 1.0


@kernel
def centre_and_radius(points: FloatArray, chosen: IntArray, count: int, d: int) -> tuple[FloatArray, float]:
    """Mean (3,) and root mean square radius of rows `chosen[:count]` of points (n, 3).

    Sums are taken from the first of them, so that no digits are lost far from the origin.
    """
    centre = np.zeros(3)
    if count == 0:
        return centre, 1e-9
    ox, oy, oz = points[chosen[0], 0], points[chosen[0], 1], points[chosen[0], 2]
    x, y, z, square = 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        at = chosen[k]
        u, v, w = points[at, 0] - ox, points[at, 1] - oy, points[at, 2] - oz
        x += u
        y += v
        z += w
        square += u * u + v * v + w * w
    x, y, z = x / count, y / count, z / count
    centre[0], centre[1], centre[2] = ox + x, oy + y, oz + z
    return centre, max(np.sqrt(max(square / count - (x * x + y * y + z * z), 0.0)), 1e-9)


@kernel
def update_about(T: FloatArray, centre: FloatArray, step: FloatArray, radius: float, d: int) -> FloatArray:
    """T (4, 4) after the right update of `step` (p,) about `centre`, turns measured on `radius`: T S exp(step) S^-1."""
    turn, move = np.zeros(3), np.zeros(3)
    if d == 2:
        turn[2], move[0], move[1] = step[2] / radius, step[0], step[1]
    else:
        for a in range(3):
            turn[a], move[a] = step[a] / radius, step[3 + a]
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    if angle > 1e-4:
        s, c, e = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    else:
        s, c, e = 1.0 - angle**2 / 6, 0.5 - angle**2 / 24, 1.0 / 6 - angle**2 / 120
    R, shift, carried = np.eye(3), np.zeros(3), np.zeros(3)  # a call of BLAS takes longer than these loops
    K = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    for a in range(3):
        shift[a] = move[a] + centre[a]
        for b in range(3):
            KK = turn[a] * turn[b] - (angle * angle if a == b else 0.0)
            R[a, b] += s * K[a, b] + c * KK
            shift[a] += (c * K[a, b] + e * KK) * move[b]
            carried[a] += R[a, b] * centre[b]
    for a in range(3):
        shift[a] -= carried[a]
    result = np.eye(4)
    for a in range(3):
        result[a, 3] = T[a, 3]
        for b in range(3):
            result[a, 3] += T[a, b] * shift[b]
            result[a, b] = T[a, 0] * R[0, b] + T[a, 1] * R[1, b] + T[a, 2] * R[2, b]
    return result


@kernel
def best_rigid(
    source: FloatArray, target: FloatArray, s: IntArray, t: IntArray, w: FloatArray, count: int, d: int
) -> tuple[FloatArray, bool]:
    """Pose (4, 4) that aligns `count` weighted pairs of rows, and whether it is the only one (Kabsch 1976)."""
    T, mean_s, mean_t = np.eye(4), np.zeros(3), np.zeros(3)
    total, Q = paired_moments(source, target, s, t, w, count, mean_s, mean_t)
    if total <= 0:
        return T, False
    if d == 2:  # the reflection cannot win: the closed form knows rotations alone
        cosine, sine = Q[0, 0] + Q[1, 1], Q[1, 0] - Q[0, 1]
        length = np.hypot(cosine, sine)
        largest = 0.5 * (length + np.hypot(Q[0, 0] - Q[1, 1], Q[1, 0] + Q[0, 1]))
        if not length > 1e-9 * largest:
            return T, False
        T[0, 0] = T[1, 1] = cosine / length
        T[1, 0], T[0, 1] = sine / length, -sine / length
    else:
        U, S, Vt = np.linalg.svd(Q)
        sign = 1.0 if np.linalg.det(U) * np.linalg.det(Vt) > 0 else -1.0
        if not S[1] + sign * S[2] > 1e-9 * S[0]:
            return T, False
        for a in range(3):
            for b in range(3):
                T[a, b] = U[a, 0] * Vt[0, b] + U[a, 1] * Vt[1, b] + sign * U[a, 2] * Vt[2, b]
    for a in range(d):
        T[a, 3] = mean_t[a]
        for b in range(d):
            T[a, 3] -= T[a, b] * mean_s[b]
    return T, True


@kernel
def paired_moments(
    source: FloatArray, target: FloatArray, s: IntArray, t: IntArray, w: FloatArray, count: int, mean_s: FloatArray,
    mean_t: FloatArray,
) -> tuple[float, FloatArray]:  # fmt: skip
    """Sum of the weights of `count` pairs and their cross moment (3, 3) about the means (3,), which are written.

    One pass, from the first pair, so that no digits are lost far from the origin.
    """
    Q = np.zeros((3, 3))
    if count == 0:
        return 0.0, Q
    ax, ay, az = source[s[0], 0], source[s[0], 1], source[s[0], 2]
    bx, by, bz = target[t[0], 0], target[t[0], 1], target[t[0], 2]
    total, xs, ys, zs, xt, yt, zt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    xx, xy, xz, yx, yy, yz, zx, zy, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        i, j, weight = s[k], t[k], w[k]
        x, y, z = weight * (source[i, 0] - ax), weight * (source[i, 1] - ay), weight * (source[i, 2] - az)
        u, v, h = target[j, 0] - bx, target[j, 1] - by, target[j, 2] - bz
        total += weight
        xs, ys, zs = xs + x, ys + y, zs + z
        xt, yt, zt = xt + weight * u, yt + weight * v, zt + weight * h
        xx, xy, xz = xx + u * x, xy + u * y, xz + u * z
        yx, yy, yz = yx + v * x, yy + v * y, yz + v * z
        zx, zy, zz = zx + h * x, zy + h * y, zz + h * z
    if total <= 0:
        return total, Q
    mean_s[0], mean_s[1], mean_s[2] = ax + xs / total, ay + ys / total, az + zs / total
    mean_t[0], mean_t[1], mean_t[2] = bx + xt / total, by + yt / total, bz + zt / total
    Q[0, 0], Q[0, 1], Q[0, 2] = xx - xt * xs / total, xy - xt * ys / total, xz - xt * zs / total
    Q[1, 0], Q[1, 1], Q[1, 2] = yx - yt * xs / total, yy - yt * ys / total, yz - yt * zs / total
    Q[2, 0], Q[2, 1], Q[2, 2] = zx - zt * xs / total, zy - zt * ys / total, zz - zt * zs / total
    return total, Q
