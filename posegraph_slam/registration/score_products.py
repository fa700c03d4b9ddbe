"""How far the scores of the pairs vary: noise of the source and target points, and what neighbours share."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import inline_kernel, kernel
from posegraph_slam.registration.small_matrices import TINY, symmetric_eigen

LEAST_WIDTH = 0.002
"""Share of the squared length of a neighbourhood in space that its width is taken to have at least.

A row of points hardly holds the turn of its plane about it: the lever across the row is not stretched without limit.
"""


@kernel
def score_products(
    d: int, scores: FloatArray, offset: FloatArray, weight: FloatArray, gaps: FloatArray, thickness: FloatArray,
    anchors: FloatArray, target: FloatArray, normals: FloatArray, neighbours: IntArray, t: IntArray, floor: float,
) -> FloatArray:  # fmt: skip
    """Sum M (h, h) of the outer products of all points' scores, each times the deviation of its point.

    `scores` (m, h) are weight times Jacobian in the held directions, `offset` (m,) the distances, `gaps` (m, 3) from
    anchor to source point. The source's part is that of White (1980), each pair with its own distance. A target point
    moves every pair that leans on it, by `levers_of_gap`; its noise follows the thickness of the fits, whose
    common scale is set by the weighted distances themselves: dense fits look thinner than the noise is. Where the
    distances of neighbours agree more than that explains, by a standard error (a variance of m / k independent sums is
    known to the share (2 k / m)^0.5), their joint scores count instead.
    """
    count, held = scores.shape
    k_all = neighbours.shape[1]
    leaning, shared = np.zeros((len(target), held)), np.zeros((len(target), held))
    M, fits, near = np.zeros((held, held)), np.zeros((held, held)), np.zeros((held, held))
    x, y = np.zeros(k_all), np.zeros(k_all)
    seen, expected = 0.0, 0.0
    for k in range(count):
        at = t[k]
        sigma, thick = max(abs(offset[k]), floor), max(thickness[at], floor)
        add_square(scores, k, sigma * sigma * k_all / (k_all + 1), M)
        gx, gy = levers_of_gap(d, gaps, k, target, anchors, normals, neighbours, at, x, y)
        squares = 0.0
        for j in range(k_all):
            row = neighbours[at, j]
            agree = 0.0
            for a in range(3):
                agree += normals[at, a] * normals[row, a]
            lever = agree * (1.0 + gx * x[j] + gy * y[j]) / k_all
            squares += lever * lever
            factor = lever * thick
            for a in range(held):
                leaning[row, a] += factor * scores[k, a]
                shared[row, a] += offset[k] * scores[k, a]
        seen += (weight[k] * sigma) ** 2
        expected += (weight[k] * thick) ** 2 * (1.0 + squares)
    for row in range(len(target)):
        add_square(leaning, row, seen / max(expected, TINY), fits)
        add_square(shared, row, 1.0 / k_all, near)
    for a in range(held):
        for b in range(a + 1):
            M[a, b] += fits[a, b]
            M[b, a], near[b, a] = M[a, b], near[a, b]
    return larger_of(M, near, 1.0 + np.sqrt(2.0 * k_all / max(count, 1)))


@inline_kernel
def add_square(rows: FloatArray, row: int, factor: float, M: FloatArray) -> None:
    """Add the lower half of the outer product of one of the rows (n, h), times a factor, to M (h, h)."""
    for a in range(len(M)):
        along = factor * rows[row, a]
        for b in range(a + 1):
            M[a, b] += along * rows[row, b]


@inline_kernel
def levers_of_gap(
    d: int, gaps: FloatArray, k: int, target: FloatArray, anchors: FloatArray, normals: FloatArray,
    neighbours: IntArray, at: int, x: FloatArray, y: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Write the places (k,) of a target's neighbours in its line or plane; C^-1 u of the pair's gap u.

    The line or plane is the regression on its k neighbours: with their places u_j about the anchor, of covariance C,
    one of them moves the distance of a source point at u by (1 + u C^-1 u_j) / k times its own noise, which counts as
    far as the normals agree.
    """
    n0, n1, n2 = normals[at, 0], normals[at, 1], normals[at, 2]
    e0, e1, e2, f0, f1, f2 = tangents(n0, n1, n2)
    k_all = neighbours.shape[1]
    a0, a1, a2 = anchors[at, 0], anchors[at, 1], anchors[at, d - 1] if d == 3 else 0.0
    xx, xy, yy = 0.0, 0.0, 0.0
    for j in range(k_all):
        row = neighbours[at, j]
        u, v, w = target[row, 0] - a0, target[row, 1] - a1, target[row, 2] - a2
        x[j], y[j] = u * e0 + v * e1 + w * e2, u * f0 + v * f1 + w * f2
        xx += x[j] * x[j]
        xy += x[j] * y[j]
        yy += y[j] * y[j]
    gx = gaps[k, 0] * e0 + gaps[k, 1] * e1 + gaps[k, 2] * e2
    gy = gaps[k, 0] * f0 + gaps[k, 1] * f1 + gaps[k, 2] * f2
    if d == 2:
        return (k_all * gx / xx if xx > 0 else 0.0), 0.0
    width = LEAST_WIDTH * (xx + yy)
    xx += width
    yy += width
    det = xx * yy - xy * xy
    if not det > 0:
        return 0.0, 0.0
    return k_all * (yy * gx - xy * gy) / det, k_all * (xx * gy - xy * gx) / det


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
    h = len(M)
    if h == 0:
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
