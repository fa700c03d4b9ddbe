"""Information and free directions of a registration, from the distances of its pairs to fitted lines or planes."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.generalised_metric import metric_of_pair
from posegraph_slam.registration.levers import levers_of
from posegraph_slam.registration.robust_steps import MEDIAN_1, PLANE, POINT
from posegraph_slam.registration.score_products import (
    fitted_away,
    larger_of,
    score_products,
    weighted_squares,
    with_gap,
)
from posegraph_slam.registration.score_slope import LEAST_SLOPE, follow_partners, inverse_slope, without_tilts
from posegraph_slam.registration.selection import middle_of
from posegraph_slam.registration.small_matrices import TINY, congruent, inverse_of_positive, symmetric_eigen
from posegraph_slam.registration.small_steps import centre_and_radius, robust_slope, robust_weight
from posegraph_slam.registration.tangent_frames import free_at_origin, gap_between, to_origin

CAUCHY = 2
"""The loss in the order of `Loss` under which pairs are described that were matched by other distances, without one."""

SURE = 3.0
"""Standard errors by which the joint scores of neighbours must exceed what is expected of them before they count.

With one, the larger of both made the covariances of rooms 4 to 6 % too large by chance alone.
"""


@kernel
def describe_pairs(
    d: int, T: FloatArray, source: FloatArray, target: FloatArray, anchors: FloatArray, normals: FloatArray,
    trust: FloatArray, thickness: FloatArray, neighbours: IntArray, s: IntArray, t: IntArray, reached: FloatArray,
    residual: int, loss: int, options: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Information (p, p) of the pose `reached` at the source origin, and unit tangents (f, p) of the free directions.

    Whatever was minimised, pairs are described by their distances to the target's lines or planes at a pose T, in a
    frame about their centre in which turns are measured on their radius. The covariance is D^-1 M D^-1 (Huber 1967;
    White 1980) with the slope D of the sum of scores and its covariance M from `score_products`. Directions whose part
    of H = J^T W J, in the plane less what is noise of the lines' own directions, is under the ratio are free and get
    `free_sigma_m`. A matcher that minimises something else stops elsewhere than the distances to lines and planes would
    have it: `with_gap` counts that gap, from T to `reached` and one Newton step.
    """
    floor, ratio, sigma_floor, free_sigma = options[5], options[7], options[9], options[10]
    centre, radius = centre_and_radius(source, s, len(s), d)
    jacobian, offset, gaps = linearise_pairs(d, T, centre, radius, source, anchors, normals, s, t)
    weight, bend, slope = weigh_pairs(offset, trust, t, residual, loss, options[2], floor)
    H, gradient, scores = weigh_rows(jacobian, offset, weight)
    lever, size = levers_of(d, gaps, target, anchors, normals, neighbours, t)
    if d == 2:
        follow_partners(offset, weight, target, anchors, normals, thickness, size, neighbours.shape[1], t, bend)
        H, D = without_tilts(H, jacobian, source, s, centre, radius, thickness, size, neighbours.shape[1], t, weight,
                             bend)  # fmt: skip
    else:
        D = weighted_squares(jacobian, bend)
    values, vectors = symmetric_eigen(H)
    free = 0
    while free < len(values) and values[free] <= max(ratio * values[len(values) - 1], TINY):
        free += 1
    sources, targets, near, variance = score_products(d, scores, offset, weight, lever, thickness, target, neighbours,
                                                      t, sigma_floor)  # fmt: skip
    inverse = inverse_slope(congruent(D, vectors, free), values, slope)
    fitted, grown = fitted_away(d, jacobian, scores, weight, variance, sources + targets,
                                on_held(inverse, vectors, free), neighbours.shape[1])  # fmt: skip
    M = congruent(sources + fitted + grown * targets, vectors, free)
    least_ratio = 1.0 + SURE * np.sqrt(2.0 * neighbours.shape[1] / max(len(s), 1))
    covariance = congruent(larger_of(M, congruent(near, vectors, free), least_ratio), inverse, 0)
    held, gap = len(values) - free, gap_between(d, T, reached, centre, radius)
    pull = np.zeros(held)
    for i in range(held):
        for a in range(len(values)):
            pull[i] += vectors[a, free + i] * (gradient[a] / (slope * values[free + i]) + gap[a])
    information = invert_held(with_gap(covariance, pull), vectors, free, 1.0 / free_sigma**2)
    return to_origin(d, information, centre, radius), free_at_origin(d, vectors, free, centre, radius)


