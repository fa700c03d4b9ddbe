"""The lines or planes that the points of a cloud lie on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, read_only
from posegraph_slam.jit import kernel
from posegraph_slam.registration.kd_tree import KdTree
from posegraph_slam.registration.small_matrices import TINY, least_axis_in_plane, least_axis_in_space

LINE_TOLERANCE = 1e-12
"""Share of the largest variance under which the next one is rounding: the points lie on one line."""

USUAL_THICKNESSES = 2.0
"""Thickness, in medians of the cloud, at which a fitted line or plane is trusted by half."""

THINNEST_M = 1e-6
"""Thickness under which differences are rounding: a variance of zero comes out as 1e-16 of the neighbourhood's."""

THICKEST_SHARE = 0.3
"""Median thickness of the neighbourhoods in the plane, over their length, from which on they are too short."""

SHARE_GAINED = 0.75
"""What is left of that median, at most, when neighbourhoods grow by half their length or more along a line."""

MOST_DOUBLINGS = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """Tangent lines (2D) or planes (3D) at the n points of a cloud, each fitted to `neighbours` (n, k), rows of points.

    `anchors` (n, d) lie on them, `normals` (n, d) are unit and signless, zero where not `oriented` (n,): fewer than d
    neighbours, or all on one spot (one line in 3D). `thickness_m` (n,) is the neighbours' standard deviation about
    the fit, and `trust` (n,) in [0, 1] falls with it: corners and edges of shadows are thick, walls are not.
    """

    anchors: FloatArray
    normals: FloatArray
    oriented: BoolArray
    thickness_m: FloatArray
    trust: FloatArray
    neighbours: IntArray

    def __post_init__(self) -> None:
        for name in ("anchors", "normals", "thickness_m", "trust"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "oriented", read_only(self.oriented, np.bool_))
        object.__setattr__(self, "neighbours", read_only(self.neighbours, np.int64))


def fit_surface(points: FloatArray, tree: KdTree, neighbours: int) -> Surface:
    """Fit a line (2D) or plane (3D) by principal axes to the `neighbours` nearest points (itself among them) of each.

    The anchor is the mean of the neighbours: a matcher that paired with raw points would pick, among points denser
    than their noise, those that err towards the source, and would be drawn to its own guess. Where a mean leaves a
    curved surface, the anchor is moved back to it. In the plane, neighbourhoods that are thick for their length
    (1081 beams with 3 cm noise) are doubled, up to four times.
    """
    n, d = points.shape
    count = min(neighbours, n)
    if n < d:
        none = np.zeros((n, 0), dtype=np.int64)
        return Surface(anchors=points, normals=np.zeros((n, d)), oriented=np.zeros(n, dtype=np.bool_),
                       thickness_m=np.zeros(n), trust=np.zeros(n), neighbours=none)  # fmt: skip
    index = tree.neighbours_of_all(count)
    fit = fit_neighbourhoods(points, index)
    for _ in range(MOST_DOUBLINGS if d == 2 else 0):
        if fit[5] <= THICKEST_SHARE or 2 * count > n:
            break
        wider = tree.neighbours_of_all(2 * count)
        other = fit_neighbourhoods(points, wider)
        if other[5] > SHARE_GAINED * fit[5]:
            break
        index, fit, count = wider, other, 2 * count
    anchors, normals, oriented, thickness, trust, _ = fit
    return Surface(anchors=anchors, normals=normals, oriented=oriented, thickness_m=thickness, trust=trust,
                   neighbours=index)  # fmt: skip


@kernel
def fit_neighbourhoods(
    points: FloatArray, neighbours: IntArray
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray, FloatArray, float]:
    """Anchors and normals (n, d), oriented, thickness and trust (n,) of the points named by rows (n, k).

    Last comes the median thickness of the neighbourhoods over their second longest side, in the plane their length.
    """
    n, k = neighbours.shape
    d = points.shape[1]
    anchors, normals, share = np.zeros((n, d)), np.zeros((n, d)), np.zeros(n)
    oriented, thickness, trust = np.zeros(n, dtype=np.bool_), np.zeros(n), np.zeros(n)
    some, shares, count = np.empty(n), np.empty(n), 0
    for row in range(n):
        least, second, largest = fit_principal_axes(points, neighbours, row, anchors, normals)
        oriented[row] = second > LINE_TOLERANCE * max(largest, TINY)
        # the fit spends d degrees of freedom on k points
        thickness[row] = np.sqrt(max(least, 0.0) * k / max(k - d, 1))
        if oriented[row]:
            share[row] = max(least, 0.0) / second
            some[count], shares[count] = thickness[row], share[row]
            count += 1
        else:
            for a in range(d):
                normals[row, a] = 0.0
    usual = np.median(some[:count]) if count > 0 else 0.0
    for row in range(n):
        if oriented[row]:
            # a neighbourhood as thick as it is long has no direction
            thick = thickness[row] / max(USUAL_THICKNESSES * usual, THINNEST_M)
            trust[row] = (1.0 - share[row]) / (1.0 + thick * thick)
    return_to_surface(points, neighbours, anchors, normals, trust)
    return anchors, normals, oriented, thickness, trust, np.sqrt(np.median(shares[:count])) if count > 0 else 0.0


@kernel
def fit_principal_axes(
    points: FloatArray, neighbours: IntArray, row: int, anchors: FloatArray, normals: FloatArray
) -> tuple[float, float, float]:
    """Write mean and least principal axis of one neighbourhood; its smallest, second and largest variance."""
    k, d = neighbours.shape[1], points.shape[1]
    first = neighbours[row, 0]  # coordinates are taken from it: no digits are lost far from the origin
    x0, y0, z0 = points[first, 0], points[first, 1], points[first, 2] if d == 3 else 0.0
    x, y, z, xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(k):
        at = neighbours[row, j]
        u, v = points[at, 0] - x0, points[at, 1] - y0
        x += u
        y += v
        xx += u * u
        xy += u * v
        yy += v * v
        if d == 3:
            w = points[at, 2] - z0
            z += w
            xz += u * w
            yz += v * w
            zz += w * w
    x, y, z = x / k, y / k, z / k
    xx, xy, yy = xx / k - x * x, xy / k - x * y, yy / k - y * y
    anchors[row, 0], anchors[row, 1] = x0 + x, y0 + y
    if d == 2:
        normals[row, 0], normals[row, 1], least, largest = least_axis_in_plane(xx, xy, yy)
        return least, largest, largest
    anchors[row, 2] = z0 + z
    xz, yz, zz = xz / k - x * z, yz / k - y * z, zz / k - z * z
    normals[row, 0], normals[row, 1], normals[row, 2], least, second, largest = least_axis_in_space(
        xx, xy, xz, yy, yz, zz)  # fmt: skip
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
    d = points.shape[1]
    offset, shift = np.zeros(n), np.zeros(n)
    for row in range(n):
        for a in range(d):
            offset[row] += normals[row, a] * (points[row, a] - anchors[row, a])
    for row in range(n):
        total, mean = 0.0, 0.0
        for j in range(k):
            at, along = neighbours[row, j], 0.0
            for a in range(d):
                along += normals[row, a] * normals[at, a]
            weight = trust[at] * (along * along) * (along * along)
            total += weight
            mean += weight * offset[at] * (1.0 if along > 0 else -1.0)
        shift[row] = mean / max(total, TINY)
    for row in range(n):
        for a in range(d):
            anchors[row, a] += shift[row] * normals[row, a]


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
