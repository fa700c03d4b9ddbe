"""Information and free directions of a registration, from the distances of its pairs to fitted lines or planes."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.generalised_metric import metric_of_pair
from posegraph_slam.registration.robust_steps import GENERALISED, MEDIAN_1, PLANE
from posegraph_slam.registration.score_products import larger_of, score_products
from posegraph_slam.registration.small_matrices import TINY, symmetric_eigen
from posegraph_slam.registration.small_steps import centre_and_radius, robust_slope, robust_weight, tangent_row
from posegraph_slam.registration.tangent_frames import free_at_origin, gap_between, to_origin

CAUCHY = 2
"""The loss in the order of `Loss` under which pairs are described that were matched by other distances, without one."""

LEAST_SLOPE = 0.1
"""Mean curvature of the loss, over that of least squares, that is taken at least: it may be negative far out."""


@kernel
def describe_pairs(
    d: int, T: FloatArray, source: FloatArray, target: FloatArray, anchors: FloatArray, normals: FloatArray,
    trust: FloatArray, thickness: FloatArray, neighbours: IntArray, s: IntArray, t: IntArray, reached: FloatArray,
    residual: int, loss: int, options: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Information (p, p) of the pose `reached` at the source origin, and unit tangents (f, p) of the free directions.

    Whatever was minimised, pairs are described by their distances to the target's lines or planes at a pose T, in a
    frame about their centre in which turns are measured on their radius. The covariance is H^-1 M H^-1 (Huber 1967;
    White 1980) with M from `score_products`. A matcher that minimises something else stops elsewhere than the
    distances to lines and planes would have it: that gap g, from T to `reached` and one Newton step, is error of a
    less efficient estimate (Hausman 1978), so that the second moment of the error is no less than g g^T along it.
    Directions whose part of H is under the ratio are free and get `free_sigma_m`.
    """
    floor, ratio, sigma_floor, free_sigma = options[5], options[7], options[9], options[10]
    centre, radius = centre_and_radius(source, s, len(s), d)
    jacobian, offset, gaps = linearise_pairs(d, T, centre, radius, source, anchors, normals, s, t)
    weight, slope = weigh_pairs(offset, trust, t, residual, loss, options[2], floor)
    H = weighted_square(jacobian, weight)
    values, vectors = symmetric_eigen(H)
    free = 0
    while free < len(values) and values[free] <= max(ratio * values[len(values) - 1], TINY):
        free += 1
    scores = scores_along(jacobian, weight, vectors, free)
    M = score_products(d, scores, offset, weight, gaps, thickness, anchors, target, normals, neighbours, t, sigma_floor)
    held = len(values) - free
    covariance, step = np.zeros((held, held)), np.zeros((held, held))
    pull, gap = np.zeros(held), gap_between(d, T, reached, centre, radius)
    for i in range(held):
        for k in range(len(s)):
            pull[i] += scores[k, i] * offset[k] / (slope * values[free + i])
        for a in range(len(values)):
            pull[i] += vectors[a, free + i] * gap[a]
    freedom = len(s) / max(len(s) - held, 1)
    for i in range(held):
        for j in range(held):
            covariance[i, j] = freedom * M[i, j] / (slope * slope * values[free + i] * values[free + j])
            step[i, j] = pull[i] * pull[j]
    information = invert_held(larger_of(covariance, step, 1.0), vectors, free, 1.0 / free_sigma**2)
    return to_origin(d, information, centre, radius), free_at_origin(d, vectors, free, centre, radius)