@kernel
def linearise_pairs(
    d: int, T: FloatArray, centre: FloatArray, radius: float, source: FloatArray, anchors: FloatArray,
    normals: FloatArray, s: IntArray, t: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Jacobian (m, p) of the distances to the lines or planes, these (m,), and the gaps (m, 3) from their anchors."""
    count, inverse = len(s), 1.0 / radius
    jacobian, offset, gaps = np.empty((count, 3 * (d - 1))), np.empty(count), np.empty((count, 3))
    for k in range(count):
        at, to = s[k], t[k]
        px, py, pz = source[at, 0], source[at, 1], source[at, 2]
        n0, n1, n2, height = normals[to, 0], normals[to, 1], normals[to, 2], anchors[to, 2] if d == 3 else 0.0
        gx = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3] - anchors[to, 0]
        gy = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3] - anchors[to, 1]
        gz = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3] - height
        u = T[0, 0] * n0 + T[1, 0] * n1 + T[2, 0] * n2
        v = T[0, 1] * n0 + T[1, 1] * n1 + T[2, 1] * n2
        w = T[0, 2] * n0 + T[1, 2] * n1 + T[2, 2] * n2
        x, y, z = (px - centre[0]) * inverse, (py - centre[1]) * inverse, (pz - centre[2]) * inverse
        if d == 2:
            jacobian[k, 0], jacobian[k, 1], jacobian[k, 2] = u, v, x * v - y * u
        else:
            jacobian[k, 0], jacobian[k, 1], jacobian[k, 2] = y * w - z * v, z * u - x * w, x * v - y * u
            jacobian[k, 3], jacobian[k, 4], jacobian[k, 5] = u, v, w
        gaps[k, 0], gaps[k, 1], gaps[k, 2], offset[k] = gx, gy, gz, gx * n0 + gy * n1 + gz * n2
    return jacobian, offset, gaps


@kernel
def weigh_rows(
    jacobian: FloatArray, offset: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Hessian J^T W J (p, p), gradient J^T W r (p,) and scores W J (m, p)."""
    count, p = jacobian.shape
    gradient, scores = np.zeros(p), np.empty((count, p))
    for a in range(0, p, 3):
        x, y, z = 0.0, 0.0, 0.0
        for k in range(count):
            u, v, w = weight[k] * jacobian[k, a], weight[k] * jacobian[k, a + 1], weight[k] * jacobian[k, a + 2]
            x, y, z = x + u * offset[k], y + v * offset[k], z + w * offset[k]
            scores[k, a], scores[k, a + 1], scores[k, a + 2] = u, v, w
        gradient[a], gradient[a + 1], gradient[a + 2] = x, y, z
    return weighted_squares(jacobian, weight), gradient, scores


@kernel
def rmse_of_pairs(
    d: int, T: FloatArray, source: FloatArray, target: FloatArray, normals: FloatArray, trust: FloatArray,
    anchors: FloatArray, source_normals: FloatArray, s: IntArray, t: IntArray, residual: int, plane_share: float,
) -> float:  # fmt: skip
    """Root mean square of what was minimised: distances to points or to lines and planes, or lengths in the metric."""
    total, squares = 0.0, 0.0
    metric, shift, moved = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for k in range(len(s)):
        at, to, weight = s[k], t[k], 1.0
        px, py, pz = source[at, 0], source[at, 1], source[at, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if residual == POINT:
            square = (x - target[to, 0]) ** 2 + (y - target[to, 1]) ** 2 + (z - target[to, 2]) ** 2
        elif residual == PLANE:
            across = (x - anchors[to, 0]) * normals[to, 0] + (y - anchors[to, 1]) * normals[to, 1]
            if d == 3:
                across += (z - anchors[to, 2]) * normals[to, 2]
            square, weight = across * across, trust[to]
        else:
            moved[0], moved[1], moved[2] = x, y, z
            square = metric_of_pair(d, T, target[to], moved, normals[to], source_normals[at], plane_share, metric,
                                    shift) ** 2  # fmt: skip
        total += weight
        squares += weight * square
    return float(np.sqrt(squares / max(total, TINY)))


@kernel
def weigh_pairs(
    offset: FloatArray, trust: FloatArray, t: IntArray, residual: int, loss: int, scale_given: float, floor: float
) -> tuple[FloatArray, FloatArray, float]:
    """Weights (m,) of the pairs by trust and loss, trust times curvature of the loss (m,), and their sums' ratio."""
    count = len(t)
    weight, bend, length = np.empty(count), np.empty(count), np.abs(offset)
    if residual != PLANE and loss == 0:
        loss = CAUCHY
    for k in range(count):
        weight[k] = bend[k] = trust[t[k]]
    if loss == 0 or count == 0:
        return weight, bend, 1.0
    scale = scale_given
    if scale <= 0 or residual != PLANE:
        scale = max(middle_of(length, count) / MEDIAN_1, floor)
    bent, total, factor = 0.0, 0.0, np.empty(count)
    for k in range(count):
        factor[k] = robust_weight(loss, length[k] / scale)
    if loss == CAUCHY:  # the usual one: its curvature is (1 - x) / (1 + x)^2 where the weight is 1 / (1 + x)
        for k in range(count):
            bend[k] *= factor[k] * (2.0 * factor[k] - 1.0)
    else:
        for k in range(count):
            bend[k] *= robust_slope(loss, length[k] / scale)
    for k in range(count):
        weight[k] *= factor[k]
        bent += bend[k]
        total += weight[k]
    return weight, bend, max(bent / max(total, TINY), LEAST_SLOPE)


@kernel
def on_held(inverse: FloatArray, vectors: FloatArray, free: int) -> FloatArray:
    """Matrix (p, p) that is `inverse` (h, h) on the held eigenvectors and nothing on the free ones."""
    p = len(vectors)
    whole = np.zeros((p, p))
    whole[free:, free:] = inverse
    return congruent(whole, vectors.T, 0)


@kernel
def invert_held(covariance: FloatArray, vectors: FloatArray, free: int, lowest: float) -> FloatArray:
    """Information (p, p) from the covariance (h, h) along the held eigenvectors; `lowest` along the free ones."""
    p, held = len(vectors), len(covariance)
    if free == 0 and np.trace(covariance) * lowest <= 1.0:  # the rule: no direction is near the limit
        inverse, exists = inverse_of_positive(covariance)
        if exists:
            return congruent(inverse, vectors.T, 0)
    information, axis = np.zeros((p, p)), np.zeros(p)
    for j in range(free):
        for a in range(p):
            for b in range(p):
                information[a, b] += lowest * vectors[a, j] * vectors[b, j]
    values, turned = symmetric_eigen((covariance + covariance.T) / 2)
    for j in range(held):
        known = max(1.0 / max(values[j], 1e-300), lowest)
        for a in range(p):
            axis[a] = 0.0
            for i in range(held):
                axis[a] += vectors[a, free + i] * turned[i, j]
        for a in range(p):
            for b in range(p):
                information[a, b] += known * axis[a] * axis[b]
    return information
