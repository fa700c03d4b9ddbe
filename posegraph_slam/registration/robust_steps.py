"""Weights and Gauss-Newton steps of the compiled loop: to lines or planes, and generalised."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.generalised_metric import add_pull, metric_of_pair, of_dimension
from posegraph_slam.registration.robust import MEDIAN_OF_NORM
from posegraph_slam.registration.selection import middle_of
from posegraph_slam.registration.small_matrices import TINY, symmetric_eigen
from posegraph_slam.registration.small_steps import centre_and_radius, robust_weight, update_about

POINT, PLANE, GENERALISED = 0, 1, 2
"""Residuals in the order of `ResidualKind`."""

MEDIAN_1, MEDIAN_2, MEDIAN_3 = MEDIAN_OF_NORM[1], MEDIAN_OF_NORM[2], MEDIAN_OF_NORM[3]


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
        scale = max(middle_of(length, count) / median_of_norm, floor)
    for k in range(count):
        weight[k] *= robust_weight(loss, length[k] / scale)
    return scale


@kernel
def solve_held(H: FloatArray, g: FloatArray, ratio: float) -> tuple[FloatArray, bool]:
    """Step (p,) that minimises along the eigenvectors of H that are held; others get none. False if none is held."""
    values, vectors = symmetric_eigen(H)
    p = len(g)
    step, limit, held = np.zeros(p), max(ratio * values[p - 1], TINY), False
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
def offsets_to_planes(
    d: int, moved: FloatArray, anchors: FloatArray, normals: FloatArray, trust: FloatArray, s: IntArray, t: IntArray,
    offset: FloatArray, length: FloatArray, weight: FloatArray, count: int,
) -> None:  # fmt: skip
    """Write the signed distances of the pairs to the targets' lines or planes, their lengths and first weights."""
    for k in range(count):
        at, to = s[k], t[k]
        across = (moved[at, 0] - anchors[to, 0]) * normals[to, 0] + (moved[at, 1] - anchors[to, 1]) * normals[to, 1]
        if d == 3:
            across += (moved[at, 2] - anchors[to, 2]) * normals[to, 2]
        offset[k], length[k], weight[k] = across, abs(across), trust[to]


@kernel
def plane_step(
    d: int, T: FloatArray, source: FloatArray, normals: FloatArray, s: IntArray, t: IntArray, offset: FloatArray,
    length: FloatArray, weight: FloatArray, count: int, ratio: float, loss: int, scale_given: float, floor: float,
) -> tuple[FloatArray, bool]:  # fmt: skip
    """One Gauss-Newton step on the distances (count,) to the targets' lines or planes (Chen and Medioni 1992)."""
    weigh(loss, length, weight, count, scale_given, MEDIAN_1, floor)
    centre, radius = centre_and_radius(source, s, count, d)
    if d == 2:
        H, g = sums_in_plane(T, centre, radius, source, normals, s, t, offset, weight, count)
    else:
        H, g = sums_in_space(T, centre, radius, source, normals, s, t, offset, weight, count)
    step, held = solve_held(H, g, ratio)
    return update_about(T, centre, step, radius, d), held


@kernel
def sums_in_plane(
    T: FloatArray, centre: FloatArray, radius: float, source: FloatArray, normals: FloatArray, s: IntArray,
    t: IntArray, offset: FloatArray, weight: FloatArray, count: int,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Hessian (3, 3) and gradient (3,) of the weighted distances (count,) to lines, in the frame about the centre.

    Sums in scalars stay in registers: four times as fast as in arrays.
    """
    H, g, inverse = np.zeros((3, 3)), np.zeros(3), 1.0 / radius
    cosine, sine, cx, cy = T[0, 0], T[1, 0], centre[0], centre[1]
    xx, xy, yy, xt, yt, tt, gx, gy, gt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        at, to = s[k], t[k]
        u = cosine * normals[to, 0] + sine * normals[to, 1]
        v = cosine * normals[to, 1] - sine * normals[to, 0]
        turn = ((source[at, 0] - cx) * v - (source[at, 1] - cy) * u) * inverse
        wu, wv, wt = weight[k] * u, weight[k] * v, weight[k] * turn
        xx, xy, yy = xx + wu * u, xy + wu * v, yy + wv * v
        xt, yt, tt = xt + wu * turn, yt + wv * turn, tt + wt * turn
        gx, gy, gt = gx + wu * offset[k], gy + wv * offset[k], gt + wt * offset[k]
    g[0], g[1], g[2] = gx, gy, gt
    H[0, 0], H[1, 1], H[2, 2] = xx, yy, tt
    H[0, 1] = H[1, 0] = xy
    H[0, 2] = H[2, 0] = xt
    H[1, 2] = H[2, 1] = yt
    return H, g


@kernel
def sums_in_space(
    T: FloatArray, centre: FloatArray, radius: float, source: FloatArray, normals: FloatArray, s: IntArray,
    t: IntArray, offset: FloatArray, weight: FloatArray, count: int,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Hessian (6, 6) and gradient (6,) of the weighted distances (count,) to planes, in the frame about the centre."""
    H, g, row, inverse = np.zeros((6, 6)), np.zeros(6), np.zeros(6), 1.0 / radius
    cx, cy, cz = centre[0], centre[1], centre[2]
    for k in range(count):
        at, to = s[k], t[k]
        n0, n1, n2 = normals[to, 0], normals[to, 1], normals[to, 2]
        x, y, z = (source[at, 0] - cx) * inverse, (source[at, 1] - cy) * inverse, (source[at, 2] - cz) * inverse
        u = T[0, 0] * n0 + T[1, 0] * n1 + T[2, 0] * n2
        v = T[0, 1] * n0 + T[1, 1] * n1 + T[2, 1] * n2
        w = T[0, 2] * n0 + T[1, 2] * n1 + T[2, 2] * n2
        row[0], row[1], row[2] = y * w - z * v, z * u - x * w, x * v - y * u
        row[3], row[4], row[5] = u, v, w
        for a in range(6):
            along = weight[k] * row[a]
            g[a] += along * offset[k]
            for b in range(a + 1):
                H[a, b] += along * row[b]
    for a in range(6):
        for b in range(a):
            H[b, a] = H[a, b]
    return H, g


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
