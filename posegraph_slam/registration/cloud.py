"""A point set made ready for matching: its KD-tree and the lines or planes that its points lie on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.jit import kernel
from posegraph_slam.registration.kd_tree import KdTree, build_kd_tree, in_space

LINE_TOLERANCE = 1e-12
"""Share of the largest variance under which the next one is rounding: the points lie on one line."""

USUAL_THICKNESSES = 2.0
"""Thickness, in medians of the cloud, at which a fitted line or plane is trusted by half."""

THINNEST_M = 1e-6
"""Thickness under which differences are rounding: a variance of zero comes out as 1e-16 of the neighbourhood's."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Points (n, d), d = 2 or 3, with their KD-tree and surface; `spans_plane` unless all lie on one spot or line.
    `in_space` (n, 3) are the points with a zero as third coordinate in the plane.

    Made by `prepare_cloud`; a scan that is matched twice is prepared once. Tree and surface are made when
    first asked for (a source needs them in few cases), for which the record keeps a dictionary instead of slots.
    """

    points: FloatArray
    in_space: FloatArray
    spans_plane: bool
    neighbours: int

    def __len__(self) -> int:
        return int(self.points.shape[0])

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.points.shape[1])

    @cached_property
    def tree(self) -> KdTree:
        """KD-tree of the points."""
        return build_kd_tree(self.in_space)

    @cached_property
    def normals_in_space(self) -> FloatArray:
        """Normals (n, 3) of the surface: those of the plane get a zero."""
        return in_space(self.surface.normals)

    @cached_property
    def surface(self) -> Surface:
        """Tangent lines or planes at the points."""
        return fit_surface(self.points, self.tree, self.neighbours)


def prepare_cloud(points: FloatArray, *, neighbours: int = 10) -> Cloud:
    """Build the KD-tree of points (n, 2) or (n, 3), to whose `neighbours` nearest lines or planes will be fitted.

    Raises `InputError` if the array has another shape or holds values that are not finite.
    """
    checked = read_only(points)
    if checked.ndim != 2 or checked.shape[1] not in (2, 3):
        raise InputError("point set", f"has shape {checked.shape}", "give an array (points, 2) or (points, 3)")
    padded, finite, spans_plane = prepare_points(checked)
    if not finite:
        bad = int(np.count_nonzero(~np.isfinite(checked).all(axis=1)))
        raise InputError("point set", f"{bad} of {len(checked)} points are not finite", "remove them before matching")
    return Cloud(points=checked, in_space=read_only(padded), spans_plane=spans_plane, neighbours=neighbours)


@kernel
def prepare_points(points: FloatArray) -> tuple[FloatArray, bool, bool]:
    """Points (n, 3), whether all are finite, and whether they span a plane."""
    n, d = points.shape
    padded, finite = np.zeros((n, 3)), True
    for row in range(n):
        for a in range(d):
            padded[row, a] = points[row, a]
            finite = finite and np.isfinite(points[row, a])
    return padded, finite, finite and _spans_plane(points)


def normals_at(cloud: Cloud, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Normals (n, 3) and thickness (n,) at some rows of a cloud, zero elsewhere: cheaper than its whole surface."""
    index = cloud.tree.neighbours(cloud.in_space[rows], min(cloud.neighbours, len(cloud)))
    return scatter_normals(cloud.in_space, rows, *fit_neighbourhoods(cloud.points, index)[1:4])


