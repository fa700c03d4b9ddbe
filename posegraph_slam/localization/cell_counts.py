"""Agreement of a scan with a map by counting cells: occupied where the scan has returns, free where it sees through.

The free cells of a scan are those inside the polygon of sensor and returns. How many of them the map holds for free is
a sum over the polygon's edges of counts along rows, not over the cells themselves: a boundary instead of an area.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from posegraph_slam.jit import kernel
from posegraph_slam.mapping.raycast import NEVER_SEEN

Int32Array = npt.NDArray[np.int32]


def free_before(evidence: Int32Array) -> Int32Array:
    """Return how many cells (R, C + 1) of each row are free to the left of every column, the end of the row last."""
    rows, columns = evidence.shape
    counts = np.zeros((rows, columns + 1), dtype=np.int32)
    refresh_free_before(evidence, counts, 0, rows, 0, columns)
    return counts


@kernel
def refresh_free_before(evidence, counts, low_row, end_row, low_column, end_column):  # type: ignore[no-untyped-def]
    """Bring counts of free cells up to date after `evidence` changed in rows and columns [low, end)."""
    columns = evidence.shape[1]
    for r in range(low_row, end_row):
        total = counts[r, low_column]
        for c in range(low_column, end_column):
            value = evidence[r, c]
            total += np.int32((value < 0) & (value != NEVER_SEEN))
            shift = total - counts[r, c + 1]
            counts[r, c + 1] = total
        if shift != 0:
            for c in range(end_column + 1, columns + 1):
                counts[r, c] += shift


@kernel
def scan_outline(points, sensor, cell_m):  # type: ignore[no-untyped-def]
    """Polygon (n + 1, 2) of the space that returns (n, 2), in the order of their bearings, leave free.

    It starts at the `sensor` and ends one cell before each return: the cell of a return itself is not free.
    """
    outline = np.empty((len(points) + 1, 2))
    outline[0, 0], outline[0, 1] = sensor[0], sensor[1]
    for b in range(len(points)):
        dx, dy = points[b, 0] - sensor[0], points[b, 1] - sensor[1]
        length = np.hypot(dx, dy)
        part = max(length - cell_m, 0.0) / length if length > 0.0 else 0.0
        outline[b + 1, 0], outline[b + 1, 1] = sensor[0] + part * dx, sensor[1] + part * dy
    return outline


@kernel
def one_a_cell(points, cell_m):  # type: ignore[no-untyped-def]
    """Drop returns (n, 2) that lie in the same cell, of a grid in their own frame, as the one before."""
    kept = np.empty_like(points)
    count = 0
    column, row = 0, 0
    for b in range(len(points)):
        x, y = int(np.floor(points[b, 0] / cell_m)), int(np.floor(points[b, 1] / cell_m))
        if b == 0 or x != column or y != row:
            kept[count] = points[b]
            count += 1
        column, row = x, y
    return kept[:count]


@kernel
def count_scores(particles, outline, returns, M, near, counts):  # type: ignore[no-untyped-def]
    """Cells (N,) on which scan and map agree: returns in obstacles, and cells inside the outline that are free.

    `near` (R, C) is zero in obstacles, `counts` as of `free_before`. A cell is inside where its centre is.
    """
    rows, columns = near.shape
    scores = np.zeros(len(particles))
    for k in range(len(particles)):
        c, s = np.cos(particles[k, 2]), np.sin(particles[k, 2])
        xx, xy = M[0, 0] * c + M[0, 1] * s, -M[0, 0] * s + M[0, 1] * c
        yx, yy = M[1, 0] * c + M[1, 1] * s, -M[1, 0] * s + M[1, 1] * c
        x0 = M[0, 0] * particles[k, 0] + M[0, 1] * particles[k, 1] + M[0, 2]
        y0 = M[1, 0] * particles[k, 0] + M[1, 1] * particles[k, 1] + M[1, 2]
        hits = 0
        for b in range(len(returns)):
            column = int(np.floor(xx * returns[b, 0] + xy * returns[b, 1] + x0))
            row = int(np.floor(yx * returns[b, 0] + yy * returns[b, 1] + y0))
            if 0 <= row < rows and 0 <= column < columns and near[row, column] == 0:
                hits += 1
        # The area to the left of each edge, row by row: positive on the way up, negative on the way down.
        free = 0
        last = len(outline) - 1
        ax = xx * outline[last, 0] + xy * outline[last, 1] + x0 - 0.5
        ay = yx * outline[last, 0] + yy * outline[last, 1] + y0 - 0.5
        start = int(np.ceil(ay))
        for b in range(len(outline)):
            bx = xx * outline[b, 0] + xy * outline[b, 1] + x0 - 0.5
            by = yx * outline[b, 0] + yy * outline[b, 1] + y0 - 0.5
            end = int(np.ceil(by))
            if start != end:
                slope = (bx - ax) / (by - ay)
                up = start < end
                part = 0
                for row in range(max(min(start, end), 0), min(max(start, end), rows)):
                    column = int(np.ceil(ax + (row - ay) * slope))
                    part += counts[row, min(max(column, 0), columns)]
                free += part if up else -part
            ax, ay, start = bx, by, end
        scores[k] = hits + free
    return scores


@kernel
def straightened(outline, tolerance_m):  # type: ignore[no-untyped-def]
    """Drop corners of a polygon (n, 2) that lie within the tolerance of the edge that then replaces them.

    One pass: from each kept corner a cone of directions that pass all corners since within the tolerance, until a
    corner lies outside of it or turns back (Williams 1978). Corners stay in their order.
    """
    kept = np.empty_like(outline)
    kept[0] = outline[0]
    count, anchor = 1, 0
    ux, uy, low, high, reached = 0.0, 0.0, 0.0, 0.0, 0.0
    open_cone = True
    b = 1
    while b < len(outline):
        dx, dy = outline[b, 0] - outline[anchor, 0], outline[b, 1] - outline[anchor, 1]
        if open_cone:
            length = np.hypot(dx, dy)
            if length > tolerance_m:
                ux, uy, open_cone = dx / length, dy / length, False
                low, high, reached = -tolerance_m / length, tolerance_m / length, length
            b += 1
            continue
        along, across = ux * dx + uy * dy, ux * dy - uy * dx
        if along < reached - tolerance_m or across < low * along or across > high * along:
            anchor, open_cone = b - 1, True
            kept[count] = outline[anchor]
            count += 1
            continue
        low, high = max(low, (across - tolerance_m) / along), min(high, (across + tolerance_m) / along)
        reached = max(reached, along)
        b += 1
    kept[count] = outline[len(outline) - 1]
    return kept[: count + 1]
