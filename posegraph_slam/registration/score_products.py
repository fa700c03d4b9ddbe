"""How far the scores of the pairs vary: noise of the source and target points, and what neighbours share."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import inline_kernel, kernel
from posegraph_slam.registration.small_matrices import TINY, cholesky_in_place, inverse_of_positive, symmetric_eigen

LEAST_WIDTH = 0.002
"""Share of the squared length of a neighbourhood in space that its width is taken to have at least.

A row of points hardly holds the turn of its plane about it: the lever across the row is not stretched without limit.
"""

TWICED_IN_PLANE = 5.0 / 3.0
"""Variance of an anchor on a line over that of the plain mean of its k neighbours.

Moving anchors back to the surface turns the mean S into 2 S - S S: for a box of width 1, of 4 - 4 x 3/4 + 2/3 times its
square. In space neighbourhoods are not so even, and no such excess is seen.
"""


@kernel
def score_products(
    d: int, scores: FloatArray, offset: FloatArray, weight: FloatArray, gaps: FloatArray, thickness: FloatArray,
    anchors: FloatArray, target: FloatArray, normals: FloatArray, neighbours: IntArray, t: IntArray, floor: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Sum M (p, p) of the outer products of all points' scores, each times the deviation of its point, and `near`.

    `scores` (m, p) are weight times Jacobian, `offset` (m,) the distances, `gaps` (m, 3) from anchor to source point.
    The source's part is that of White (1980), each pair with its own distance. A target point moves every pair that
    leans on it, by its lever; its noise follows the thickness of the fits, whose common scale is set by the
    weighted distances themselves: dense fits look thinner than the noise is. `near` (p, p) is what the distances of
    neighbours say together: where they agree more than M explains, by a standard error (a variance of m / k
    independent sums is known to the share (2 k / m)^0.5), their joint scores count instead.
    """
    count, p = scores.shape
    k_all = neighbours.shape[1]
    lever, variance, thick = np.empty((count, k_all)), np.empty(count), np.empty(count)
    if d == 2:
        levers_on_lines(gaps, target, anchors, normals, neighbours, t, lever)
    else:
        levers_on_planes(gaps, target, anchors, normals, neighbours, t, lever)
    seen, expected, twiced = 0.0, 0.0, TWICED_IN_PLANE if d == 2 else 1.0
    for k in range(count):
        sigma, squares = max(abs(offset[k]), floor), 1.0
        thick[k], variance[k] = max(thickness[t[k]], floor), sigma * sigma / (1.0 + twiced / k_all)
        for j in range(k_all):
            squares += twiced * lever[k, j] * lever[k, j]
        seen += (weight[k] * sigma) ** 2
        expected += (weight[k] * thick[k]) ** 2 * squares
    leaning, joint = np.zeros((len(target), p)), np.zeros((len(target), p))
    for a in range(0, p, 3):
        spread_scores(scores, a, offset, thick, lever, neighbours, t, leaning, joint)
    everyone = np.full(len(target), seen / max(expected, TINY))
    M = weighted_squares(scores, variance) + weighted_squares(leaning, everyone)
    everyone[:] = 1.0 / k_all
    return M, weighted_squares(joint, everyone)


@kernel
def spread_scores(
    scores: FloatArray, a: int, offset: FloatArray, thick: FloatArray, lever: FloatArray, neighbours: IntArray,
    t: IntArray, leaning: FloatArray, joint: FloatArray,
) -> None:  # fmt: skip
    """Add columns a to a + 2 of the pairs' scores to the target points (n, p) that each of them leans on.

    In threes, because a loop as short as p costs more to set up than to run.
    """
    k_all = neighbours.shape[1]
    for k in range(len(t)):
        x, y, z, at = scores[k, a], scores[k, a + 1], scores[k, a + 2], t[k]
        u, v, w = offset[k] * x, offset[k] * y, offset[k] * z
        for j in range(k_all):
            row, factor = neighbours[at, j], lever[k, j] * thick[k]
            leaning[row, a] += factor * x
            leaning[row, a + 1] += factor * y
            leaning[row, a + 2] += factor * z
            joint[row, a] += u
            joint[row, a + 1] += v
            joint[row, a + 2] += w


@kernel
def weighted_squares(rows: FloatArray, weight: FloatArray) -> FloatArray:
    """Sum (p, p) of the outer products of rows (n, p) times their weights, in blocks of three columns."""
    p = rows.shape[1]
    M = np.zeros((p, p))
    for a in range(0, p, 3):
        for b in range(0, a + 1, 3):
            xx, xy, xz, yx, yy, yz, zx, zy, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(len(rows)):
                x, y, z = weight[k] * rows[k, a], weight[k] * rows[k, a + 1], weight[k] * rows[k, a + 2]
                u, v, w = rows[k, b], rows[k, b + 1], rows[k, b + 2]
                xx, xy, xz = xx + x * u, xy + x * v, xz + x * w
                yx, yy, yz = yx + y * u, yy + y * v, yz + y * w
                zx, zy, zz = zx + z * u, zy + z * v, zz + z * w
            M[a, b], M[a, b + 1], M[a, b + 2] = xx, xy, xz
            M[a + 1, b], M[a + 1, b + 1], M[a + 1, b + 2] = yx, yy, yz
            M[a + 2, b], M[a + 2, b + 1], M[a + 2, b + 2] = zx, zy, zz
    for a in range(p):
        for b in range(a):
            M[b, a] = M[a, b]
    return M


