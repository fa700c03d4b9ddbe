"""How far the scores of the pairs vary: noise of the source and target points, and what neighbours share."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import inline_kernel, kernel
from posegraph_slam.registration.small_matrices import (
    TINY,
    cholesky_in_place,
    congruent,
    inverse_of_positive,
    symmetric_eigen,
)

TWICED_IN_PLANE = 5.0 / 3.0
"""Variance of an anchor on a line over that of the plain mean of its k neighbours.

Moving anchors back to the surface turns the mean S into 2 S - S S: for a box of width 1, of 4 - 4 x 3/4 + 2/3 times its
square. In space neighbourhoods are not so even, and no such excess is seen.
"""


@kernel
def score_products(
    d: int, scores: FloatArray, offset: FloatArray, weight: FloatArray, lever: FloatArray, thickness: FloatArray,
    target: FloatArray, neighbours: IntArray, t: IntArray, floor: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Covariances (p, p) of the sum of scores: by the source points, by the target points, and `near`.

    `scores` (m, p) are weight times Jacobian, `offset` (m,) the distances, `lever` (m, k) from `levers_of`.
    The source's part is that of White (1980), each pair with its own distance. A target point moves every pair that
    leans on it, by its lever; its noise follows the thickness of the fits, whose common scale is set by the
    weighted distances themselves: dense fits look thinner than the noise is. `near` is what the distances of
    neighbours say together. A variance of m / k independent sums is known to the share (2 k / m)^0.5. Last come the
    variances (m,) of the source points.
    """
    count, p = scores.shape
    k_all = neighbours.shape[1]
    variance, thick = np.empty(count), np.empty(count)
    seen, expected, twiced = 0.0, 0.0, TWICED_IN_PLANE if d == 2 else 1.0
    own = share_of_source(d, k_all)
    for k in range(count):
        sigma, squares = max(abs(offset[k]), floor), 1.0
        thick[k], variance[k] = max(thickness[t[k]], floor), sigma * sigma * own
        for j in range(k_all):
            squares += twiced * lever[k, j] * lever[k, j]
        seen += (weight[k] * sigma) ** 2
        expected += (weight[k] * thick[k]) ** 2 * squares
    leaning, joint = np.zeros((len(target), p)), np.zeros((len(target), p))
    for a in range(0, p, 3):
        spread_scores(scores, a, offset, thick, lever, neighbours, t, leaning, joint)
    everyone = np.full(len(target), seen / max(expected, TINY))
    targets = weighted_squares(leaning, everyone)
    everyone[:] = 1.0 / k_all
    return weighted_squares(scores, variance), targets, weighted_squares(joint, everyone), variance


@inline_kernel
def share_of_source(d: int, k_all: int) -> float:
    """Variance of a source point over that of its distance to a line or plane through k points as noisy as it is."""
    return 1.0 / (1.0 + (TWICED_IN_PLANE if d == 2 else 1.0) / k_all)


@kernel
def fitted_away(
    d: int, jacobian: FloatArray, scores: FloatArray, weight: FloatArray, variance: FloatArray, M: FloatArray,
    inverse: FloatArray, k_all: int,
) -> tuple[FloatArray, float]:  # fmt: skip
    """What the source's part (p, p) of the scores' covariance M lacks, and the factor by which the target's part grows.

    At the estimate distances are smaller than at the truth, by as much as it follows them: the square of each lacks
    j C j^T, for its row j of the Jacobian and C = D^-1 M D^-1 with `inverse` D^-1 (the leverage of MacKinnon and White
    1985, by C itself because neighbours share the noise of their targets).
    """
    count, p = jacobian.shape
    C, lacking = congruent(M, inverse, 0) * share_of_source(d, k_all), np.zeros(count)
    for a in range(0, p, 3):
        for b in range(0, p, 3):
            xx, xy, xz = C[a, b], C[a, b + 1], C[a, b + 2]
            yx, yy, yz = C[a + 1, b], C[a + 1, b + 1], C[a + 1, b + 2]
            zx, zy, zz = C[a + 2, b], C[a + 2, b + 1], C[a + 2, b + 2]
            for k in range(count):
                x, y, z = jacobian[k, b], jacobian[k, b + 1], jacobian[k, b + 2]
                u, v, w = jacobian[k, a], jacobian[k, a + 1], jacobian[k, a + 2]
                lacking[k] += u * (xx * x + xy * y + xz * z) + v * (yx * x + yy * y + yz * z)
                lacking[k] += w * (zx * x + zy * y + zz * z)
    lost, seen = 0.0, 0.0
    for k in range(count):
        square = weight[k] * weight[k]
        lost += square * lacking[k]
        seen += square * variance[k]
    return weighted_squares(scores, lacking), 1.0 + lost / max(seen, TINY)


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
            row, factor = np.uint64(neighbours[at, j]), lever[k, j] * thick[k]  # unsigned: no index counts from the end
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
def with_gap(covariance: FloatArray, gap: FloatArray) -> FloatArray:
    """Second moment (h, h) of the error of an estimate that lies a gap g (h,) beside one of covariance C.

    If no estimate were better than the latter, the gap would be independent of its error (Hausman 1978), and the
    second moment C + g g^T. But errors of the latter may not be shared: up to the smaller one of C and g g^T, and twice
    as much goes off the moment. With half of that it is the larger one of C and g g^T. Neither is known so well, from
    one gap, that it could be told which is smaller where they are alike: with q = g^T C^-1 g and the smooth
    q / (1 + q^2)^0.5 instead of min(1, q) it is C + (1 - (1 + q^2)^-0.5) g g^T.
    """
    inverse, exists = inverse_of_positive(covariance)
    q, result = 0.0, covariance.copy()
    for a in range(len(gap)):
        for b in range(len(gap)):
            q += gap[a] * inverse[a, b] * gap[b]
    if exists:
        for a in range(len(gap)):
            for b in range(len(gap)):
                result[a, b] += (1.0 - 1.0 / np.sqrt(1.0 + q * q)) * gap[a] * gap[b]
    return result
