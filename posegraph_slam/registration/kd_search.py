"""Searches in a balanced KD-tree, in kernels: exact, and the lowest row of equals wins."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import inline_kernel, kernel

STACK = 64
"""Deepest stack of a search: one entry a level, and 2^60 points do not fit any memory."""

ROUNDING = 1e-14
"""Share by which the squared distance to a box is taken smaller, so that rounding never hides a point on its border.

Three sums and the square of a point err by up to 1e-15. Where the fourth of the known targets bounds a search and is as
near as the first (points in many copies, regular grids), one round in forty lost a pair or took a farther one.
"""


@inline_kernel
def begin_walk(size: int, stack: IntArray, bounds: FloatArray) -> int:
    """Put the root of a tree of `size` points on the stack of a walk; the height for the first `next_leaf`.

    `stack` (STACK, 3) and `bounds` (STACK, 4) are scratch: node and range, and square and offsets of its box.
    """
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, 0, size
    bounds[0, 0] = bounds[0, 1] = bounds[0, 2] = bounds[0, 3] = 0.0
    return 0


@inline_kernel
def next_leaf(
    x: float, y: float, z: float, limit: float, axis: IntArray, value: FloatArray, top: int, stack: IntArray,
    bounds: FloatArray,
) -> tuple[int, int, int]:  # fmt: skip
    """Range of the next leaf within the squared distance `limit` of (x, y, z), and the height for the next call.

    The range is (-1, -1) when none is left. Nearer halves come first, and the distance to a box is kept up to date
    axis by axis (Arya and Mount 1993).
    """
    nodes = len(axis)
    while top >= 0 and bounds[top, 0] > limit:
        top -= 1
    if top < 0:
        return -1, -1, -1
    node, start, stop = stack[top, 0], stack[top, 1], stack[top, 2]
    square, ox, oy, oz = bounds[top, 0], bounds[top, 1], bounds[top, 2], bounds[top, 3]
    top -= 1
    while node < nodes:
        a, middle = axis[node], (start + stop) >> 1
        gap = (x if a == 0 else (y if a == 1 else z)) - value[node]
        offset = ox if a == 0 else (oy if a == 1 else oz)
        beyond = (square - offset * offset + gap * gap) * (1.0 - ROUNDING)
        if beyond <= limit:
            top += 1
            bounds[top, 0], bounds[top, 1], bounds[top, 2], bounds[top, 3] = beyond, ox, oy, oz
            bounds[top, 1 + a] = gap
            if gap < 0:
                stack[top, 0], stack[top, 1], stack[top, 2] = 2 * node + 2, middle, stop
            else:
                stack[top, 0], stack[top, 1], stack[top, 2] = 2 * node + 1, start, middle
        if gap < 0:
            node, stop = 2 * node + 1, middle
        else:
            node, start = 2 * node + 2, middle
    return start, stop, top


@kernel
def nearest_rows(
    queries: FloatArray, rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray, gate: float
) -> tuple[IntArray, FloatArray]:
    """Nearest row and distance of every query (m, 3) within the gate, which is inside."""
    m, limit = len(queries), gate * gate
    found, distance = np.full(m, -1, dtype=np.int64), np.full(m, np.inf)
    near, squares = np.full(1, -1, dtype=np.int64), np.empty(1)
    stack, bounds = np.zeros((STACK, 3), dtype=np.int64), np.zeros((STACK, 4))
    for q in range(m):
        held = search_near(queries[q, 0], queries[q, 1], queries[q, 2], rows, points, axis, value, limit, near,
                           squares, stack, bounds)  # fmt: skip
        if held > 0:
            found[q], distance[q] = near[0], np.sqrt(squares[0])
    return found, distance


@inline_kernel
def insert_near(row: int, square: float, near: IntArray, squares: FloatArray, held: int) -> int:
    """Put a point into the list of the nearest, by distance, then by row, if it belongs there; entries held then."""
    at, count = held, len(near)
    if held == count:
        at = count - 1
        if square > squares[at] or (square == squares[at] and row > near[at]):
            return held
    while at > 0 and (square < squares[at - 1] or (square == squares[at - 1] and row < near[at - 1])):
        squares[at], near[at] = squares[at - 1], near[at - 1]  # a second loop that shifts them costs twice as much
        at -= 1
    squares[at], near[at] = square, row
    return min(held + 1, count)


@kernel
def nearest_several(
    queries: FloatArray, rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray, count: int
) -> IntArray:
    """Rows (m, count) nearest to every query (m, 3), by distance, then by row."""
    m = len(queries)
    found, squares = np.empty((m, count), dtype=np.int64), np.empty(count)
    near = np.full(count, -1, dtype=np.int64)
    stack, bounds = np.zeros((STACK, 3), dtype=np.int64), np.zeros((STACK, 4))
    for q in range(m):
        search_near(queries[q, 0], queries[q, 1], queries[q, 2], rows, points, axis, value, np.inf, near, squares,
                    stack, bounds)  # fmt: skip
        for j in range(count):  # an assignment of the whole row takes 0.5 us
            found[q, j] = near[j]
    return found


@kernel
def neighbours_of_all(
    rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray, count: int
) -> IntArray:  # fmt: skip
    """Rows (n, count) nearest to each of the tree's own points, itself among them.

    Each search starts from the points beside its own, in the order of the rows where it leads from one point to the
    next on a shorter way (a scan) than that of the leaves. They come nearly sorted: wrongly guessed branches are most
    of the time of a search.
    """
    n = len(rows)
    found, squares, near = np.empty((n, count), dtype=np.int64), np.empty(count), np.empty(count, dtype=np.int64)
    if count == 0:
        return found
    stack, bounds = np.zeros((STACK, 3), dtype=np.int64), np.zeros((STACK, 4))
    order, label, place = np.arange(n), rows, np.empty((n, 3))
    for k in range(n):
        place[rows[k], 0], place[rows[k], 1], place[rows[k], 2] = points[k, 0], points[k, 1], points[k, 2]
    if length_of_way(place) > length_of_way(points):
        order, label, place = rows, order, points
    for q in range(n):
        low = max(0, min(q - count // 2, n - count))
        high, held, before, after = min(low + count, n), 0, q, q
        while before > low or after < high:
            if after < high:
                held = insert_near(order[after], square_between(place, q, after), near, squares, held)
                after += 1
            if before > low:
                before -= 1
                held = insert_near(order[before], square_between(place, q, before), near, squares, held)
        search_on(place[q, 0], place[q, 1], place[q, 2], rows, points, axis, value, np.inf, held, label, low, high,
                  near, squares, stack, bounds)  # fmt: skip
        for j in range(count):
            found[order[q], j] = near[j]
    return found


@kernel
def length_of_way(points: FloatArray) -> float:
    """Sum of the distances from each of the points (n, 3) to the next."""
    total = 0.0
    for k in range(len(points) - 1):
        total += np.sqrt(square_between(points, k, k + 1))
    return float(total)


@inline_kernel
def square_between(points: FloatArray, a: int, b: int) -> float:
    """Squared distance between two of the points (n, 3)."""
    x, y, z = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
    return float(x * x + y * y + z * z)


@kernel
def search_near(
    x: float, y: float, z: float, rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray, limit: float,
    near: IntArray, squares: FloatArray, stack: IntArray, bounds: FloatArray,
) -> int:  # fmt: skip
    """Write the rows nearest to (x, y, z) to `near` (count,), and their squares; number within `limit`, squared."""
    return search_on(x, y, z, rows, points, axis, value, limit, 0, rows, 0, 0, near, squares, stack, bounds)


@inline_kernel
def search_on(
    x: float, y: float, z: float, rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray, limit: float,
    held: int, label: IntArray, low: int, high: int, near: IntArray, squares: FloatArray, stack: IntArray,
    bounds: FloatArray,
) -> int:  # fmt: skip
    """Go on with a list of which `held` are known, among all points but those with labels low..high; how many it holds.

    `label` (n,) is in the order of the leaves.
    """
    count = len(near)
    if held == count:
        limit = min(limit, squares[count - 1])
    top = begin_walk(len(rows), stack, bounds)
    while True:
        start, stop, top = next_leaf(x, y, z, limit, axis, value, top, stack, bounds)
        if start < 0:
            return held
        for place in range(start, stop):
            k = np.uint64(place)  # no index counts from the end: a twentieth of a registration's time
            dx, dy, dz = x - points[k, 0], y - points[k, 1], z - points[k, 2]
            square = dx * dx + dy * dy + dz * dz
            if (square > limit) | ((label[k] >= low) & (label[k] < high)):  # one branch, which is nearly always taken
                continue
            held = insert_near(rows[k], square, near, squares, held)
            if held == count:
                limit = squares[count - 1]
