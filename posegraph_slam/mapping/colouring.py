"""Kernels of the texture map: the colour that each floor pixel of a depth image has in the colour image."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray, IntArray
from posegraph_slam.jit import inline_kernel, kernel
from posegraph_slam.mapping.floor_kernels import FLOOR, UNLABELLED, whole

SATURATED = 255
WEIGHT_UNIT = 4096.0
"""Weights are whole: 1 / 4096 of a drop of one metre seen from a metre away; 12 for floor 5 m ahead of a camera 0.36 m
up, 2000 right before it. Sums of whole numbers do not depend on their order."""
LARGEST_WEIGHT = 65536.0
FINE_ROWS = 8.0
"""Where so many rows of pixels cross a cell, up to 1.1 m ahead of a camera 0.36 m up, the nearest pixel's colour does:
it is half a row away at most, a 16th of the cell, and takes a quarter of the memory reads."""


@inline_kernel
def view_weight(drop: float, square: float) -> int:
    """Cosine of the angle from the floor's normal over squared distance: pixels a square metre of floor, whole.

    `drop` is the camera's height over the point and `square` their squared distance.
    """
    value = WEIGHT_UNIT * drop / (square * np.sqrt(square))
    return int(min(max(value, 1.0), LARGEST_WEIGHT))


@inline_kernel
def add_nearest(colour: ByteArray, m: int, n: int, weight: int, sums: IntArray, r: int, c: int) -> None:
    """Add the colour of pixel (m, n) to cell (r, c), with a 64th of the weight where it is saturated."""
    red, green, blue = colour[m, n, 0], colour[m, n, 1], colour[m, n, 2]
    if red == SATURATED or green == SATURATED or blue == SATURATED:
        weight = max(weight // 64, 1)
        sums[r, c, 5] += 1
    sums[r, c, 0] += weight * red
    sums[r, c, 1] += weight * green
    sums[r, c, 2] += weight * blue
    sums[r, c, 3] += weight


@inline_kernel
def add_between(colour: ByteArray, u: float, v: float, weight: int, sums: IntArray, r: int, c: int) -> None:
    """Add the colour between the four pixels around (u, v) to cell (r, c), less where one is saturated."""
    m, n = min(int(u), colour.shape[0] - 2), min(int(v), colour.shape[1] - 2)
    a, b = u - m, v - n
    for channel in range(3):
        if (
            colour[m, n, channel] == SATURATED
            or colour[m, n + 1, channel] == SATURATED
            or colour[m + 1, n, channel] == SATURATED
            or colour[m + 1, n + 1, channel] == SATURATED
        ):
            weight = max(weight // 64, 1)
            sums[r, c, 5] += 1
            break
    for channel in range(3):
        top = (1.0 - b) * colour[m, n, channel] + b * colour[m, n + 1, channel]
        low = (1.0 - b) * colour[m + 1, n, channel] + b * colour[m + 1, n + 1, channel]
        sums[r, c, channel] += int(weight * ((1.0 - a) * top + a * low) + 0.5)
    sums[r, c, 3] += weight


@kernel
def add_colours(
    depth: Float32Array,
    labels: ByteArray,
    colour: ByteArray,
    cells: tuple[FloatArray, FloatArray, FloatArray],
    seen: tuple[FloatArray, FloatArray, FloatArray],
    pinhole: tuple[float, float, float],
    cell_m: float,
    uniform: bool,
    stride: int,
    corner: tuple[int, int],
    sums: IntArray,
) -> None:
    """Add the colours of one frame's floor pixels to `sums` (R, C, 7), a window of cells from (row, column) `corner`.

    Sums are [red, green, blue, weight of floor, weight of the rest, saturated pixels, pixels]. `cells` are column
    and row on the map and height of a pixel, `seen` its coordinates in the regular frame of the colour camera when the
    colour image was taken; `pinhole` is focal length, centre row and centre column. Colours of far floor
    are interpolated between four pixels; where one is saturated the weight is a 64th. Floor outside the colour image or
    the window is left out.
    """
    rows, columns, constant = cells
    s_rows, s_columns, s_constant = seen
    focal, centre_row, centre_column = pinhole
    for i in range(0, depth.shape[0], stride):
        for j in range(0, depth.shape[1], stride):
            label = labels[i, j]
            if label == UNLABELLED:
                continue
            z = depth[i, j]
            dx, dy = z * (rows[i, 0] + columns[j, 0]), z * (rows[i, 1] + columns[j, 1])
            c, r = whole(dx + constant[0]) - corner[1], whole(dy + constant[1]) - corner[0]
            if not (0 <= r < sums.shape[0] and 0 <= c < sums.shape[1]):
                continue
            weight, drop = 1, -z * (rows[i, 2] + columns[j, 2])
            if not uniform:
                square = (dx * dx + dy * dy) * cell_m * cell_m + drop * drop
                weight = view_weight(drop if label == FLOOR else np.sqrt(square), square)
            sums[r, c, 6] += 1
            if label != FLOOR:
                sums[r, c, 4] += weight
                continue
            ahead = z * (s_rows[i, 0] + s_columns[j, 0]) + s_constant[0]
            if ahead <= 0.0:
                continue
            left = z * (s_rows[i, 1] + s_columns[j, 1]) + s_constant[1]
            up = z * (s_rows[i, 2] + s_columns[j, 2]) + s_constant[2]
            u, v = centre_row - focal * up / ahead, centre_column - focal * left / ahead
            if not (-0.5 <= u < colour.shape[0] - 0.5 and -0.5 <= v < colour.shape[1] - 0.5):
                continue
            u, v = min(max(u, 0.0), colour.shape[0] - 1.0), min(max(v, 0.0), colour.shape[1] - 1.0)
            if FINE_ROWS * z * z < cell_m * focal * drop:
                add_nearest(colour, int(u + 0.5), int(v + 0.5), weight, sums, r, c)
            else:
                add_between(colour, u, v, weight, sums, r, c)


@kernel
def add_patches(
    frame: IntArray, cell: IntArray, colour: IntArray, weights: IntArray, gains: FloatArray, sums: IntArray
) -> None:
    """Add patches to `sums` (R * C, 5): colours (n, 3) in 1 / 256, `weights` (n, 2) of floor and of the rest.

    Colours are divided by the gain (F, 3) of their frame.
    """
    for k in range(len(cell)):
        for channel in range(3):
            value = colour[k, channel] / (256.0 * gains[frame[k], channel])
            sums[cell[k], channel] += int(weights[k, 0] * value + 0.5)
        sums[cell[k], 3] += weights[k, 0]
        sums[cell[k], 4] += weights[k, 1]
