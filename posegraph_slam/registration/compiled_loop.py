"""The closest point loop as one kernel: what `icp` runs when no part of it is exchanged for another."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.kd_tree import STACK, nearest_two
from posegraph_slam.registration.robust import MEDIAN_OF_NORM
from posegraph_slam.registration.small_steps import (
    best_rigid,
    centre_and_radius,
    robust_weight,
    tangent_row,
    update_about,
)

POINT, PLANE, GENERALISED = 0, 1, 2
"""Residuals in the order of `ResidualKind`."""

CONVERGED, MAX_ITERATIONS, TOO_FEW_INLIERS, DEGENERATE = 0, 1, 2, 3

MEDIAN_1, MEDIAN_2, MEDIAN_3 = MEDIAN_OF_NORM[1], MEDIAN_OF_NORM[2], MEDIAN_OF_NORM[3]


@kernel
def run_loop(
    d: int, source: FloatArray, target: FloatArray, rows: IntArray, leaves: FloatArray, axis: IntArray,
    value: FloatArray, anchors: FloatArray, normals: FloatArray, trust: FloatArray, source_normals: FloatArray,
    start: FloatArray, residual: int, loss: int, options: FloatArray,
) -> tuple[FloatArray, int, int, IntArray, IntArray]:  # fmt: skip
    """Register source (n, 3) onto target (m, 3): pose (4, 4), status, rounds, and the rows (k,) of the last pairs.

    `residual`, `loss` and `options` come from `IcpSettings.for_kernels`. A pose that comes back,
    within the tolerances, to one of an earlier round runs in a circle of pairings (Brent 1980 finds it): it is as
    settled as it will be.
    """
    gate, keep, scale_given, rounds, turn_limit, move_limit = options[:6]
    ratio, plane_share, n = options[7], options[8], len(source)
    least_pairs = max(options[6], options[11] * n)
    T, remembered, power, lap = start.copy(), start.copy(), 1, 0
    partner, spare, moved = np.full(n, -1, dtype=np.int64), np.zeros(n), np.zeros((n, 3))
    s, t = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    square, weight, length = np.empty(n), np.empty(n), np.empty(n)
    stack, bounds = np.zeros((STACK, 3), dtype=np.int64), np.zeros((STACK, 4))
    for iteration in range(1, int(rounds) + 1):
        count = pair_nearest(d, T, source, target, rows, leaves, axis, value, gate, partner, spare, moved, s, t, square,
                             stack, bounds)  # fmt: skip
        if residual != POINT:
            count = with_normals(d, normals, s, t, square, count)
        if keep < 1 and count > 0:
            count = trim(keep, s, t, square, count)
        if count < least_pairs:
            return T, TOO_FEW_INLIERS, iteration, s[:count], t[:count]
        if residual == POINT:
            for k in range(count):
                length[k], weight[k] = np.sqrt(square[k]), 1.0
            weigh(loss, length, weight, count, scale_given, MEDIAN_2 if d == 2 else MEDIAN_3, move_limit)
            better, good = best_rigid(source, target, s, t, weight, count, d)
        elif residual == PLANE:
            for k in range(count):
                offset = 0.0
                for a in range(d):
                    offset += (moved[s[k], a] - anchors[t[k], a]) * normals[t[k], a]
                square[k] = offset
                length[k], weight[k] = abs(offset), trust[t[k]]
            weigh(loss, length, weight, count, scale_given, MEDIAN_1, move_limit)
            better, good = plane_step(d, T, source, normals, s, t, square, weight, count, ratio)
        else:
            better, good = generalised_step(
                d, T, source, target, moved, normals, source_normals, s, t, length, weight, count, ratio, plane_share,
                loss, scale_given, move_limit)  # fmt: skip
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
def is_near(a: FloatArray, b: FloatArray, turn_limit: float, move_limit: float) -> bool:
    """Whether two poses (4, 4) differ by less than a turn and a shift."""
    turned, moved = 0.0, 0.0
    for i in range(3):
        moved += (a[i, 3] - b[i, 3]) ** 2
        for j in range(3):
            turned += (a[i, j] - b[i, j]) ** 2
    turn = 2.0 * np.arcsin(min(np.sqrt(turned / 8.0), 1.0))
    return bool(np.sqrt(moved) < move_limit and turn < turn_limit)


@kernel
def pair_nearest(
    d: int, T: FloatArray, source: FloatArray, target: FloatArray, rows: IntArray, leaves: FloatArray, axis: IntArray,
    value: FloatArray, gate: float, partner: IntArray, spare: FloatArray, moved: FloatArray, s: IntArray, t: IntArray,
    square: FloatArray, stack: IntArray, bounds: FloatArray,
) -> int:  # fmt: skip
    """Move the source and pair it with the nearest targets within the gate; number of pairs.

    `spare` (n,) is how near any target but the partner may be: the distance of the second nearest when it was last
    searched, less all motion since. While the partner is nearer than that nothing needs to be searched (triangle
    inequality, as in Elkan 2003 for clusters); else it starts the search.
    """
    count = 0
    place = np.zeros(3)
    for k in range(len(source)):
        shift = 0.0
        for a in range(d):
            place[a] = T[a, 3]
            for b in range(d):
                place[a] += T[a, b] * source[k, b]
            shift += (place[a] - moved[k, a]) ** 2
            moved[k, a] = place[a]
        best, best_square = -1, gate * gate
        if partner[k] >= 0:
            before = 0.0
            for a in range(d):
                before += (place[a] - target[partner[k], a]) ** 2
            if before <= best_square:
                best, best_square = partner[k], before
            spare[k] -= np.sqrt(shift)
        if best < 0 or not (spare[k] > 0 and best_square < spare[k] ** 2 * (1 - 1e-12)):
            best, best_square, second = nearest_two(place[0], place[1], place[2], rows, leaves, axis, value, best,
                                                    best_square, gate * gate, stack, bounds)  # fmt: skip
            spare[k] = np.sqrt(second)
        partner[k] = best
        if best >= 0:
            s[count], t[count], square[count] = k, best, best_square
            count += 1
    return count


@kernel
def with_normals(d: int, normals: FloatArray, s: IntArray, t: IntArray, square: FloatArray, count: int) -> int:
    """Keep the pairs whose target has a normal; number of them."""
    kept = 0
    for k in range(count):
        size = 0.0
        for a in range(d):
            size += abs(normals[t[k], a])
        if size > 0:
            s[kept], t[kept], square[kept] = s[k], t[k], square[k]
            kept += 1
    return kept


@kernel
def trim(keep: float, s: IntArray, t: IntArray, square: FloatArray, count: int) -> int:
    """Keep the nearest share of the pairs, of equals the first; number of them."""
    wanted = min(max(int(np.round(keep * count)), 1), count)
    limit = np.partition(square[:count], wanted - 1)[wanted - 1]
    nearer = 0
    for k in range(count):
        nearer += square[k] < limit
    ties, kept = wanted - nearer, 0
    for k in range(count):
        tied = square[k] == limit
        if square[k] < limit or (tied and ties > 0):
            ties -= tied
            s[kept], t[kept], square[kept] = s[k], t[k], square[k]
            kept += 1
    return kept


@kernel
def weigh(
    loss: int, length: FloatArray, weight: FloatArray, count: int, scale_given: float, median_of_norm: float,
    floor: float,
) -> float:  # fmt: skip
    """Multiply the weights of the pairs by those of the loss; the scale it used."""
    if loss == 0:
        return 1.0
    scale = scale_given
    if scale <= 0:
        middle = count // 2
        scale = max(np.partition(length[:count], middle)[middle] / median_of_norm, floor)
    for k in range(count):
        weight[k] *= robust_weight(loss, length[k] / scale)
    return scale


@kernel
def solve_held(H: FloatArray, g: FloatArray, ratio: float) -> tuple[FloatArray, bool]:
    """Step (p,) that minimises along the eigenvectors of H that are held; others get none. False if none is held."""
    values, vectors = np.linalg.eigh(H)
    p = len(g)
    step, limit, held = np.zeros(p), max(ratio * values[p - 1], 2.2250738585072014e-308), False
    for j in range(p):
        if values[j] > limit:
            held = True
            along = 0.0
            for a in range(p):
                along += vectors[a, j] * g[a]
            for a in range(p):
                step[a] -= vectors[a, j] * along / values[j]
    return step, held


@kernel
def plane_step(
    d: int, T: FloatArray, source: FloatArray, normals: FloatArray, s: IntArray, t: IntArray, offset: FloatArray,
    weight: FloatArray, count: int, ratio: float,
) -> tuple[FloatArray, bool]:  # fmt: skip
    """One Gauss-Newton step on the distances (count,) to the targets' lines or planes (Chen and Medioni 1992)."""
    p = 3 * (d - 1)
    centre, radius = centre_and_radius(source, s, count, d)
    H, g, row, arm, n = np.zeros((p, p)), np.zeros(p), np.zeros(p), np.zeros(3), np.zeros(3)
    for k in range(count):
        for a in range(d):
            arm[a] = (source[s[k], a] - centre[a]) / radius
            n[a] = 0.0
            for b in range(d):
                n[a] += T[b, a] * normals[t[k], b]
        tangent_row(d, arm, n, row)
        for a in range(p):
            g[a] += weight[k] * row[a] * offset[k]
            for b in range(a + 1):
                H[a, b] += weight[k] * row[a] * row[b]
    for a in range(p):
        for b in range(a):
            H[b, a] = H[a, b]
    step, held = solve_held(H, g, ratio)
    return update_about(T, centre, step, radius, d), held