@kernel
def levers_on_lines(
    gaps: FloatArray, target: FloatArray, anchors: FloatArray, normals: FloatArray, neighbours: IntArray, t: IntArray,
    lever: FloatArray,
) -> None:  # fmt: skip
    """Write how far the neighbours of its target move the distance of a pair: (m, k).

    The line is the regression on its k neighbours: with their places u_j about the anchor, of covariance C, one of
    them moves the distance of a source point at u by (1 + u C^-1 u_j) / k times its own noise, which counts as far as
    the normals agree.
    """
    k_all = neighbours.shape[1]
    x, share = np.empty(k_all), 1.0 / k_all
    for k in range(len(t)):
        at = t[k]
        n0, n1, a0, a1, xx = normals[at, 0], normals[at, 1], anchors[at, 0], anchors[at, 1], 0.0
        for j in range(k_all):
            row = neighbours[at, j]
            along = n0 * (target[row, 1] - a1) - n1 * (target[row, 0] - a0)
            x[j], lever[k, j] = along, share * (n0 * normals[row, 0] + n1 * normals[row, 1])
            xx += along * along
        slope = k_all * (n0 * gaps[k, 1] - n1 * gaps[k, 0]) / xx if xx > 0 else 0.0
        for j in range(k_all):
            lever[k, j] *= 1.0 + slope * x[j]


@kernel
def levers_on_planes(
    gaps: FloatArray, target: FloatArray, anchors: FloatArray, normals: FloatArray, neighbours: IntArray, t: IntArray,
    lever: FloatArray,
) -> None:  # fmt: skip
    """Do on planes what `levers_on_lines` does on lines."""
    k_all = neighbours.shape[1]
    x, y, share = np.empty(k_all), np.empty(k_all), 1.0 / k_all
    for k in range(len(t)):
        at, xx, xy, yy = t[k], 0.0, 0.0, 0.0
        n0, n1, n2 = normals[at, 0], normals[at, 1], normals[at, 2]
        a0, a1, a2 = anchors[at, 0], anchors[at, 1], anchors[at, 2]
        e0, e1, e2, f0, f1, f2 = tangents(n0, n1, n2)
        for j in range(k_all):
            row = neighbours[at, j]
            u, v, w = target[row, 0] - a0, target[row, 1] - a1, target[row, 2] - a2
            p, q = u * e0 + v * e1 + w * e2, u * f0 + v * f1 + w * f2
            x[j], y[j] = p, q
            lever[k, j] = share * (n0 * normals[row, 0] + n1 * normals[row, 1] + n2 * normals[row, 2])
            xx, xy, yy = xx + p * p, xy + p * q, yy + q * q
        gx = gaps[k, 0] * e0 + gaps[k, 1] * e1 + gaps[k, 2] * e2
        gy = gaps[k, 0] * f0 + gaps[k, 1] * f1 + gaps[k, 2] * f2
        width = LEAST_WIDTH * (xx + yy)
        xx, yy = xx + width, yy + width
        det = xx * yy - xy * xy
        inverse = k_all / det if det > 0 else 0.0
        gx, gy = inverse * (yy * gx - xy * gy), inverse * (xx * gy - xy * gx)
        for j in range(k_all):
            lever[k, j] *= 1.0 + gx * x[j] + gy * y[j]


@inline_kernel
def tangents(n0: float, n1: float, n2: float) -> tuple[float, float, float, float, float, float]:
    """Two unit vectors across the unit normal (n0, n1, n2); in the plane, n2 = 0, the first one lies in it."""
    if abs(n2) < 0.8:
        size = max(np.sqrt(n0 * n0 + n1 * n1), TINY)
        e0, e1, e2 = -n1 / size, n0 / size, 0.0
    else:
        size = np.sqrt(n1 * n1 + n2 * n2)
        e0, e1, e2 = 0.0, -n2 / size, n1 / size
    return e0, e1, e2, n1 * e2 - n2 * e1, n2 * e0 - n0 * e2, n0 * e1 - n1 * e0


@kernel
def larger_of(M: FloatArray, other: FloatArray, least_ratio: float) -> FloatArray:
    """Matrix (h, h) that is M, but as large as `other` where that is more than `least_ratio` times as large."""
    h, rest = len(M), least_ratio * M - other
    if cholesky_in_place(rest):
        return M
    values, vectors = symmetric_eigen(M)
    root, back = np.zeros((h, h)), np.zeros((h, h))
    for a in range(h):
        for b in range(h):
            size = np.sqrt(max(values[b], 1e-300))
            root[a, b], back[b, a] = vectors[a, b] * size, vectors[a, b] / size
    ratio = back @ other @ back.T
    ratios, axes = symmetric_eigen((ratio + ratio.T) / 2)
    turned = root @ axes
    result = np.zeros((h, h))
    for j in range(h):
        factor = ratios[j] if ratios[j] > least_ratio else 1.0
        for a in range(h):
            for b in range(h):
                result[a, b] += factor * turned[a, j] * turned[b, j]
    return result


@kernel
def at_least_along(covariance: FloatArray, pull: FloatArray) -> FloatArray:
    """Positive matrix (h, h) that is `covariance`, or larger along a vector (h,) so that it holds its outer square."""
    inverse, exists = inverse_of_positive(covariance)
    size = 0.0
    for a in range(len(pull)):
        for b in range(len(pull)):
            size += pull[a] * inverse[a, b] * pull[b]
    if not exists or size <= 1.0:
        return covariance
    result = covariance.copy()
    for a in range(len(pull)):
        for b in range(len(pull)):
            result[a, b] += (1.0 - 1.0 / size) * pull[a] * pull[b]
    return result
