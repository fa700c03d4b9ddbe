"""A balanced KD-tree in kernels, so that whole registrations run compiled; exact, and the lowest row of equals wins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.jit import inline_kernel, kernel

LEAF = 8
"""Points in a leaf at most: 4 and 16 are slower with 1081 beams and with 6000 points in space."""

STACK = 64
"""Deepest stack of a search: one entry a level, and 2^60 points do not fit any memory."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KdTree:
    """Points (n, d) by halves: `rows` (n,) in the order of the leaves, `sorted_points` (n, 3) in that order.

    In the plane the third coordinate is zero. Node i splits its range in the middle, at `value[i]` along `axis[i]`;
    its halves are nodes 2i+1 and 2i+2.
    """

    rows: IntArray
    sorted_points: FloatArray
    axis: IntArray
    value: FloatArray

    def nearest(self, queries: FloatArray, max_distance_m: float = np.inf) -> tuple[IntArray, FloatArray]:
        """Row of the point nearest to each query (m, d), and its distance (m,); -1 and infinity beyond the gate."""
        return nearest_rows(in_space(queries), self.rows, self.sorted_points, self.axis, self.value, max_distance_m)

    def neighbours(self, queries: FloatArray, count: int) -> IntArray:
        """Rows (m, count) of the points nearest to each query (m, d), nearest first; `count` at most all points."""
        return nearest_several(in_space(queries), self.rows, self.sorted_points, self.axis, self.value, count)

    def neighbours_of_all(self, count: int) -> IntArray:
        """Rows (n, count) of the points nearest to each of the tree's own, nearest first; `count` at most n."""
        return neighbours_of_all(self.rows, self.sorted_points, self.axis, self.value, count)


def build_kd_tree(points: FloatArray) -> KdTree:
    """Build the tree of finite points (n, 2) or (n, 3)."""
    spread = in_space(points)
    rows, axis, value = split_points(spread)
    return KdTree(rows=rows, sorted_points=spread[rows], axis=axis, value=value)


def in_space(points: FloatArray) -> FloatArray:
    """Points (n, 3), not to be written to: those of the plane get a zero."""
    if points.shape[1] == 3:
        return read_only(points)
    padded = np.zeros((len(points), 3))
    padded[:, :2] = points
    return read_only(padded)  # always: writable arrays would compile every kernel anew


