"""Information and free directions of a registration from the scores of its pairs."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.compiled_loop import (
    GENERALISED,
    MEDIAN_1,
    MEDIAN_2,
    MEDIAN_3,
    PLANE,
    POINT,
    add_pull,
    metric_of_pair,
    of_dimension,
)
from posegraph_slam.registration.small_steps import centre_and_radius, robust_slope, robust_weight, tangent_row


@kernel
def describe_pairs(
    d: int, T: FloatArray, source: FloatArray, target: FloatArray, anchors: FloatArray, normals: FloatArray,
    trust: FloatArray, thickness: FloatArray, neighbours: IntArray, source_normals: FloatArray, s: IntArray,
    t: IntArray, residual: int, loss: int, options: FloatArray, share: float,
) -> tuple[FloatArray, FloatArray, int, float]:  # fmt: skip
    """Information (p, p) at the source origin, eigenvectors (p, p) of which the first few are free, how many, and RMSE.

    The covariance is H^-1 M H^-1 (Huber 1967; White 1980), in a frame about the pairs' centre in which turns are
    measured on their radius. M sums the outer products of the scores of the source points, each with its own residual,
    and of the target points, each of which moves every pair that leans on it. With independent residuals of one
    variance that is sigma^2 H^-1. The pairs given are the `share` of all that they speak for.
    Directions whose part of H is under the ratio are free and get `free_sigma_m`.
    """
    scale_given, floor, ratio, plane_share = options[2], options[5], options[7], options[8]
    sigma_floor, free_sigma = options[9], options[10]
    count, p = len(s), 3 * (d - 1)
    centre, radius = centre_and_radius(source, s, count, d)
    jacobian, offset, length, weight = np.zeros((count, p)), np.zeros(count), np.zeros(count), np.zeros(count)
    gaps, gap, arm, n = np.zeros((count, 3)), np.zeros(3), np.zeros(3), np.zeros(3)
    whole = count if residual == GENERALISED else 0
    arms, metrics, shifts = np.zeros((whole, 3)), np.zeros((whole, 3, 3)), np.zeros((whole, 3))
    pulls, point = np.zeros((whole, p)), np.zeros(3)
    for k in range(count):
        square = 0.0
        for a in range(d):
            moved = T[a, 3]
            for b in range(d):
                moved += T[a, b] * source[s[k], b]
            gap[a] = moved - target[t[k], a]
            gaps[k, a] = moved - anchors[t[k], a] if residual == PLANE else gap[a]
            square += gap[a] ** 2
            arm[a] = (source[s[k], a] - centre[a]) / radius
            offset[k] += gaps[k, a] * normals[t[k], a]
            n[a] = 0.0
            for b in range(d):
                n[a] += T[b, a] * normals[t[k], b]
        tangent_row(d, arm, n, jacobian[k])
        weight[k] = 1.0
        if residual == POINT:
            length[k] = np.sqrt(square)
        elif residual == PLANE:
            length[k], weight[k] = abs(offset[k]), trust[t[k]]
        else:
            for a in range(3):
                point[a] = gap[a] + target[t[k], a]
            length[k] = metric_of_pair(d, T, target[t[k]], point, normals[t[k]], source_normals[s[k]], plane_share,
                                       metrics[k], shifts[k])  # fmt: skip
            arms[k] = arm
            weight[k] = 0.0
            for a in range(d):
                for b in range(d):
                    weight[k] += n[a] * metrics[k, a, b] * n[b]
    known, total, squares = 0.0, 0.0, 0.0
    for k in range(count):
        total += weight[k]
        squares += weight[k] * length[k] ** 2 if residual != GENERALISED else length[k] ** 2
    rmse = np.sqrt(squares / max(count if residual == GENERALISED else total, 1e-300))
    scale = scale_given
    if scale <= 0 and loss != 0:
        middle = count // 2
        median = MEDIAN_1 if residual != POINT else (MEDIAN_2 if d == 2 else MEDIAN_3)
        scale = max(np.partition(length, middle)[middle] / median, floor)
    slope = 1.0
    if loss != 0:
        bent, total = 0.0, 0.0
        for k in range(count):
            bent += weight[k] * robust_slope(loss, length[k] / scale)
            robust = robust_weight(loss, length[k] / scale)
            weight[k] *= robust
            if whole > 0:
                metrics[k] *= robust
            total += weight[k]
        slope = max(bent / (total + 1e-300), 0.1)
    H = np.zeros((p, p))
    if whole > 0:
        full, whole_pull = np.zeros((6, 6)), np.zeros(6)
        for k in range(count):
            whole_pull[:] = 0.0
            add_pull(arms[k], metrics[k], shifts[k], 1.0, full, whole_pull)
            for a in range(p):
                pulls[k, a] = whole_pull[a] if d == 3 else whole_pull[(3, 4, 2)[a]]
        H, _ = of_dimension(d, full, whole_pull)
    else:
        for k in range(count):
            for a in range(p):
                for b in range(p):
                    H[a, b] += weight[k] * jacobian[k, a] * jacobian[k, b]
    values, vectors = np.linalg.eigh(H)
    free = 0
    while free < p and values[free] <= max(ratio * values[p - 1], 2.2250738585072014e-308):
        free += 1
    held = p - free
    scores = np.zeros((count, held))
    for k in range(count):
        for j in range(held):
            for a in range(p):
                scores[k, j] += weight[k] * jacobian[k, a] * vectors[a, free + j]
    if whole > 0:
        middle_part = raw_score_products(scores, pulls @ np.ascontiguousarray(vectors[:, free:]), t, neighbours,
                                         sigma_floor)  # fmt: skip
    elif residual == POINT:
        middle_part = point_score_products(scores, length, thickness, t, slope, sigma_floor)
    else:
        middle_part = score_products(d, scores, offset, length, gaps, thickness, anchors, target, normals, neighbours,
                                     t, slope, sigma_floor)  # fmt: skip
    freedom = share * count / max(count - held, 1)
    covariance = np.zeros((held, held))
    for i in range(held):
        for j in range(held):
            covariance[i, j] = freedom * middle_part[i, j] / (slope**2 * values[free + i] * values[free + j])
    information = np.zeros((p, p))
    lowest = 1.0 / free_sigma**2
    for j in range(free):
        for a in range(p):
            for b in range(p):
                information[a, b] += lowest * vectors[a, j] * vectors[b, j]
    if held > 0:
        held_values, held_vectors = np.linalg.eigh((covariance + covariance.T) / 2)
        for j in range(held):
            known = max(1.0 / max(held_values[j], 1e-300), lowest)
            axis = np.zeros(p)
            for i in range(held):
                for a in range(p):
                    axis[a] += vectors[a, free + i] * held_vectors[i, j]
            for a in range(p):
                for b in range(p):
                    information[a, b] += known * axis[a] * axis[b]
    return to_origin(d, information, centre, radius), free_at_origin(d, vectors, free, centre, radius), free, rmse


@kernel
def score_products(
    d: int, scores: FloatArray, offset: FloatArray, length: FloatArray, gaps: FloatArray, thickness: FloatArray,
    anchors: FloatArray, target: FloatArray, normals: FloatArray, neighbours: IntArray, t: IntArray,
    slope: float, sigma_floor: float,
) -> FloatArray:  # fmt: skip
    """Sum M (h, h) of the outer products of all points' scores, each times the deviation of its point.

    The line or plane at a target is the regression on its k neighbours: with their places u_j in it about the anchor,
    of covariance C, one of them moves the residual of a source point at u by (1 + u C^-1 u_j) / k times its own noise,
    which counts as far as the normals agree. Raw pairs hold the target's noise in their residuals already; those that
    share a target are summed first.
    """
    count, held = scores.shape
    k_all = neighbours.shape[1]
    leaning = np.zeros((len(target), held))
    M = np.zeros((held, held))
    inverse, gap = np.zeros((3, 3)), np.zeros(3)
    for k in range(count):
        sigma = max(length[k], sigma_floor)
        for a in range(held):
            for b in range(held):
                M[a, b] += scores[k, a] * scores[k, b] * sigma * sigma * k_all / (k_all + 1)
        sigma = slope * max(thickness[t[k]], sigma_floor)
        tangent_inverse(d, target, anchors[t[k]], normals[t[k]], neighbours[t[k]], inverse)
        for a in range(d):
            gap[a] = 0.0
            for b in range(d):
                gap[a] += inverse[a, b] * gaps[k, b]
        for j in neighbours[t[k]]:
            share, lever = 0.0, 1.0
            for a in range(d):
                share += normals[t[k], a] * normals[j, a]
                lever += gap[a] * (target[j, a] - anchors[t[k], a])
            share *= sigma * lever / k_all
            for a in range(held):
                leaning[j, a] += share * scores[k, a]
    shared = np.zeros((len(target), held))
    for k in range(count):
        for j in neighbours[t[k]]:
            for a in range(held):
                shared[j, a] += scores[k, a] * offset[k]
    near = np.zeros((held, held))
    for row in range(len(target)):
        for a in range(held):
            for b in range(held):
                M[a, b] += leaning[row, a] * leaning[row, b]
                near[a, b] += shared[row, a] * shared[row, b] / k_all
    return larger_of(M, near)


@kernel
def point_score_products(
    scores: FloatArray, length: FloatArray, thickness: FloatArray, t: IntArray, slope: float, sigma_floor: float
) -> FloatArray:
    """Sum M (h, h) for point-to-point: each pair by its whole length, and by its target's noise with all that share it.

    Tangential distances come from the sampling, not from noise, yet they are what moves point-to-point.
    """
    count, held = scores.shape
    leaning, M = np.zeros((len(thickness), held)), np.zeros((held, held))
    for k in range(count):
        sigma, noise = max(length[k], sigma_floor), slope * max(thickness[t[k]], sigma_floor)
        for a in range(held):
            leaning[t[k], a] += noise * scores[k, a]
            for b in range(held):
                M[a, b] += scores[k, a] * scores[k, b] * sigma * sigma
    for row in range(len(leaning)):
        for a in range(held):
            for b in range(held):
                M[a, b] += leaning[row, a] * leaning[row, b]
    return M


@kernel
def raw_score_products(
    scores: FloatArray, pulls: FloatArray, t: IntArray, neighbours: IntArray, sigma_floor: float
) -> FloatArray:
    """Sum M (h, h) for pairs of raw points: their pulls (m, h) hold the noise of both points already.

    Those that share a target are summed first. `scores` (m, h), the pull of a unit of distance, set the floor.
    """
    count, held = pulls.shape
    targets, k_all = neighbours.shape
    leaning, shared = np.zeros((targets, held)), np.zeros((targets, held))
    M, near = np.zeros((held, held)), np.zeros((held, held))
    for k in range(count):
        for a in range(held):
            leaning[t[k], a] += pulls[k, a]
            for b in range(held):
                M[a, b] += scores[k, a] * scores[k, b] * sigma_floor**2
        for j in neighbours[t[k]]:
            for a in range(held):
                shared[j, a] += pulls[k, a]
    for row in range(targets):
        for a in range(held):
            for b in range(held):
                M[a, b] += leaning[row, a] * leaning[row, b]
                near[a, b] += shared[row, a] * shared[row, b] / k_all
    return larger_of(M, near)


@kernel
def larger_of(M: FloatArray, other: FloatArray) -> FloatArray:
    """Matrix (h, h) that is M, but as large as `other` in the directions in which that is larger."""
    h = len(M)
    if h == 0:
        return M
    values, vectors = np.linalg.eigh(M)
    root, back = np.zeros((h, h)), np.zeros((h, h))
    for a in range(h):
        for b in range(h):
            size = np.sqrt(max(values[b], 1e-300))
            root[a, b], back[b, a] = vectors[a, b] * size, vectors[a, b] / size
    ratio = back @ other @ back.T
    ratios, axes = np.linalg.eigh((ratio + ratio.T) / 2)
    turned = root @ axes
    result = np.zeros((h, h))
    for j in range(h):
        for a in range(h):
            for b in range(h):
                result[a, b] += max(ratios[j], 1.0) * turned[a, j] * turned[b, j]
    return result


@kernel
def tangent_inverse(
    d: int, points: FloatArray, anchor: FloatArray, n: FloatArray, near: IntArray, inverse: FloatArray
) -> None:
    """Write the inverse (3, 3) of the covariance of the neighbours within their line or plane, zero across it.

    A tenth of its trace is added: a lever that a row of points hardly holds is not stretched without limit.
    """
    inverse[:] = 0.0
    first, second = np.zeros(3), np.zeros(3)
    if d == 2:
        first[0], first[1] = -n[1], n[0]
    else:
        least = 0
        for a in range(1, 3):
            if abs(n[a]) < abs(n[least]):
                least = a
        helper = np.zeros(3)
        helper[least] = 1.0
        first[0], first[1], first[2] = (
            n[1] * helper[2] - n[2] * helper[1], n[2] * helper[0] - n[0] * helper[2],
            n[0] * helper[1] - n[1] * helper[0],
        )  # fmt: skip
        first /= max(np.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2), 1e-300)
        second[0], second[1], second[2] = (
            n[1] * first[2] - n[2] * first[1], n[2] * first[0] - n[0] * first[2], n[0] * first[1] - n[1] * first[0],
        )  # fmt: skip
    xx, xy, yy = 0.0, 0.0, 0.0
    for j in near:
        x, y = 0.0, 0.0
        for a in range(d):
            x += (points[j, a] - anchor[a]) * first[a]
            y += (points[j, a] - anchor[a]) * second[a]
        xx += x * x / len(near)
        xy += x * y / len(near)
        yy += y * y / len(near)
    if d == 2:
        if xx > 0:
            for a in range(2):
                for b in range(2):
                    inverse[a, b] = first[a] * first[b] / xx
        return
    damping = 0.002 * (xx + yy)
    xx += damping
    yy += damping
    det = xx * yy - xy * xy
    if det > 0:
        for a in range(3):
            for b in range(3):
                inverse[a, b] = (
                    yy * first[a] * first[b] - xy * (first[a] * second[b] + second[a] * first[b])
                    + xx * second[a] * second[b]
                ) / det  # fmt: skip


@kernel
def frame_matrix(d: int, centre: FloatArray, radius: float, forward: bool) -> FloatArray:
    """Matrix (p, p) from tangents about `centre`, turns measured on `radius`, to those at the origin, or backwards.

    It is the adjoint of the shift to the centre: a turn w there is a turn w and a shift centre x w at the origin.
    """
    p = 3 * (d - 1)
    A = np.eye(p)
    sign, unit = (1.0, 1.0 / radius) if forward else (-1.0, radius)
    lever = unit if forward else 1.0
    if d == 2:
        A[2, 2] = unit
        A[0, 2], A[1, 2] = sign * centre[1] * lever, -sign * centre[0] * lever
        return A
    hat = np.array([[0.0, -centre[2], centre[1]], [centre[2], 0.0, -centre[0]], [-centre[1], centre[0], 0.0]])
    for a in range(3):
        A[a, a] = unit
        for b in range(3):
            A[3 + a, b] = sign * hat[a, b] * lever
    return A


@kernel
def to_origin(d: int, information: FloatArray, centre: FloatArray, radius: float) -> FloatArray:
    """Information (p, p) of the tangent at the source origin from that of the balanced frame."""
    back = frame_matrix(d, centre, radius, False)
    result = back.T @ information @ back
    return (result + result.T) / 2


@kernel
def free_at_origin(d: int, vectors: FloatArray, free: int, centre: FloatArray, radius: float) -> FloatArray:
    """Unit tangents (free, p) at the source origin of the first `free` eigenvectors (p, p)."""
    forward = frame_matrix(d, centre, radius, True)
    result = np.zeros((free, len(vectors)))
    for j in range(free):
        size = 0.0
        for a in range(len(vectors)):
            for b in range(len(vectors)):
                result[j, a] += forward[a, b] * vectors[b, j]
            size += result[j, a] ** 2
        result[j] /= np.sqrt(size)
    return result