@kernel
def scatter_normals(
    points: FloatArray, rows: IntArray, normals: FloatArray, oriented: BoolArray, thickness: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Put normals (k, d) and thickness (k,) where `rows` (k,) say, into (n, 3) and (n,)."""
    everywhere, thick = np.zeros(points.shape), np.zeros(len(points))
    for k in range(len(rows)):
        if oriented[k]:
            thick[rows[k]] = thickness[k]
            for a in range(normals.shape[1]):
                everywhere[rows[k], a] = normals[k, a]
    return everywhere, thick


def fit_surface(points: FloatArray, tree: KdTree, neighbours: int) -> Surface:
    """Fit a line (2D) or plane (3D) by principal axes to the `neighbours` nearest points (itself among them) of each.

    The anchor is the mean of the neighbours: a matcher that paired with raw points would pick, among points denser
    than their noise, those that err towards the source, and would be drawn to its own guess.
    """
    n, d = points.shape
    if n < d:
        none = np.zeros((n, 0), dtype=np.int64)
        return Surface(anchors=points, normals=np.zeros((n, d)), oriented=np.zeros(n, dtype=np.bool_),
                       thickness_m=np.zeros(n), trust=np.zeros(n), neighbours=none)  # fmt: skip
    index = np.empty((n, min(neighbours, n)), dtype=np.int64)
    index[tree.rows] = tree.neighbours(tree.sorted_points, min(neighbours, n))  # leaf by leaf: the cache stays warm
    anchors, normals, oriented, thickness, trust = fit_neighbourhoods(points, index)
    return Surface(anchors=anchors, normals=normals, oriented=oriented, thickness_m=thickness, trust=trust,
                   neighbours=index)  # fmt: skip


@kernel
def fit_neighbourhoods(
    points: FloatArray, neighbours: IntArray
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray, FloatArray]:
    """Anchors and normals (n, d), oriented (n,), thickness and trust (n,) of the points named by rows (n, k)."""
    n, k = neighbours.shape
    d = points.shape[1]
    anchors, covariances = neighbourhood_moments(points, neighbours)
    if d == 2:
        normals, values = least_axes_in_plane(covariances)
    else:
        normals, values = least_axes_in_space(covariances)
    oriented, thickness, trust = np.zeros(n, dtype=np.bool_), np.zeros(n), np.zeros(n)
    some, count = np.empty(n), 0
    for row in range(n):
        oriented[row] = values[row, 1] > LINE_TOLERANCE * max(values[row, d - 1], 2.2250738585072014e-308)
        # the fit spends d degrees of freedom on k points
        thickness[row] = np.sqrt(max(values[row, 0], 0.0) * k / max(k - d, 1))
        if oriented[row]:
            some[count] = thickness[row]
            count += 1
        else:
            normals[row] = 0.0
    usual = np.median(some[:count]) if count > 0 else 0.0
    for row in range(n):
        if oriented[row]:
            trust[row] = 1.0 / (1.0 + (thickness[row] / max(USUAL_THICKNESSES * usual, THINNEST_M)) ** 2)
    return anchors, normals, oriented, thickness, trust


@kernel
def neighbourhood_moments(points: FloatArray, neighbours: IntArray) -> tuple[FloatArray, FloatArray]:
    """Mean (n, d) and covariance (n, d, d) of the points named by each row of `neighbours` (n, k)."""
    n, k = neighbours.shape
    d = points.shape[1]
    means, covariances = np.zeros((n, d)), np.zeros((n, d, d))
    for row in range(n):
        for j in range(k):
            for a in range(d):  # relative to the nearest: no digits are lost far from the origin
                means[row, a] += (points[neighbours[row, j], a] - points[neighbours[row, 0], a]) / k
        for j in range(k):
            for a in range(d):
                for b in range(d):
                    covariances[row, a, b] += (
                        (points[neighbours[row, j], a] - points[neighbours[row, 0], a] - means[row, a])
                        * (points[neighbours[row, j], b] - points[neighbours[row, 0], b] - means[row, b]) / k
                    )  # fmt: skip
        for a in range(d):
            means[row, a] += points[neighbours[row, 0], a]
    return means, covariances


def least_axes(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit eigenvectors (n, d) of the smallest eigenvalues of (n, d, d), and all eigenvalues (n, d), rising."""
    if covariances.shape[1] == 3:
        return least_axes_in_space(covariances)
    return least_axes_in_plane(covariances)


@kernel
def least_axes_in_plane(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least eigenvectors (n, 2) and rising eigenvalues (n, 2) of (n, 2, 2) in closed form."""
    n = len(covariances)
    axes, values = np.empty((n, 2)), np.empty((n, 2))
    for row in range(n):
        xx, xy, yy = covariances[row, 0, 0], covariances[row, 0, 1], covariances[row, 1, 1]
        middle, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
        angle = np.arctan2(2 * xy, xx - yy) / 2
        axes[row, 0], axes[row, 1] = -np.sin(angle), np.cos(angle)
        values[row, 0], values[row, 1] = middle - half, middle + half
    return axes, values


@kernel
def least_axes_in_space(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least eigenvectors (n, 3) and rising eigenvalues (n, 3) of (n, 3, 3) by cyclic Jacobi turns (Golub, 8.5).

    Ten times as fast as LAPACK on matrices this small; an axis is off by 1e-12 rad at most.
    """
    n = len(covariances)
    axes, values = np.empty((n, 3)), np.empty((n, 3))
    A, V = np.empty((3, 3)), np.empty((3, 3))
    for row in range(n):
        for i in range(3):
            for j in range(3):
                A[i, j] = covariances[row, i, j]
                V[i, j] = 1.0 if i == j else 0.0
        for _ in range(12):
            off = A[0, 1] ** 2 + A[0, 2] ** 2 + A[1, 2] ** 2
            if off <= 1e-24 * (A[0, 0] ** 2 + A[1, 1] ** 2 + A[2, 2] ** 2):
                break
            for p in range(2):
                for q in range(p + 1, 3):
                    if A[p, q] == 0.0:
                        continue
                    tau = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
                    t = (1.0 if tau >= 0 else -1.0) / (abs(tau) + np.sqrt(1.0 + tau * tau))
                    c = 1.0 / np.sqrt(1.0 + t * t)
                    s = t * c
                    for k in range(3):
                        A[k, p], A[k, q] = c * A[k, p] - s * A[k, q], s * A[k, p] + c * A[k, q]
                    for k in range(3):
                        A[p, k], A[q, k] = c * A[p, k] - s * A[q, k], s * A[p, k] + c * A[q, k]
                    for k in range(3):
                        V[k, p], V[k, q] = c * V[k, p] - s * V[k, q], s * V[k, p] + c * V[k, q]
        least = 0
        for i in range(1, 3):
            if A[i, i] < A[least, least]:
                least = i
        most = 0
        for i in range(1, 3):
            if A[i, i] >= A[most, most]:
                most = i
        if most == least:
            most = (least + 1) % 3
        values[row, 0], values[row, 2] = A[least, least], A[most, most]
        values[row, 1] = A[3 - least - most, 3 - least - most]
        for k in range(3):
            axes[row, k] = V[k, least]
    return axes, values


@kernel
def _spans_plane(points: FloatArray) -> bool:
    """Whether the points (n, d) vary along two directions at least."""
    if len(points) < 3:
        return False
    scatter = scatter_of(points)
    if points.shape[1] == 2:
        _, values = least_axes_in_plane(scatter)
    else:
        _, values = least_axes_in_space(scatter)
    return bool(values[0, points.shape[1] - 2] > LINE_TOLERANCE * values[0, points.shape[1] - 1])


@kernel
def scatter_of(points: FloatArray) -> FloatArray:
    """Sum of the outer products (1, d, d) of points (n, d), n > 0, about their mean."""
    n, d = points.shape
    mean, scatter = np.zeros(d), np.zeros((1, d, d))
    for row in range(n):
        for a in range(d):
            mean[a] += points[row, a] / n
    for row in range(n):
        for a in range(d):
            for b in range(d):
                scatter[0, a, b] += (points[row, a] - mean[a]) * (points[row, b] - mean[b])
    return scatter
