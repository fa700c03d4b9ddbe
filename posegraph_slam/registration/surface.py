"""The lines or planes that the points of a cloud lie on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, frozen
from posegraph_slam.jit import kernel
from posegraph_slam.registration.kd_search import neighbours_of_all
from posegraph_slam.registration.kd_tree import KdTree
from posegraph_slam.registration.principal_axes import LINE_TOLERANCE, axes_of_all
from posegraph_slam.registration.scan_lines import LONGEST_SHARE, widen_rows
from posegraph_slam.registration.selection import middle_of
from posegraph_slam.registration.small_matrices import TINY

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
    neighbours, or all on one spot (one line in 3D). `normals_in_space` (n, 3) have a zero as third in the plane.
    `thickness_m` (n,) is the neighbours' standard deviation about the fit, and `trust` (n,) in [0, 1] falls with it:
    corners and edges of shadows are thick, walls are not. `nearest` (n, k) are the rows of the nearest points; they are
    the neighbours but where these would lie on one line of a scan in space.
    """

    anchors: FloatArray
    normals: FloatArray
    normals_in_space: FloatArray
    oriented: BoolArray
    thickness_m: FloatArray
    trust: FloatArray
    neighbours: IntArray
    nearest: IntArray


def fit_surface(points: FloatArray, tree: KdTree, neighbours: int) -> Surface:
    """Fit a line (2D) or plane (3D) by principal axes to the `neighbours` nearest points (itself among them) of each.

    The anchor is the mean of the neighbours: a matcher that paired with raw points would pick, among points denser
    than their noise, those that err towards the source, and would be drawn to its own guess. Where a mean leaves a
    curved surface, the anchor is moved back to it. In the plane, neighbourhoods that are thick for their length
    (1081 beams with 3 cm noise) are doubled, up to four times. In space, those that lie on one line of a scan are
    taken from farther around (`widen_rows`). A cloud of fewer than d points has no neighbourhoods and no normals.
    """
    n, d = points.shape
    count = min(neighbours, n) if n >= d else 0
    if d == 2:
        anchors, normals, spread, oriented, thickness, trust, index = fit_in_plane(
            points, tree.rows, tree.sorted_points, tree.axis, tree.value, count)  # fmt: skip
        return Surface(anchors=frozen(anchors), normals=frozen(normals), normals_in_space=frozen(spread),
                       oriented=frozen(oriented), thickness_m=frozen(thickness), trust=frozen(trust),
                       neighbours=frozen(index), nearest=frozen(index))  # fmt: skip
    index = tree.neighbours_of_all(count)
    anchors, normals, variances = axes_of_all(points, index)
    support = widen_rows(points, index, anchors, normals, variances)
    oriented, thickness, trust, _ = judge_fits(points, support, anchors, normals, variances)
    return Surface(anchors=frozen(anchors), normals=frozen(normals), normals_in_space=frozen(normals),
                   oriented=frozen(oriented), thickness_m=frozen(thickness), trust=frozen(trust),
                   neighbours=frozen(support), nearest=frozen(index))  # fmt: skip


@kernel
def fit_in_plane(
    points: FloatArray, rows: IntArray, leaves: FloatArray, axis: IntArray, value: FloatArray, count: int
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, FloatArray, FloatArray, IntArray]:
    """Fit `count` neighbours, or up to four times as many, at points (n, 2): the fields of a `Surface`."""
    index = neighbours_of_all(rows, leaves, axis, value, count)
    anchors, normals, variances = axes_of_all(points, index)
    oriented, thickness, trust, share = judge_fits(points, index, anchors, normals, variances)
    for _ in range(MOST_DOUBLINGS):
        if share <= THICKEST_SHARE or 2 * count > len(points):
            break
        wider = neighbours_of_all(rows, leaves, axis, value, 2 * count)
        means, across, variances = axes_of_all(points, wider)
        other = judge_fits(points, wider, means, across, variances)
        if other[3] > SHARE_GAINED * share:
            break
        anchors, normals, index, count = means, across, wider, 2 * count
        oriented, thickness, trust, share = other
    spread = np.zeros((len(points), 3))
    for row in range(len(points)):
        spread[row, 0], spread[row, 1] = normals[row, 0], normals[row, 1]
    return anchors, normals, spread, oriented, thickness, trust, index


@kernel
def judge_fits(
    points: FloatArray, neighbours: IntArray, anchors: FloatArray, normals: FloatArray, variances: FloatArray
) -> tuple[BoolArray, FloatArray, FloatArray, float]:
    """Oriented, thickness and trust (n,) of what `axes_of_all` fitted, whose anchors move back to the surface.

    Last comes the median thickness of the neighbourhoods over their second longest side, in the plane their length;
    zero where it is no more than `THICKEST_SHARE`.
    """
    n, k = neighbours.shape
    d = points.shape[1]
    oriented, thickness, trust = np.zeros(n, dtype=np.bool_), np.zeros(n), np.zeros(n)
    if k == 0:
        anchors[:], normals[:] = points, 0.0
        return oriented, thickness, trust, 0.0
    some, shares, count, thin = np.empty(n), np.empty(n), 0, 0
    for row in range(n):
        least, second, largest = variances[row, 0], variances[row, 1], variances[row, 2]
        oriented[row] = second > LINE_TOLERANCE * max(largest, TINY)
        # the fit spends d degrees of freedom on k points
        thickness[row] = np.sqrt(least * k / max(k - d, 1))
        if oriented[row]:
            some[count], shares[count] = thickness[row], least / second
            thin += shares[count] <= THICKEST_SHARE * THICKEST_SHARE
            count += 1
        else:
            for a in range(d):
                normals[row, a] = 0.0
    usual = middle_of(some, count) if count > 0 else 0.0
    for row in range(n):
        if oriented[row]:
            # a neighbourhood as thick as it is long has no direction, one in space as wide as it is thick neither
            thick = thickness[row] / max(USUAL_THICKNESSES * usual, THINNEST_M)
            trust[row] = (1.0 - variances[row, 0] / variances[row, 1]) / (1.0 + thick * thick)
            if d == 3:
                trust[row] *= min(LONGEST_SHARE * LONGEST_SHARE * variances[row, 1] / variances[row, 2], 1.0)
    return_to_surface(points, neighbours, anchors, normals, trust)
    return oriented, thickness, trust, 0.0 if 2 * thin > count or count == 0 else np.sqrt(middle_of(shares, count))


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
