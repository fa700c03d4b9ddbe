"""From a disparity image to coloured floor points (eq. 21-25 of the course report).

Rows of an image are u (centre 242.94 px), columns v (315.84 px). The optical frame has x to the right, y down and z
ahead; the camera's regular frame has x ahead, y to the left and z up, so that (x, y, z) = (z_o, -x_o, -y_o).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray, IntArray
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


class FloorLimits(NamedTuple):
    """Which points count as floor: depth along the optical axis and height in the map frame, in metres."""

    nearest: float
    farthest: float
    lowest: float
    highest: float


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
def add_floor(
    disparity: Float32Array,
    colour: ByteArray,
    T_map_camera: FloatArray,
    cells_from_map: FloatArray,
    calibration: Calibration,
    limits: FloorLimits,
    stride: int,
    sums: IntArray,
) -> int:
    """Add the colours of the floor points of one frame to `sums` (R, C, 4) [red, green, blue, count]; return how many.

    `disparity` (H, W), `colour` (H', W', 3) RGB, pose (4, 4), `cells_from_map` (3, 3) of the grid. Every `stride`-th
    row and column is used. Points outside the grid and pixels without depth or colour are left out.
    """
    T, M, added = T_map_camera, cells_from_map, 0
    for i in range(0, disparity.shape[0], stride):
        for j in range(0, disparity.shape[1], stride):
            dd = inverse_depth(disparity[i, j], calibration)
            if not dd > 0.0:
                continue
            depth = calibration.depth_scale / dd
            if not limits.nearest <= depth <= limits.farthest:
                continue
            pixel_row, pixel_column = colour_pixel(i, j, dd, calibration)
            x, y, z = camera_point(pixel_row, pixel_column, depth, calibration)
            height = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if not limits.lowest <= height < limits.highest:
                continue
            u, v = int(np.floor(pixel_row + 0.5)), int(np.floor(pixel_column + 0.5))
            if not (0 <= u < colour.shape[0] and 0 <= v < colour.shape[1]):
                continue
            map_x = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            map_y = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            column = int(np.floor(M[0, 0] * map_x + M[0, 1] * map_y + M[0, 2]))
            row = int(np.floor(M[1, 0] * map_x + M[1, 1] * map_y + M[1, 2]))
            if 0 <= row < sums.shape[0] and 0 <= column < sums.shape[1]:
                for channel in range(3):
                    sums[row, column, channel] += colour[u, v, channel]
                sums[row, column, 3] += 1
                added += 1
    return added
