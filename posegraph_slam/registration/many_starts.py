"""Trimmed Kabsch ICP from thousands of starts at once, on a table of nearest points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import inline_kernel, kernel


@inline_kernel
def clamped_cell(value: float, origin: float, voxel: float, size: int) -> int:
    """Number of the voxel along one axis that holds `value`, or the nearest one of the table."""
    cell = int(np.floor((value - origin) / voxel))
    return min(max(cell, 0), size - 1)


@kernel
def descend_all(
    starts: FloatArray, points: FloatArray, row: npt.NDArray[np.int32], model: FloatArray, normals: FloatArray,
    origin: FloatArray, voxel: float, keep: float, rounds: int, to_planes: bool,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Improve each of `starts` (s, 4, 4) by `rounds` of trimmed ICP of points (n, 3); poses and mean squares (s,).

    A round keeps the share `keep` of the points that lies nearest to the model and aligns it in closed form, or by one
    Gauss-Newton step to the tangent planes (Chetverikov et al. 2002, with the field of Fitzgibbon 2003). The mean
    square is that of the distances to the points of `model` after the last round.
    """
    count, n = len(starts), len(points)
    kept = min(max(int(np.round(keep * n)), 3), n)
    poses, scores = starts.copy(), np.full(count, np.inf)
    square, found = np.empty(n), np.empty(n, dtype=np.int64)
    for start in range(count):
        T = poses[start]
        for step in range(rounds + 1):
            for k in range(n):
                x = T[0, 0] * points[k, 0] + T[0, 1] * points[k, 1] + T[0, 2] * points[k, 2] + T[0, 3]
                y = T[1, 0] * points[k, 0] + T[1, 1] * points[k, 1] + T[1, 2] * points[k, 2] + T[1, 3]
                z = T[2, 0] * points[k, 0] + T[2, 1] * points[k, 1] + T[2, 2] * points[k, 2] + T[2, 3]
                i = clamped_cell(x, origin[0], voxel, row.shape[0])
                j = clamped_cell(y, origin[1], voxel, row.shape[1])
                m = clamped_cell(z, origin[2], voxel, row.shape[2])
                at = row[i, j, m]
                found[k] = at
                square[k] = (x - model[at, 0]) ** 2 + (y - model[at, 1]) ** 2 + (z - model[at, 2]) ** 2
            limit = np.partition(square, kept - 1)[kept - 1]
            total, taken = 0.0, 0
            for k in range(n):
                if square[k] <= limit:
                    total += square[k]
                    taken += 1
            scores[start] = total / taken
            if step < rounds and to_planes:
                step_to_planes(T, points, model, normals, found, square, limit)
            elif step < rounds:
                align_nearest(T, points, model, found, square, limit)
    return poses, scores


@kernel
def align_nearest(
    T: FloatArray, points: FloatArray, model: FloatArray, found: npt.NDArray[np.int64], square: FloatArray, limit: float
) -> None:
    """Write into T (4, 4) the rigid motion that aligns the points with `square` up to `limit` to their partners."""
    mean_p, mean_q, taken = np.zeros(3), np.zeros(3), 0
    for k in range(len(points)):
        if square[k] <= limit:
            taken += 1
            for a in range(3):
                mean_p[a] += points[k, a]
                mean_q[a] += model[found[k], a]
    mean_p /= taken
    mean_q /= taken
    Q = np.zeros((3, 3))
    for k in range(len(points)):
        if square[k] <= limit:
            for a in range(3):
                for b in range(3):
                    Q[a, b] += (model[found[k], a] - mean_q[a]) * (points[k, b] - mean_p[b])
    U, _, Vt = np.linalg.svd(Q)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        U[:, 2] *= -1.0
    R = U @ Vt
    for a in range(3):
        for b in range(3):
            T[a, b] = R[a, b]
        T[a, 3] = mean_q[a] - R[a, 0] * mean_p[0] - R[a, 1] * mean_p[1] - R[a, 2] * mean_p[2]


@kernel
def step_to_planes(
    T: FloatArray, points: FloatArray, model: FloatArray, normals: FloatArray, found: npt.NDArray[np.int64],
    square: FloatArray, limit: float,
) -> None:  # fmt: skip
    """Move T (4, 4) by one Gauss-Newton step on the distances of the kept points to their partners' planes.

    The turn is taken about the kept points' mean and measured on their radius; a damping of a millionth of the trace
    holds what the planes leave free.
    """
    moved, centre, taken = np.empty((len(points), 3)), np.zeros(3), 0
    for k in range(len(points)):
        for a in range(3):
            moved[k, a] = T[a, 0] * points[k, 0] + T[a, 1] * points[k, 1] + T[a, 2] * points[k, 2] + T[a, 3]
        if square[k] <= limit:
            taken += 1
            centre += moved[k]
    centre /= taken
    spread = 0.0
    for k in range(len(points)):
        if square[k] <= limit:
            for a in range(3):
                spread += (moved[k, a] - centre[a]) ** 2
    radius = max(np.sqrt(spread / taken), 1e-12)
    H, g, row = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    for k in range(len(points)):
        if square[k] > limit:
            continue
        n, q = normals[found[k]], model[found[k]]
        x, y, z = (
            (moved[k, 0] - centre[0]) / radius,
            (moved[k, 1] - centre[1]) / radius,
            (moved[k, 2] - centre[2]) / radius,
        )
        row[0], row[1], row[2] = y * n[2] - z * n[1], z * n[0] - x * n[2], x * n[1] - y * n[0]
        row[3], row[4], row[5] = n[0], n[1], n[2]
        error = 0.0
        for a in range(3):
            error += (moved[k, a] - q[a]) * n[a]
        for a in range(6):
            g[a] += row[a] * error
            for b in range(6):
                H[a, b] += row[a] * row[b]
    damping = 1e-6 * np.trace(H) + 1e-300
    for a in range(6):
        H[a, a] += damping
    d = -np.linalg.solve(H, g)
    turn = d[:3] / radius
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    s = np.sin(angle) / angle if angle > 1e-9 else 1.0
    c = (1 - np.cos(angle)) / angle**2 if angle > 1e-9 else 0.5
    K = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    R = np.eye(3) + s * K + c * (K @ K)
    before = T[:3, 3].copy()
    T[:3, :3] = R @ np.ascontiguousarray(T[:3, :3])
    for a in range(3):
        T[a, 3] = centre[a] + d[3 + a]
        for b in range(3):
            T[a, 3] += R[a, b] * (before[b] - centre[b])
