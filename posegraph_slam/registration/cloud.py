"""A point set made ready for matching: its KD-tree and the lines or planes that its points lie on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.jit import kernel

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cloud:
    """Points (n, d), d = 2 or 3, with their KD-tree and surface; `spans_plane` unless all lie on one spot or line.

    Made by `prepare_cloud`; a scan that is matched twice is prepared once.
    """

    points: FloatArray
    tree: cKDTree
    surface: Surface
    spans_plane: bool

    def __len__(self) -> int:
        return int(self.points.shape[0])

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.points.shape[1])


def prepare_cloud(points: FloatArray, *, neighbours: int = 10) -> Cloud:
    """Build the KD-tree of points (n, 2) or (n, 3) and fit a line or plane to the `neighbours` nearest of each.

    Raises `InputError` if the array has another shape or holds values that are not finite.
    """
    checked = read_only(points)
    if checked.ndim != 2 or checked.shape[1] not in (2, 3):
        raise InputError("point set", f"has shape {checked.shape}", "give an array (points, 2) or (points, 3)")
    if not np.isfinite(checked).all():
        bad = int(np.count_nonzero(~np.isfinite(checked).all(axis=1)))
        raise InputError("point set", f"{bad} of {len(checked)} points are not finite", "remove them before matching")
    tree = cKDTree(checked, leafsize=16)
    surface = fit_surface(checked, tree, neighbours)
    return Cloud(points=checked, tree=tree, surface=surface, spans_plane=_spans_plane(checked))


def fit_surface(points: FloatArray, tree: cKDTree, neighbours: int) -> Surface:
    """Fit a line (2D) or plane (3D) by principal axes to the `neighbours` nearest points (itself among them) of each.

    The anchor is the mean of the neighbours: a matcher that paired with raw points would pick, among points denser
    than their noise, those that err towards the source, and would be drawn to its own guess.
    """
    n, d = points.shape
    if n < d:
        none = np.zeros((n, 0), dtype=np.int64)
        return Surface(anchors=points, normals=np.zeros((n, d)), oriented=np.zeros(n, dtype=np.bool_),
                       thickness_m=np.zeros(n), trust=np.zeros(n), neighbours=none)  # fmt: skip
    index = np.asarray(tree.query(points, k=min(neighbours, n))[1], dtype=np.int64)
    anchors, covariances = neighbourhood_moments(points, index)
    normals, values = least_axes(covariances)
    oriented = values[:, 1] > LINE_TOLERANCE * np.maximum(values[:, -1], np.finfo(np.float64).tiny)
    normals[~oriented] = 0.0
    k = index.shape[1]
    # the fit spends d degrees of freedom on k points
    thickness = np.sqrt(np.maximum(values[:, 0], 0.0) * k / max(k - d, 1))
    usual = float(np.median(thickness[oriented])) if oriented.any() else 0.0
    trust = oriented / (1.0 + (thickness / max(USUAL_THICKNESSES * usual, THINNEST_M)) ** 2)
    return Surface(anchors=anchors, normals=normals, oriented=oriented, thickness_m=thickness, trust=trust,
                   neighbours=index)  # fmt: skip


@kernel
def neighbourhood_moments(points: FloatArray, neighbours: IntArray) -> tuple[FloatArray, FloatArray]:
    """Mean (n, d) and covariance (n, d, d) of the points named by each row of `neighbours` (n, k)."""
    n, k = neighbours.shape
    d = points.shape[1]
    means, covariances = np.zeros((n, d)), np.zeros((n, d, d))
    for row in range(n):
        for j in range(k):
            for a in range(d):  # relative to the point itself: no digits are lost far from the origin
                means[row, a] += (points[neighbours[row, j], a] - points[row, a]) / k
        for j in range(k):
            for a in range(d):
                for b in range(d):
                    covariances[row, a, b] += (
                        (points[neighbours[row, j], a] - points[row, a] - means[row, a])
                        * (points[neighbours[row, j], b] - points[row, b] - means[row, b]) / k
                    )  # fmt: skip
        for a in range(d):
            means[row, a] += points[row, a]
    return means, covariances


def least_axes(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit eigenvectors (n, d) of the smallest eigenvalues of (n, d, d), and all eigenvalues (n, d), rising."""
    if covariances.shape[1] == 3:
        values, vectors = np.linalg.eigh(covariances)
        return np.ascontiguousarray(vectors[:, :, 0]), values
    xx, xy, yy = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    # closed form in the plane, 20 times faster than eigh on stacks
    middle, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return np.column_stack([-np.sin(angle), np.cos(angle)]), np.column_stack([middle - half, middle + half])


def _spans_plane(points: FloatArray) -> bool:
    """Whether the points vary along two directions at least."""
    if len(points) < 3:
        return False
    centred = points - points.mean(axis=0)
    values = np.linalg.eigvalsh(centred.T @ centred)
    return bool(values[-2] > LINE_TOLERANCE * values[-1])