@kernel
def flat_metric(
    nx: float, ny: float, nz: float, mx: float, my: float, mz: float, share: float, M: FloatArray
) -> None:  # fmt: skip
    """Write 2 share (C_n + C_m)^-1 (3, 3), C of variance 1 along and `share` across a line or plane with that normal.

    A shift along two equal normals then counts once, one along their plane `share` times.
    """
    e = share - 1.0
    xx, yy, zz = 2.0 + e * (nx * nx + mx * mx), 2.0 + e * (ny * ny + my * my), 2.0 + e * (nz * nz + mz * mz)
    xy, xz, yz = e * (nx * ny + mx * my), e * (nx * nz + mx * mz), e * (ny * nz + my * mz)
    cx, cy, cz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    f = 2.0 * share / (xx * cx + xy * cy + xz * cz)
    M[0, 0], M[1, 1], M[2, 2] = f * cx, f * (xx * zz - xz * xz), f * (xx * yy - xy * xy)
    M[0, 1] = M[1, 0] = f * cy
    M[0, 2] = M[2, 0] = f * cz
    M[1, 2] = M[2, 1] = f * (xy * xz - xx * yz)


@kernel
def generalised_step(
    d: int, T: FloatArray, source: FloatArray, target: FloatArray, moved: FloatArray, normals: FloatArray,
    source_normals: FloatArray, s: IntArray, t: IntArray, length: FloatArray, weight: FloatArray, count: int,
    ratio: float, plane_share: float, loss: int, scale_given: float, floor: float,
) -> tuple[FloatArray, bool]:  # fmt: skip
    """One Gauss-Newton step of generalised ICP: shifts in the metric of both neighbourhoods (Segal et al. 2009)."""
    centre, radius = centre_and_radius(source, s, count, d)
    metric, shift = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for k in range(count):
        length[k] = metric_of_pair(d, T, target[t[k]], moved[s[k]], normals[t[k]], source_normals[s[k]], plane_share,
                                   metric[k], shift[k])  # fmt: skip
        weight[k] = 1.0
    weigh(loss, length, weight, count, scale_given, MEDIAN_1, floor)
    H, g, arm = np.zeros((6, 6)), np.zeros(6), np.zeros(3)
    for k in range(count):
        for a in range(d):
            arm[a] = (source[s[k], a] - centre[a]) / radius
        add_pull(arm, metric[k], shift[k], weight[k], H, g)
    H, g = of_dimension(d, H, g)
    step, held = solve_held(H, g, ratio)
    return update_about(T, centre, step, radius, d), held


