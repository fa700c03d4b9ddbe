"""Weights and Gauss-Newton steps of the compiled loop: to lines or planes, and generalised."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.generalised_metric import add_pull, metric_of_pair, of_dimension
from posegraph_slam.registration.robust import MEDIAN_OF_NORM
from posegraph_slam.registration.small_matrices import TINY, symmetric_eigen
from posegraph_slam.registration.small_steps import centre_and_radius, robust_weight, tangent_row, update_about

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
        middle = count // 2
        scale = max(np.partition(length[:count], middle)[middle] / median_of_norm, floor)
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
        across = 0.0
        for a in range(d):
            across += (moved[s[k], a] - anchors[t[k], a]) * normals[t[k], a]
        offset[k], length[k], weight[k] = across, abs(across), trust[t[k]]


@kernel
def plane_step(
    d: int, T: FloatArray, source: FloatArray, normals: FloatArray, s: IntArray, t: IntArray, offset: FloatArray,
    length: FloatArray, weight: FloatArray, count: int, ratio: float, loss: int, scale_given: float, floor: float,
) -> tuple[FloatArray, bool]:  # fmt: skip
    """One Gauss-Newton step on the distances (count,) to the targets' lines or planes (Chen and Medioni 1992)."""
    weigh(loss, length, weight, count, scale_given, MEDIAN_1, floor)
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
