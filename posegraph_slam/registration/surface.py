"""The lines or planes that the points of a cloud lie on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, frozen
from posegraph_slam.jit import inline_kernel, kernel
from posegraph_slam.registration.kd_search import neighbours_of_all
from posegraph_slam.registration.kd_tree import KdTree
from posegraph_slam.registration.selection import middle_of
from posegraph_slam.registration.small_matrices import TINY, least_axis_in_plane, least_axis_in_space

LINE_TOLERANCE = 1e-12
"""Share of the largest variance under which the next one is rounding: the points lie on one line."""

USUAL_THICKNESSES = 2.0
"""Thickness, in medians of the cloud, at which a fitted line or plane is trusted by half."""

THINNEST_M = 1e-6
"""Thickness under which differences are rounding: a variance of zero comes out as 1e-16 of the neighbourhood's."""

THICKEST_SHARE = 0.3
"""Median thickness of the neighbourhoods in the plane, over their length, from which on they are too short."""

LONGEST_SHARE = 3.0
"""Median length of the neighbourhoods in space, over their width, from which on they are rows of one scan line.

Real scans in space have 1.3 to 1.8 where they are thinned, and 11 where they are not: 69 000 points of 64 lines.
"""

SHARE_GAINED = 0.75
"""What is left of that median, at most, when neighbourhoods grow by half their length or more along a line."""

MOST_DOUBLINGS = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """Tangent lines (2D) or planes (3D) at the n points of a cloud, each fitted to `neighbours` (n, k), rows of points.

    `anchors` (n, d) lie on them, `normals` (n, d) are unit and signless, zero where not `oriented` (n,): fewer than d
    neighbours, or all on one spot (one line in 3D). `normals_in_space` (n, 3) have a zero as third in the plane.
    `thickness_m` (n,) is the neighbours' standard deviation about the fit, and `trust` (n,) in [0, 1] falls with it:
    corners and edges of shadows are thick, walls are not.
    """

    anchors: FloatArray
    normals: FloatArray
    normals_in_space: FloatArray
    oriented: BoolArray
    thickness_m: FloatArray
    trust: FloatArray
    neighbours: IntArray


def fit_surface(points: FloatArray, tree: KdTree, neighbours: int) -> Surface:
    """Fit a line (2D) or plane (3D) by principal axes to the `neighbours` nearest points (itself among them) of each.

    The anchor is the mean of the neighbours: a matcher that paired with raw points would pick, among points denser
    than their noise, those that err towards the source, and would be drawn to its own guess. Where a mean leaves a
    curved surface, the anchor is moved back to it. Neighbourhoods that are thick for their length in the plane (1081
    beams with 3 cm noise), or rows of a scan line in space, whose planes turn about them at will, are doubled, up to
    four times.
    """
    n, d = points.shape
    count = min(neighbours, n) if n >= d else 0
    anchors, normals, spread, oriented, thickness, trust, index = fit_all(
        points, tree.rows, tree.sorted_points, tree.axis, tree.value, count)  # fmt: skip
    return Surface(anchors=frozen(anchors), normals=frozen(normals), normals_in_space=frozen(spread),
                   oriented=frozen(oriented), thickness_m=frozen(thickness), trust=frozen(trust),
                   neighbours=frozen(index))  # fmt: skip


def shape_of_neighbourhoods(points: FloatArray, tree: KdTree, neighbours: int) -> tuple[float, float]:
    """Median length over width of the `neighbours` nearest points of all points (n, 3), and median of their reach.

    Points that are spread evenly over a surface have a length of 1.5 times the width.
    """
    index = neighbours_of_all(tree.rows, tree.sorted_points, tree.axis, tree.value, min(neighbours, len(points)))
    reach = np.linalg.norm(points[index[:, -1]] - points, axis=1)
    return float(fit_neighbourhoods(points, index)[5]), float(np.median(reach))


