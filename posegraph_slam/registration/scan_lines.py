"""Scans in space are dense along their lines and sparse across: neighbourhoods and parts of a cloud that are even."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.geometry import inverse_pose, transform_points
from posegraph_slam.jit import kernel
from posegraph_slam.registration.kd_tree import build_kd_tree
from posegraph_slam.registration.principal_axes import axes_of_all
from posegraph_slam.registration.rotation_grid import principal_frame
from posegraph_slam.registration.voxel_hash import AXIS_BITS, voxel_keys

LONGEST_SHARE = 3.0
"""Length of a neighbourhood over its width from which on it is a row of one line; evenly spread points have 1.5."""

MOST_LEVELS = 10
"""Times that the spacing of the points is doubled from which a neighbourhood is taken."""


def widen_rows(
    points: FloatArray, nearest: IntArray, means: FloatArray, normals: FloatArray, variances: FloatArray
) -> IntArray:
    """Return neighbourhoods (n, k) of points (n, 3) that are `nearest` (n, k), or wider ones where these are rows.

    Noise lies along the rays, so that a row on the floor spans a thin plane with its rays, the cone of its own line,
    whatever the floor: two scans of few lines would match these cones, wherever the scanner has gone to. Rows take
    their neighbours from a part of the cloud with one point a voxel, whose side doubles until they are rows no more.
    The grid stands in the principal frame of the cloud, and so turns with it. Means, normals and variances of the rows,
    from `axes_of_all`, are written.
    """
    rows = np.flatnonzero(variances[:, 2] > LONGEST_SHARE**2 * variances[:, 1])
    if len(rows) == 0:
        return nearest
    support, k = nearest.copy(), nearest.shape[1]
    voxel_m = float(np.median(np.linalg.norm(points[nearest[rows, -1]] - points[rows], axis=1)))
    framed = transform_points(inverse_pose(principal_frame(points)), points)
    extent = float(np.ptp(framed, axis=0).max())
    part = np.arange(len(points))
    for _ in range(MOST_LEVELS):
        if not extent < voxel_m * (2**AXIS_BITS - 1):
            break
        part = part[one_a_voxel(framed[part], voxel_m)]
        if len(rows) == 0 or len(part) < k:
            break
        found = part[build_kd_tree(points[part]).neighbours(points[rows], k)]
        middle, across, spread = axes_of_all(points, found)
        wide = spread[:, 2] <= LONGEST_SHARE**2 * spread[:, 1]
        settled = rows[wide]
        support[settled], means[settled], normals[settled] = found[wide], middle[wide], across[wide]
        variances[settled] = spread[wide]
        rows, voxel_m = rows[~wide], 2.0 * voxel_m
    return support


def one_a_voxel(points: FloatArray, voxel_m: float) -> IntArray:
    """Return the rows (m,) of the points (n, 3) nearest to the mean of each voxel of a grid, ordered by voxel."""
    keys = voxel_keys(points, points.min(axis=0), voxel_m)
    return nearest_to_means(points, keys, np.argsort(keys, kind="stable"))


@kernel
def nearest_to_means(points: FloatArray, keys: IntArray, order: IntArray) -> IntArray:
    """Rows (m,) of the points (n, 3) nearest to the mean of all with their key, the first of equals, in their order."""
    count, start, n = 0, 0, len(order)
    rows = np.empty(n, dtype=np.int64)
    while start < n:
        stop, x, y, z = start, 0.0, 0.0, 0.0
        while stop < n and keys[order[stop]] == keys[order[start]]:
            at = order[stop]
            x, y, z, stop = x + points[at, 0], y + points[at, 1], z + points[at, 2], stop + 1
        share, least = 1.0 / (stop - start), np.inf
        for k in range(start, stop):
            at = order[k]
            u, v, w = points[at, 0] - x * share, points[at, 1] - y * share, points[at, 2] - z * share
            square = u * u + v * v + w * w
            if square < least:
                least, rows[count] = square, at
        count, start = count + 1, stop
    return rows[:count]
