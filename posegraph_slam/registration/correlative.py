"""Correlative scan matching on a likelihood field, exhaustively or by branch and bound.

The score of a pose is the mean of the field under the scan's points (Olson 2009). Branch and bound (Hess et al. 2016)
finds the best pose of the whole window: a max-pooled copy of the field bounds the score of a block of translations.
"""

from __future__ import annotations

import numpy as np

from posegraph_slam.jit import inline_kernel, kernel

FIELD_MAX = 255.0
"""Field value on a reference point."""


@kernel
def likelihood_field(points, origin, resolution, rows, columns, pad, sigma):  # type: ignore[no-untyped-def]
    """Rasterise `points` (n, 2) into a field (rows + 2 pad, columns + 2 pad) uint8: the largest Gaussian at each cell.

    Cell (pad, pad) has its lower-left corner at `origin`. Beyond three sigma the field is zero.
    """
    field = np.zeros((rows + 2 * pad, columns + 2 * pad), np.uint8)
    reach = int(np.ceil(3.0 * sigma / resolution))
    for k in range(len(points)):
        fx, fy = (points[k, 0] - origin[0]) / resolution, (points[k, 1] - origin[1]) / resolution
        cx, cy = int(np.floor(fx)), int(np.floor(fy))
        if cx < 0 or cy < 0 or cx >= columns or cy >= rows:
            continue
        for dy in range(-reach, reach + 1):
            y = cy + dy
            if y < 0 or y >= rows:
                continue
            for dx in range(-reach, reach + 1):
                x = cx + dx
                if x < 0 or x >= columns:
                    continue
                ex, ey = (x + 0.5 - fx) * resolution, (y + 0.5 - fy) * resolution
                value = np.uint8(FIELD_MAX * np.exp(-0.5 * (ex * ex + ey * ey) / (sigma * sigma)) + 0.5)
                if value > field[y + pad, x + pad]:
                    field[y + pad, x + pad] = value
    return field


@kernel
def max_pooled(field, levels):  # type: ignore[no-untyped-def]
    """Stack (levels + 1, R, C): level h holds the maximum over the block [y, y + 2^h) x [x, x + 2^h)."""
    rows, columns = field.shape
    stack = np.zeros((levels + 1, rows, columns), field.dtype)
    stack[0] = field
    for h in range(levels):
        step = 1 << h
        for y in range(rows):
            y2 = min(y + step, rows - 1)
            for x in range(columns):
                x2 = min(x + step, columns - 1)
                stack[h + 1, y, x] = max(max(stack[h, y, x], stack[h, y, x2]), max(stack[h, y2, x], stack[h, y2, x2]))
    return stack


@kernel
def rotated_cells(points, start, angles, origin, resolution, pad):  # type: ignore[no-untyped-def]
    """Field cells (A, n, 2) as [x, y] of the points at `start` turned by each of `angles` (A,)."""
    cells = np.empty((len(angles), len(points), 2), np.int32)
    for a in range(len(angles)):
        c, s = np.cos(start[2] + angles[a]), np.sin(start[2] + angles[a])
        for k in range(len(points)):
            x = c * points[k, 0] - s * points[k, 1] + start[0]
            y = s * points[k, 0] + c * points[k, 1] + start[1]
            cells[a, k, 0] = int(np.floor((x - origin[0]) / resolution)) + pad
            cells[a, k, 1] = int(np.floor((y - origin[1]) / resolution)) + pad
    return cells


@kernel
def block_score(field, cells, dx, dy):  # type: ignore[no-untyped-def]
    """Sum of the field under `cells` (n, 2) shifted by whole cells."""
    rows, columns = field.shape
    total = 0
    for k in range(len(cells)):
        x, y = cells[k, 0] + dx, cells[k, 1] + dy
        if 0 <= x < columns and 0 <= y < rows:
            total += field[y, x]
    return total


@kernel
def exhaustive_search(field, cells, reach):  # type: ignore[no-untyped-def]
    """Best (angle index, dx, dy, score sum) over every angle and shift within `reach` cells; first of equals."""
    best_a, best_x, best_y, best = 0, 0, 0, -1
    for a in range(len(cells)):
        for dy in range(-reach, reach + 1):
            for dx in range(-reach, reach + 1):
                score = block_score(field, cells[a], dx, dy)
                if score > best:
                    best_a, best_x, best_y, best = a, dx, dy, score
    return best_a, best_x, best_y, best


NO_DISC = (0, 0, -1)
"""Centre and radius in cells of a disc that excludes nothing."""


@inline_kernel
def insert_block(todo, first, top, x, y, level, score):  # type: ignore[no-untyped-def]
    """Put a block [x, y, level, score] among the rows from `first` to `top` of `todo`, where scores rise."""
    at = top
    while at > first and todo[at - 1, 3] > score:
        todo[at] = todo[at - 1]
        at -= 1
    todo[at, 0], todo[at, 1], todo[at, 2], todo[at, 3] = x, y, level, score


@kernel
def branch_and_bound(stack, cells, reach, least, disc):  # type: ignore[no-untyped-def]
    """Best (angle index, dx, dy, score sum) within `reach` cells whose score exceeds `least`, else score -1.

    Blocks are visited in the order of their bounds; a block whose bound does not exceed the best score is dropped.
    `stack` must be padded by at least 2^levels cells, so that a block may start before the field. Shifts within the
    `disc` (x, y, radius) are left out, so that a rival of a pose already found can be sought.
    """
    inside = disc[2] * disc[2] if disc[2] >= 0 else -1
    levels = len(stack) - 1
    width = 1 << levels
    blocks = (2 * reach) // width + 1
    count = len(cells) * blocks * blocks
    bounds = np.empty(count, np.int64)
    for a in range(len(cells)):
        for by in range(blocks):
            for bx in range(blocks):
                bounds[(a * blocks + by) * blocks + bx] = block_score(
                    stack[levels], cells[a], bx * width - reach, by * width - reach
                )
    order = np.argsort(-bounds, kind="mergesort")
    best_a, best_x, best_y, best = 0, 0, 0, least
    found = False
    todo = np.empty((4 * (levels + 1) + 4, 4), np.int64)
    for position in range(count):
        block = order[position]
        if bounds[block] <= best:
            break
        a, rest = block // (blocks * blocks), block % (blocks * blocks)
        todo[0, 0], todo[0, 1] = (rest % blocks) * width - reach, (rest // blocks) * width - reach
        todo[0, 2], todo[0, 3] = levels, bounds[block]
        top = 1
        while top > 0:
            top -= 1
            x, y, level, bound = todo[top, 0], todo[top, 1], todo[top, 2], todo[top, 3]
            if bound <= best:
                continue
            size = (1 << level) - 1
            corner_x = max(abs(x - disc[0]), abs(x + size - disc[0]))
            corner_y = max(abs(y - disc[1]), abs(y + size - disc[1]))
            if corner_x * corner_x + corner_y * corner_y <= inside:
                continue
            if level == 0:
                best_a, best_x, best_y, best, found = a, x, y, bound, True
                continue
            half = 1 << (level - 1)
            first = top
            for quarter in range(4):
                qx, qy = x + half * (quarter & 1), y + half * (quarter >> 1)
                if qx > reach or qy > reach:
                    continue
                score = block_score(stack[level - 1], cells[a], qx, qy)
                if score <= best:
                    continue
                insert_block(todo, first, top, qx, qy, level - 1, score)
                top += 1
    return best_a, best_x, best_y, best if found else -1
