"""From a disparity image to depth, to colour pixels and to points in any frame (eq. 21-25 of the course report).

Rows of an image are u (centre 242.94 px), columns v (315.84 px). The optical frame has x to the right, y down and z
ahead; the camera's regular frame has x ahead, y to the left and z up, so that (x, y, z) = (z_o, -x_o, -y_o).

The colour pixel of a disparity pixel moves along its row number with 1 / depth; times depth, that is a constant shift.
So the disparity image is an exact pinhole image too, seen from a point `shift_m` above the colour camera, and every
coordinate of a pixel's point is linear in its depth: depth (a_row + b_column) + constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray, read_only
from posegraph_slam.jit import kernel
from posegraph_slam.sensors import DisparityCalibration


class Calibration(NamedTuple):
    """`DisparityCalibration` in the form that kernels take; the same fields in the same order."""

    focal_px: float
    centre_row_px: float
    centre_column_px: float
    dd_offset: float
    dd_slope: float
    depth_scale: float
    colour_scale: float
    colour_row_offset: float
    colour_row_dd: float
    colour_column_offset: float
    colour_divisor: float

    @classmethod
    def of(cls, calibration: DisparityCalibration) -> Calibration:
        """Take the numbers of a camera's calibration."""
        return cls(**{name: float(getattr(calibration, name)) for name in cls._fields})


@kernel
def inverse_depth(disparity: float, c: Calibration) -> float:
    """Return dd (eq. 22), proportional to the inverse of depth; zero or less where the disparity means nothing."""
    return c.dd_offset + c.dd_slope * disparity


@kernel
def colour_pixel(i: float, j: float, dd: float, c: Calibration) -> tuple[float, float]:
    """Return row and column of the colour pixel that belongs to disparity pixel (i, j) (eq. 22)."""
    row = (c.colour_scale * i + c.colour_row_offset + c.colour_row_dd * dd) / c.colour_divisor
    return row, (c.colour_scale * j + c.colour_column_offset) / c.colour_divisor


@kernel
def camera_point(row: float, column: float, depth: float, c: Calibration) -> tuple[float, float, float]:
    """Return the point seen at a colour pixel in the regular camera frame (eq. 23-24)."""
    return depth, -(column - c.centre_column_px) / c.focal_px * depth, -(row - c.centre_row_px) / c.focal_px * depth


@kernel
def _depths(disparity: Float32Array, c: Calibration, depth: Float32Array) -> None:
    for i in range(disparity.shape[0]):
        for j in range(disparity.shape[1]):
            dd = inverse_depth(disparity[i, j], c)
            depth[i, j] = c.depth_scale / dd if dd > 0.0 else 0.0


def depth_image(disparity: Float32Array, calibration: DisparityCalibration) -> Float32Array:
    """Return depth (H, W) float32 along the optical axis, in metres; 0 where the disparity means nothing (eq. 22)."""
    depth = np.empty(disparity.shape, dtype=np.float32)
    _depths(np.ascontiguousarray(disparity, dtype=np.float32), Calibration.of(calibration), depth)
    return depth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthView:
    """A depth image as a pinhole: slopes `down` (H,) of its rows and `right` (W,) of its columns, per unit of depth.

    The point of pixel (i, j) at depth z is (z, -right_j z, -down_i z - shift_m) in the regular frame of the colour
    camera: the depth camera looks along the same axis, from `-shift_m` above it.
    """

    down: FloatArray
    right: FloatArray
    shift_m: float = 0.0

    def __post_init__(self) -> None:
        for name in ("down", "right"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @classmethod
    def of(cls, calibration: DisparityCalibration, shape: tuple[int, int]) -> DepthView:
        """Return the view of a disparity image of `shape` (H, W) through the formulas of its colour pixels (eq. 22)."""
        c = calibration
        rows, columns = (np.arange(n, dtype=np.float64) for n in shape)
        row = (c.colour_scale * rows + c.colour_row_offset) / c.colour_divisor
        column = (c.colour_scale * columns + c.colour_column_offset) / c.colour_divisor
        return cls(
            down=(row - c.centre_row_px) / c.focal_px,
            right=(column - c.centre_column_px) / c.focal_px,
            shift_m=c.colour_row_dd * c.depth_scale / (c.colour_divisor * c.focal_px),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image."""
        return len(self.down), len(self.right)

    def coordinates(self, affine: FloatArray) -> Linear:
        """Return the K coordinates affine[:, :3] X + affine[:, 3] of the points X of all pixels, for `affine` (K, 4).

        With T_map_camera[:3] they are positions in the map, with a plane (1, 4) signed distances.
        """
        rows = affine[:, 0] - self.down[:, None] * affine[:, 2]
        columns = -self.right[:, None] * affine[:, 1]
        return Linear(rows, columns, affine[:, 3] - affine[:, 2] * self.shift_m)


class Linear(NamedTuple):
    """Coordinate k of pixel (i, j) at depth z is z (rows[i, k] + columns[j, k]) + constant[k]."""

    rows: FloatArray
    columns: FloatArray
    constant: FloatArray

    def window(self, farthest_m: float) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return first (row, column) and numbers of rows and columns of the cells of pixels up to a depth.

        Coordinates 0 and 1 are the column and the row of a cell. The points lie in the pyramid over the camera and the
        corners of the image, so that five points bound them.
        """
        i, j = np.array([0, 0, -1, -1]), np.array([0, -1, 0, -1])
        reach = self.constant + farthest_m * (self.rows[i] + self.columns[j])
        corners = np.vstack([self.constant, reach])[:, :2]
        low, high = np.floor(corners.min(axis=0)).astype(int) - 1, np.floor(corners.max(axis=0)).astype(int) + 2
        return (int(low[1]), int(low[0])), (int(high[1] - low[1]), int(high[0] - low[0]))

    def window_on(self, shape: tuple[int, int], farthest_m: float) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return the part of the window that lies on a grid of `shape`; it may have no rows or columns."""
        first, size = self.window(farthest_m)
        low = [min(max(a, 0), most) for a, most in zip(first, shape, strict=True)]
        high = [min(max(a + n, 0), most) for a, n, most in zip(first, size, shape, strict=True)]
        return (low[0], low[1]), (max(high[0] - low[0], 0), max(high[1] - low[1], 0))


def cell_coordinates(view: DepthView, T_map_camera: FloatArray, cells_from_map: FloatArray) -> Linear:
    """Return column and row, in cells of a grid (`cells_from_map` (3, 3)), and height in the map of all pixels."""
    affine = np.array(T_map_camera[:3])
    affine[:2] = cells_from_map[:2, :2] @ T_map_camera[:2]
    affine[:2, 3] += cells_from_map[:2, 2]
    return view.coordinates(affine)
