"""The closest point loop as one kernel: what `icp` runs when no part of it is exchanged for another."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.pair_search import nothing_known, pair_nearest, trim, with_normals
from posegraph_slam.registration.robust_steps import (
    MEDIAN_2,
    MEDIAN_3,
    PLANE,
    POINT,
    generalised_step,
    offsets_to_planes,
    plane_step,
    weigh,
)
from posegraph_slam.registration.small_steps import best_rigid
from posegraph_slam.registration.uncertainty import CAUCHY, describe_pairs, rmse_of_pairs

CONVERGED, MAX_ITERATIONS, TOO_FEW_INLIERS, DEGENERATE = 0, 1, 2, 3

ROUNDS_IN_PLANE, ROUNDS_IN_SPACE = 1, 3
"""Rounds from the end of point-to-point to the pose it is held against: more change its mean NEES by 0.03."""


@kernel
def register(
    d: int, source: FloatArray, target: FloatArray, rows: IntArray, leaves: FloatArray, axis: IntArray,
    value: FloatArray, anchors: FloatArray, normals: FloatArray, trust: FloatArray, thickness: FloatArray,
    neighbours: IntArray, nearest: IntArray, source_normals: FloatArray, start: FloatArray, residual: int, loss: int,
    options: FloatArray,
) -> tuple[FloatArray, int, int, int, FloatArray, FloatArray, float]:  # fmt: skip
    """Run the loop and describe its end: pose (d+1, d+1), status, rounds, pairs, information, free directions, RMSE.

    One kernel, because a call into compiled code with as many arrays takes 5 us. A loop that failed comes back with
    its status and an information of zero.
    """
    T = np.eye(4)
    for a in range(d):
        T[a, 3] = start[a, d]
        for b in range(d):
            T[a, b] = start[a, b]
    known, reach, moved = nothing_known(len(source))
    T, status, iterations, s, t = run_loop(d, source, target, rows, leaves, axis, value, anchors, normals, trust,
                                           nearest, source_normals, T, residual, loss, options, known, reach,
                                           moved)  # fmt: skip
    pose, p = np.eye(d + 1), 3 * (d - 1)
    for a in range(d):
        pose[a, d] = T[a, 3]
        for b in range(d):
            pose[a, b] = T[a, b]
    if status not in (CONVERGED, MAX_ITERATIONS):
        return pose, status, iterations, len(s), np.zeros((p, p)), np.eye(p), np.nan
    rmse = rmse_of_pairs(d, T, source, target, normals, trust, anchors, source_normals, s, t, residual, options[8])
    if options[12] == 0.0:
        return pose, status, iterations, len(s), np.zeros((p, p)), np.eye(p), rmse
    information, free = describe_end(d, source, target, rows, leaves, axis, value, anchors, normals, trust, thickness,
                                     neighbours, nearest, T, s, t, residual, loss, options, known, reach,
                                     moved)  # fmt: skip
    return pose, status, iterations, len(s), information, free, rmse


@kernel
def describe_end(
    d: int, source: FloatArray, target: FloatArray, rows: IntArray, leaves: FloatArray, axis: IntArray,
    value: FloatArray, anchors: FloatArray, normals: FloatArray, trust: FloatArray, thickness: FloatArray,
    neighbours: IntArray, nearest: IntArray, T: FloatArray, s: IntArray, t: IntArray, residual: int, loss: int,
    options: FloatArray, known: IntArray, reach: FloatArray, moved: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Information (p, p) of the pose T (4, 4) that a loop ended at with pairs s, t (m,), and the free directions.

    Point-to-point ends far from what lines and planes tell, up to its own spacing of the points: a few rounds of these,
    with a Cauchy loss, lead to the pose that it is held against.
    """
    reference, n = T, len(source)
    if residual == POINT:
        u, v, square = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.empty(n)
        length, weight = np.empty(n), np.empty(n)
        for _ in range(ROUNDS_IN_PLANE if d == 2 else ROUNDS_IN_SPACE):
            count = pair_nearest(reference, source, target, rows, leaves, axis, value, nearest, options[0], known,
                                 reach, moved, u, v, square)  # fmt: skip
            count = with_normals(d, normals, u, v, square, count)
            if count < max(options[6], 1):
                break
            s, t = u[:count].copy(), v[:count].copy()
            offsets_to_planes(d, moved, anchors, normals, trust, s, t, square, length, weight, count)
            reference, _ = plane_step(d, reference, source, normals, s, t, square, length, weight, count, options[7],
                                      CAUCHY, 0.0, options[5])  # fmt: skip
    return describe_pairs(d, reference, source, target, anchors, normals, trust, thickness, neighbours, s, t, T,
                          residual, loss, options)  # fmt: skip


