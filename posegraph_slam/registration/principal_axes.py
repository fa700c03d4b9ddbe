"""Principal axes of neighbourhoods: the line or plane that each lies on, and how long, wide and thick it is."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import inline_kernel, kernel
from posegraph_slam.registration.small_matrices import least_axis_in_plane, least_axis_in_space

LINE_TOLERANCE = 1e-12
"""Share of the largest variance under which the next one is rounding: the points lie on one line."""


@kernel
def axes_of_all(points: FloatArray, neighbours: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means and normals (m, d) of neighbourhoods (m, k), rows of the points (n, d), and their variances (m, 3).

    The variances are the least, the second and the largest; in the plane the second is the largest. Everything is zero
    where neighbourhoods are empty (k = 0).
    """
    count, d = len(neighbours), points.shape[1]
    means, normals, variances = np.zeros((count, d)), np.zeros((count, d)), np.zeros((count, 3))
    if neighbours.shape[1] == 0:
        return means, normals, variances
    for row in range(count):
        least, second, largest = fit_principal_axes(points, neighbours, row, means, normals)
        variances[row, 0], variances[row, 1], variances[row, 2] = max(least, 0.0), second, largest
    return means, normals, variances


@inline_kernel
def fit_principal_axes(
    points: FloatArray, neighbours: IntArray, row: int, anchors: FloatArray, normals: FloatArray
) -> tuple[float, float, float]:
    """Write mean and least principal axis of one neighbourhood; its smallest, second and largest variance."""
    k, d = neighbours.shape[1], points.shape[1]
    first, share = neighbours[row, 0], 1.0 / k  # coordinates are taken from it: no digits are lost far from the origin
    x0, y0, z0 = points[first, 0], points[first, 1], points[first, 2] if d == 3 else 0.0
    x, y, z, xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if d == 2:
        for j in range(1, k):
            at = neighbours[row, j]
            u, v = points[at, 0] - x0, points[at, 1] - y0
            x, y = x + u, y + v
            xx, xy, yy = xx + u * u, xy + u * v, yy + v * v
        x, y = x * share, y * share
        anchors[row, 0], anchors[row, 1] = x0 + x, y0 + y
        normals[row, 0], normals[row, 1], least, largest = least_axis_in_plane(
            xx * share - x * x, xy * share - x * y, yy * share - y * y)  # fmt: skip
        second = largest
    else:
        for j in range(1, k):
            at = neighbours[row, j]
            u, v, w = points[at, 0] - x0, points[at, 1] - y0, points[at, 2] - z0
            x, y, z = x + u, y + v, z + w
            xx, xy, xz = xx + u * u, xy + u * v, xz + u * w
            yy, yz, zz = yy + v * v, yz + v * w, zz + w * w
        x, y, z = x * share, y * share, z * share
        anchors[row, 0], anchors[row, 1], anchors[row, 2] = x0 + x, y0 + y, z0 + z
        normals[row, 0], normals[row, 1], normals[row, 2], least, second, largest = least_axis_in_space(
            xx * share - x * x, xy * share - x * y, xz * share - x * z, yy * share - y * y, yz * share - y * z,
            zz * share - z * z)  # fmt: skip
    return least, second, largest


@kernel
def spans_plane(points: FloatArray) -> bool:
    """Whether finite points (n, 2) or (n, 3) vary along two directions at least."""
    n, d = points.shape
    if n < 3:
        return False
    x, y, z = 0.0, 0.0, 0.0
    for row in range(n):
        x += points[row, 0] / n
        y += points[row, 1] / n
        z += points[row, 2] / n if d == 3 else 0.0
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(n):
        u, v, w = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z if d == 3 else 0.0
        xx += u * u
        xy += u * v
        xz += u * w
        yy += v * v
        yz += v * w
        zz += w * w
    if d == 2:
        _, _, second, largest = least_axis_in_plane(xx, xy, yy)
    else:
        _, _, _, _, second, largest = least_axis_in_space(xx, xy, xz, yy, yz, zz)
    return bool(second > LINE_TOLERANCE * largest)