@kernel
def metric_of_pair(
    d: int, T: FloatArray, target: FloatArray, moved: FloatArray, normal: FloatArray, source_normal: FloatArray,
    plane_share: float, metric: FloatArray, shift: FloatArray,
) -> float:  # fmt: skip
    """Write metric (3, 3) and shift (3,) of a pair in the source frame; the length of the shift in the metric."""
    for a in range(3):
        shift[a] = 0.0
        for b in range(d):
            shift[a] += T[b, a] * (moved[b] - target[b])
    nx = T[0, 0] * normal[0] + T[1, 0] * normal[1] + T[2, 0] * normal[2]
    ny = T[0, 1] * normal[0] + T[1, 1] * normal[1] + T[2, 1] * normal[2]
    nz = T[0, 2] * normal[0] + T[1, 2] * normal[1] + T[2, 2] * normal[2]
    flat_metric(nx, ny, nz, source_normal[0], source_normal[1], source_normal[2], plane_share, metric)
    square = 0.0
    for a in range(3):
        for b in range(3):
            square += shift[a] * metric[a, b] * shift[b]
    return float(np.sqrt(square))


@kernel
def add_pull(
    arm: FloatArray, metric: FloatArray, shift: FloatArray, weight: float, H: FloatArray, g: FloatArray
) -> None:
    """Add a pair, all in the source frame, to the Hessian (6, 6) and gradient (6,) in [turn, move].

    A turn w moves the point by w x arm: with A = hat(arm) and metric M the blocks are A M A^T, A M and M.
    """
    x, y, z = arm[0], arm[1], arm[2]
    for b in range(3):
        ax, ay, az = weight * metric[0, b], weight * metric[1, b], weight * metric[2, b]
        pull = ax * shift[0] + ay * shift[1] + az * shift[2]
        g[3 + b] += pull
        if b == 0:
            g[1] += z * pull
            g[2] -= y * pull
        elif b == 1:
            g[0] -= z * pull
            g[2] += x * pull
        else:
            g[0] += y * pull
            g[1] -= x * pull
        tx, ty, tz = y * az - z * ay, z * ax - x * az, x * ay - y * ax  # column b of A M
        H[0, 3 + b] += tx
        H[1, 3 + b] += ty
        H[2, 3 + b] += tz
        H[3 + b, 0] += tx
        H[3 + b, 1] += ty
        H[3 + b, 2] += tz
        H[3, 3 + b] += ax
        H[4, 3 + b] += ay
        H[5, 3 + b] += az
        for a in range(3):
            along = tx if a == 0 else (ty if a == 1 else tz)
            if b == 0:
                H[a, 1] += z * along
                H[a, 2] -= y * along
            elif b == 1:
                H[a, 0] -= z * along
                H[a, 2] += x * along
            else:
                H[a, 0] += y * along
                H[a, 1] -= x * along


@kernel
def of_dimension(d: int, H: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Hessian (p, p) and gradient (p,) from those of space in [turn, move]: in the plane [x, y, turn about z]."""
    if d == 3:
        return H, g
    pick = (3, 4, 2)
    small, short = np.empty((3, 3)), np.empty(3)
    for a in range(3):
        short[a] = g[pick[a]]
        for b in range(3):
            small[a, b] = H[pick[a], pick[b]]
    return small, short
