"""How far the points of a neighbourhood move the distance to the line or plane that is fitted to them."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import inline_kernel, kernel
from posegraph_slam.registration.small_matrices import TINY

LEAST_WIDTH = 0.002
"""Share of the squared length of a neighbourhood in space that its width is taken to have at least.

A row of points hardly holds the turn of its plane about it: the lever across the row is not stretched without limit.
"""


@kernel
def levers_of(
    d: int, gaps: FloatArray, target: FloatArray, anchors: FloatArray, normals: FloatArray, neighbours: IntArray,
    t: IntArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """How far the neighbours of its target move the distance of a pair (m, k), and their mean square along (m,).

    `gaps` (m, 3) lead from anchor to source point.
    """
    lever, size = np.empty((len(t), neighbours.shape[1])), np.empty(len(t))
    if d == 2:
        levers_on_lines(gaps, target, anchors, normals, neighbours, t, lever, size)
    else:
        levers_on_planes(gaps, target, anchors, normals, neighbours, t, lever, size)
    return lever, size


@kernel
def levers_on_lines(
    gaps: FloatArray, target: FloatArray, anchors: FloatArray, normals: FloatArray, neighbours: IntArray, t: IntArray,
    lever: FloatArray, size: FloatArray,
) -> None:  # fmt: skip
    """Write how far the neighbours of its target move the distance of a pair (m, k), and their mean square along (m,).

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
        size[k] = share * xx
        slope = k_all * (n0 * gaps[k, 1] - n1 * gaps[k, 0]) / xx if xx > 0 else 0.0
        for j in range(k_all):
            lever[k, j] *= 1.0 + slope * x[j]


@kernel
def levers_on_planes(
    gaps: FloatArray, target: FloatArray, anchors: FloatArray, normals: FloatArray, neighbours: IntArray, t: IntArray,
    lever: FloatArray, size: FloatArray,
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
        size[k] = share * (xx + yy)
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