@kernel
def fit_all(
    points: FloatArray, rows: IntArray, leaves: FloatArray, axis: IntArray, value: FloatArray, count: int
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, FloatArray, FloatArray, IntArray]:
    """Fit `count` neighbours at every point, or up to four times as many; the fields of a `Surface`."""
    n, d = points.shape
    limit = THICKEST_SHARE if d == 2 else LONGEST_SHARE
    index = neighbours_of_all(rows, leaves, axis, value, count)
    anchors, normals, oriented, thickness, trust, share = fit_neighbourhoods(points, index)
    for _ in range(MOST_DOUBLINGS):
        if share <= limit or 2 * count > n:
            break
        wider = neighbours_of_all(rows, leaves, axis, value, 2 * count)
        other = fit_neighbourhoods(points, wider)
        if other[5] > SHARE_GAINED * share:
            break
        anchors, normals, oriented, thickness, trust, share = other
        index, count = wider, 2 * count
    spread = np.zeros((n, 3))
    for row in range(n):
        for a in range(d):
            spread[row, a] = normals[row, a]
    return anchors, normals, spread, oriented, thickness, trust, index


@kernel
def fit_neighbourhoods(
    points: FloatArray, neighbours: IntArray
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray, FloatArray, float]:
    """Anchors and normals (n, d), oriented, thickness and trust (n,) of points fitted to those named by rows (n, k).

    Last comes the median thickness of the neighbourhoods over their length in the plane, of length over width in space.
    """
    n, k = neighbours.shape
    d = points.shape[1]
    anchors, normals, share = points.copy(), np.zeros((n, d)), np.zeros(n)
    oriented, thickness, trust = np.zeros(n, dtype=np.bool_), np.zeros(n), np.zeros(n)
    if k == 0:
        return anchors, normals, oriented, thickness, trust, 0.0
    some, shares, count, space = np.empty(n), np.empty(n), 0, d == 3
    for row in range(n):
        least, second, largest = fit_principal_axes(points, neighbours, row, anchors, normals)
        oriented[row] = second > LINE_TOLERANCE * max(largest, TINY)
        # the fit spends d degrees of freedom on k points
        thickness[row] = np.sqrt(max(least, 0.0) * k / max(k - d, 1))
        if oriented[row]:
            share[row] = max(least, 0.0) / second
            some[count], shares[count] = thickness[row], largest / second if space else share[row]
            count += 1
        else:
            for a in range(d):
                normals[row, a] = 0.0
    usual = middle_of(some, count) if count > 0 else 0.0
    for row in range(n):
        if oriented[row]:
            # a neighbourhood as thick as it is long has no direction
            thick = thickness[row] / max(USUAL_THICKNESSES * usual, THINNEST_M)
            trust[row] = (1.0 - share[row]) / (1.0 + thick * thick)
    return_to_surface(points, neighbours, anchors, normals, trust)
    return anchors, normals, oriented, thickness, trust, np.sqrt(middle_of(shares, count)) if count > 0 else 0.0


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
def return_to_surface(
    points: FloatArray, neighbours: IntArray, anchors: FloatArray, normals: FloatArray, trust: FloatArray
) -> None:
    """Shift the anchors along their normals by the mean offset of the neighbours from their own lines or planes.

    The mean of a neighbourhood lies on the hollow side of a curved surface, and all its points beyond their own
    means: smoothing these offsets and adding them back is Tukey's twicing (Stuetzle and Mittal 1979). Neighbours
    count as far as they are trusted and their normals agree: a corner must not be rounded the other way.
    """
    n, k = neighbours.shape
    space = points.shape[1] == 3
    offset, shift = np.empty(n), np.empty(n)
    for row in range(n):
        offset[row] = normals[row, 0] * (points[row, 0] - anchors[row, 0])
        offset[row] += normals[row, 1] * (points[row, 1] - anchors[row, 1])
        if space:
            offset[row] += normals[row, 2] * (points[row, 2] - anchors[row, 2])
    for row in range(n):
        x, y, z = normals[row, 0], normals[row, 1], normals[row, 2] if space else 0.0
        total, mean = 0.0, 0.0
        for j in range(k):
            at = neighbours[row, j]
            along = x * normals[at, 0] + y * normals[at, 1]
            if space:
                along += z * normals[at, 2]
            weight = trust[at] * (along * along) * (along * along)
            total += weight
            mean += weight * (offset[at] if along > 0 else -offset[at])
        shift[row] = mean / max(total, TINY)
    for row in range(n):
        anchors[row, 0] += shift[row] * normals[row, 0]
        anchors[row, 1] += shift[row] * normals[row, 1]
        if space:
            anchors[row, 2] += shift[row] * normals[row, 2]


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
