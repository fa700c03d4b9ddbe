"""A point set made ready for matching: its KD-tree and the lines or planes that its points lie on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from posegraph_slam.arrays import FloatArray, frozen, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.jit import kernel
from posegraph_slam.registration.kd_tree import KdTree, build_kd_tree
from posegraph_slam.registration.principal_axes import spans_plane
from posegraph_slam.registration.surface import Surface, fit_surface


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
    def surface(self) -> Surface:
        """Tangent lines or planes at the points."""
        return fit_surface(self.points, self.tree, self.neighbours)


def prepare_cloud(points: FloatArray, *, neighbours: int = 10) -> Cloud:
    """Build the KD-tree of points (n, 2) or (n, 3), to whose `neighbours` nearest lines or planes will be fitted.

    Raises `InputError` if the array has another shape or holds values that are not finite numbers.
    """
    try:
        given = np.asarray(points)
    except ValueError as error:
        raise InputError("point set", "has rows of unlike lengths", "give an array of numbers") from error
    if given.dtype.kind not in "iuf":
        raise InputError("point set", f"holds {given.dtype}", "give an array of numbers")
    checked = read_only(given)
    if checked.ndim != 2 or checked.shape[1] not in (2, 3):
        raise InputError("point set", f"has shape {checked.shape}", "give an array (points, 2) or (points, 3)")
    padded, finite, spans = prepare_points(checked)
    if not finite:
        bad = int(np.count_nonzero(~np.isfinite(checked).all(axis=1)))
        raise InputError("point set", f"{bad} of {len(checked)} points are not finite", "remove them before matching")
    return Cloud(points=checked, in_space=frozen(padded), spans_plane=spans, neighbours=neighbours)


@kernel
def prepare_points(points: FloatArray) -> tuple[FloatArray, bool, bool]:
    """Points (n, 3), whether all are finite, and whether they span a plane."""
    n, d = points.shape
    padded, finite = np.zeros((n, 3)), True
    for row in range(n):
        for a in range(d):
            padded[row, a] = points[row, a]
            finite = finite and np.isfinite(points[row, a])
    return padded, finite, finite and spans_plane(points)