@kernel
def split_points(points: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Order (n,) of the points by leaves, and axis and value of every split: along the widest side, in the middle."""
    n = len(points)
    levels = 0
    while (n >> levels) > LEAF:
        levels += 1
    nodes = (1 << levels) - 1
    order, axis, value = np.arange(n), np.zeros(nodes, dtype=np.int64), np.zeros(nodes)
    low, high = np.zeros(2 * nodes + 1, dtype=np.int64), np.zeros(2 * nodes + 1, dtype=np.int64)
    high[0] = n
    for node in range(nodes):
        start, stop = low[node], high[node]
        middle = (start + stop) // 2
        widest, a = -1.0, 0
        for b in range(3):
            least, most = np.inf, -np.inf
            for k in range(start, stop):
                least, most = min(least, points[order[k], b]), max(most, points[order[k], b])
            if most - least > widest:
                widest, a = most - least, b
        select_middle(order, points, a, start, stop, middle)
        axis[node], value[node] = a, points[order[middle], a]
        low[2 * node + 1], high[2 * node + 1] = start, middle
        low[2 * node + 2], high[2 * node + 2] = middle, stop
    return order, axis, value


@kernel
def select_middle(order: IntArray, points: FloatArray, a: int, start: int, stop: int, middle: int) -> None:
    """Reorder rows start..stop so that the one at `middle` is where sorting along axis a would put it (Hoare 1961)."""
    left, right = start, stop - 1
    while left < right:
        pivot = points[order[(left + right) // 2], a]
        i, j = left, right
        while i <= j:
            while points[order[i], a] < pivot:
                i += 1
            while points[order[j], a] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            right = j
        elif middle >= i:
            left = i
        else:
            return


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
        beyond = square - offset * offset + gap * gap
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
def nearest_two(
    x: float, y: float, z: float, rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray,
    best: int, best_square: float, second: int, second_square: float, stack: IntArray, bounds: FloatArray,
) -> tuple[int, float, int, float]:  # fmt: skip
    """Rows and squared distances of the points nearest and second nearest to (x, y, z).

    Only points up to `second_square` count. Known points may be given to start from, the nearer one first; -1 with
    the limit where none is known, which also come back where none is found.
    """
    top = begin_walk(len(rows), stack, bounds)
    while True:
        start, stop, top = next_leaf(x, y, z, second_square, axis, value, top, stack, bounds)
        if start < 0:
            return best, best_square, second, second_square
        for k in range(start, stop):
            dx, dy, dz = x - points[k, 0], y - points[k, 1], z - points[k, 2]
            square = dx * dx + dy * dy + dz * dz
            if square > second_square:
                continue
            row = rows[k]
            known = row in (best, second)
            if known:
                continue
            if square < best_square or (square == best_square and (best < 0 or row < best)):
                second, second_square = best, best_square
                best, best_square = row, square
            else:
                second, second_square = row, square


@kernel
def nearest_rows(
    queries: FloatArray, rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray, gate: float
) -> tuple[IntArray, FloatArray]:
    """Nearest row and distance of every query (m, 3) within the gate, which is inside."""
    m, limit = len(queries), gate * gate
    found, distance = np.full(m, -1, dtype=np.int64), np.full(m, np.inf)
    stack, bounds = np.zeros((STACK, 3), dtype=np.int64), np.zeros((STACK, 4))
    for q in range(m):
        row, square, _, _ = nearest_two(queries[q, 0], queries[q, 1], queries[q, 2], rows, points, axis, value,
                                        -1, limit, -1, limit, stack, bounds)  # fmt: skip
        found[q] = row
        if row >= 0:
            distance[q] = np.sqrt(square)
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
        search_near(queries[q, 0], queries[q, 1], queries[q, 2], rows, points, axis, value, 0, 0, near, squares,
                    stack, bounds)  # fmt: skip
        for j in range(count):  # an assignment of the whole row takes 0.5 us
            found[q, j] = near[j]
    return found


@kernel
def neighbours_of_all(
    rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray, count: int
) -> IntArray:  # fmt: skip
    """Rows (n, count) nearest to each of the tree's own points, itself among them.

    Each search starts from the points beside its own in the order of the leaves: in the plane twice as fast.
    """
    n = len(rows)
    found, squares, near = np.empty((n, count), dtype=np.int64), np.empty(count), np.empty(count, dtype=np.int64)
    stack, bounds = np.zeros((STACK, 3), dtype=np.int64), np.zeros((STACK, 4))
    for q in range(n):
        low = max(0, min(q - count // 2, n - count))
        search_near(points[q, 0], points[q, 1], points[q, 2], rows, points, axis, value, low, min(low + count, n),
                    near, squares, stack, bounds)  # fmt: skip
        for j in range(count):
            found[rows[q], j] = near[j]
    return found


@kernel
def search_near(
    x: float, y: float, z: float, rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray,
    low: int, high: int, near: IntArray, squares: FloatArray, stack: IntArray, bounds: FloatArray,
) -> None:  # fmt: skip
    """Write the rows nearest to (x, y, z) to `near` (count,); points low..high of the leaves are looked at first."""
    held, count = 0, len(near)
    for k in range(low, high):
        dx, dy, dz = x - points[k, 0], y - points[k, 1], z - points[k, 2]
        held = insert_near(rows[k], dx * dx + dy * dy + dz * dz, near, squares, held)
    limit = squares[count - 1] if held == count else np.inf
    top = begin_walk(len(rows), stack, bounds)
    while True:
        start, stop, top = next_leaf(x, y, z, limit, axis, value, top, stack, bounds)
        if start < 0:
            return
        for k in range(start, stop):
            if k >= low and k < high:
                continue
            dx, dy, dz = x - points[k, 0], y - points[k, 1], z - points[k, 2]
            square = dx * dx + dy * dy + dz * dz
            if square > limit:
                continue
            held = insert_near(rows[k], square, near, squares, held)
            if held == count:
                limit = squares[count - 1]