@kernel
def linearise_pairs(
    d: int, T: FloatArray, centre: FloatArray, radius: float, source: FloatArray, anchors: FloatArray,
    normals: FloatArray, s: IntArray, t: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Jacobian (m, p) of the distances to the lines or planes, these (m,), and the gaps (m, 3) from their anchors."""
    count = len(s)
    jacobian, offset, gaps = np.zeros((count, 3 * (d - 1))), np.zeros(count), np.zeros((count, 3))
    arm, n = np.zeros(3), np.zeros(3)
    for k in range(count):
        for a in range(d):
            moved = T[a, 3]
            for b in range(d):
                moved += T[a, b] * source[s[k], b]
            gaps[k, a] = moved - anchors[t[k], a]
            offset[k] += gaps[k, a] * normals[t[k], a]
            arm[a] = (source[s[k], a] - centre[a]) / radius
            n[a] = 0.0
            for b in range(d):
                n[a] += T[b, a] * normals[t[k], b]
        tangent_row(d, arm, n, jacobian[k])
    return jacobian, offset, gaps


@kernel
def rmse_of_pairs(
    d: int, T: FloatArray, source: FloatArray, target: FloatArray, normals: FloatArray, trust: FloatArray,
    anchors: FloatArray, source_normals: FloatArray, s: IntArray, t: IntArray, residual: int, plane_share: float,
) -> float:  # fmt: skip
    """Root mean square of what was minimised: distances to points or to lines and planes, or lengths in the metric."""
    total, squares = 0.0, 0.0
    metric, shift, moved = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for k in range(len(s)):
        square, across, weight = 0.0, 0.0, 1.0
        for a in range(d):
            moved[a] = T[a, 3]
            for b in range(d):
                moved[a] += T[a, b] * source[s[k], b]
            square += (moved[a] - target[t[k], a]) ** 2
            across += (moved[a] - anchors[t[k], a]) * normals[t[k], a]
        if residual == PLANE:
            square, weight = across * across, trust[t[k]]
        elif residual == GENERALISED:
            square = metric_of_pair(d, T, target[t[k]], moved, normals[t[k]], source_normals[s[k]], plane_share, metric,
                                    shift) ** 2  # fmt: skip
        total += weight
        squares += weight * square
    return float(np.sqrt(squares / max(total, TINY)))


@kernel
def weigh_pairs(
    offset: FloatArray, trust: FloatArray, t: IntArray, residual: int, loss: int, scale_given: float, floor: float
) -> tuple[FloatArray, float]:
    """Weights (m,) of the pairs by trust and loss, and the mean curvature of the loss over that of least squares."""
    count = len(t)
    weight, length = np.empty(count), np.abs(offset)
    if residual != PLANE and loss == 0:
        loss = CAUCHY
    for k in range(count):
        weight[k] = trust[t[k]]
    if loss == 0 or count == 0:
        return weight, 1.0
    scale = scale_given
    if scale <= 0 or residual != PLANE:
        middle = count // 2
        scale = max(np.partition(length, middle)[middle] / MEDIAN_1, floor)
    bent, total = 0.0, 0.0
    for k in range(count):
        bent += weight[k] * robust_slope(loss, length[k] / scale)
        weight[k] *= robust_weight(loss, length[k] / scale)
        total += weight[k]
    return weight, max(bent / max(total, TINY), LEAST_SLOPE)


@kernel
def weighted_square(jacobian: FloatArray, weight: FloatArray) -> FloatArray:
    """Matrix J^T W J (p, p)."""
    count, p = jacobian.shape
    H = np.zeros((p, p))
    for k in range(count):
        for a in range(p):
            along = weight[k] * jacobian[k, a]
            for b in range(a + 1):
                H[a, b] += along * jacobian[k, b]
    for a in range(p):
        for b in range(a):
            H[b, a] = H[a, b]
    return H


@kernel
def scores_along(jacobian: FloatArray, weight: FloatArray, vectors: FloatArray, free: int) -> FloatArray:
    """Weight times Jacobian (m, p) along the eigenvectors (p, p) after the first `free`: (m, p - free)."""
    count, p = jacobian.shape
    scores = np.zeros((count, p - free))
    for k in range(count):
        for j in range(p - free):
            along = 0.0
            for a in range(p):
                along += jacobian[k, a] * vectors[a, free + j]
            scores[k, j] = weight[k] * along
    return scores


@kernel
def invert_held(covariance: FloatArray, vectors: FloatArray, free: int, lowest: float) -> FloatArray:
    """Information (p, p) from the covariance (h, h) along the held eigenvectors; `lowest` along the free ones."""
    p, held = len(vectors), len(covariance)
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