@kernel
def run_loop(
    d: int, source: FloatArray, target: FloatArray, rows: IntArray, leaves: FloatArray, axis: IntArray,
    value: FloatArray, anchors: FloatArray, normals: FloatArray, trust: FloatArray, nearest: IntArray,
    source_normals: FloatArray, start: FloatArray, residual: int, loss: int, options: FloatArray, known: IntArray,
    reach: FloatArray, moved: FloatArray,
) -> tuple[FloatArray, int, int, IntArray, IntArray]:  # fmt: skip
    """Register source (n, 3) onto target (m, 3): pose (4, 4), status, rounds, and the rows (k,) of the last pairs.

    `residual`, `loss` and `options` come from `IcpSettings.for_kernels`; `known`, `reach` and `moved` are what
    `pair_nearest` remembers. A pose that comes back, within the tolerances, to one of an earlier round runs in a
    circle of pairings (Brent 1980 finds it): it is as settled as it will be.
    """
    gate, keep, _, rounds, turn_limit, move_limit = options[:6]
    n = len(source)
    least_pairs = max(options[6], options[11] * n)
    T, remembered, power, lap = start.copy(), start.copy(), 1, 0
    s, t = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    square, weight, length = np.empty(n), np.empty(n), np.empty(n)
    for iteration in range(1, int(rounds) + 1):
        count = pair_nearest(
            T, source, target, rows, leaves, axis, value, nearest, gate, known, reach, moved, s, t, square
        )
        if residual != POINT:
            count = with_normals(d, normals, s, t, square, count)
        if keep < 1 and count > 0:
            count = trim(keep, s, t, square, count)
        if count < least_pairs:
            return T, TOO_FEW_INLIERS, iteration, s[:count], t[:count]
        better, good = take_step(d, T, source, target, moved, anchors, normals, trust, source_normals, s, t, square,
                                 length, weight, count, residual, loss, options)  # fmt: skip
        if not good:
            return T, DEGENERATE, iteration, s[:count], t[:count]
        settled = is_near(T, better, turn_limit, move_limit) or (
            iteration > 2 and is_near(remembered, better, turn_limit, move_limit)
        )
        T = better
        if settled:
            return T, CONVERGED, iteration, s[:count].copy(), t[:count].copy()
        lap += 1
        if lap == power:
            remembered, power, lap = T, 2 * power, 0
    return T, MAX_ITERATIONS, int(rounds), s[:count].copy(), t[:count].copy()


@kernel
def take_step(
    d: int, T: FloatArray, source: FloatArray, target: FloatArray, moved: FloatArray, anchors: FloatArray,
    normals: FloatArray, trust: FloatArray, source_normals: FloatArray, s: IntArray, t: IntArray, square: FloatArray,
    length: FloatArray, weight: FloatArray, count: int, residual: int, loss: int, options: FloatArray,
) -> tuple[FloatArray, bool]:  # fmt: skip
    """Weigh `count` pairs and take one step on them: the better pose (4, 4), and whether they say anything.

    `square` (n,) are the squared distances of the pairs; it, `length` and `weight` are written over.
    """
    scale, floor, ratio, plane_share = options[2], options[5], options[7], options[8]
    if residual == POINT:
        weight[:count] = 1.0
        if loss != 0:
            length[:count] = np.sqrt(square[:count])
            weigh(loss, length, weight, count, scale, MEDIAN_2 if d == 2 else MEDIAN_3, floor)
        better, good = best_rigid(source, target, s, t, weight, count, d)
    elif residual == PLANE:
        offsets_to_planes(d, moved, anchors, normals, trust, s, t, square, length, weight, count)
        better, good = plane_step(d, T, source, normals, s, t, square, length, weight, count, ratio, loss, scale, floor)
    else:
        better, good = generalised_step(d, T, source, target, moved, normals, source_normals, s, t, length, weight,
                                        count, ratio, plane_share, loss, scale, floor)  # fmt: skip
    return better, good


@kernel
def is_near(a: FloatArray, b: FloatArray, turn_limit: float, move_limit: float) -> bool:
    """Whether two poses (4, 4) differ by less than a turn and a shift."""
    turned, moved = 0.0, 0.0
    for i in range(3):
        moved += (a[i, 3] - b[i, 3]) ** 2
        for j in range(3):
            turned += (a[i, j] - b[i, j]) ** 2
    turn = 2.0 * np.arcsin(min(np.sqrt(turned / 8.0), 1.0))
    return bool(np.sqrt(moved) < move_limit and turn < turn_limit)
