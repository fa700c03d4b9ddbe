"""A balanced KD-tree in kernels, so that whole registrations run compiled; exact, and the lowest row of equals wins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.jit import kernel

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


@kernel
def nearest_two(
    x: float, y: float, z: float, rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray,
    best: int, best_square: float, limit: float, stack: IntArray, bounds: FloatArray,
) -> tuple[int, float, float]:  # fmt: skip
    """Row and squared distance of the point nearest to (x, y, z), and the squared distance of all others at least.

    Only points up to the squared distance `limit` count. `best` and `best_square` may name one of them to start from;
    -1 and `limit` if none is known. `stack` (STACK, 3) and `bounds` (STACK, 4) are scratch: node and range, and square
    and offsets of its box.
    """
    nodes, top, second = len(axis), 0, limit
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, 0, len(rows)
    bounds[0, 0] = bounds[0, 1] = bounds[0, 2] = bounds[0, 3] = 0.0
    while top >= 0:
        node, start, stop = stack[top, 0], stack[top, 1], stack[top, 2]
        square, ox, oy, oz = bounds[top, 0], bounds[top, 1], bounds[top, 2], bounds[top, 3]
        top -= 1
        if square > second:
            continue
        while node < nodes:
            a, middle = axis[node], (start + stop) // 2
            gap = (x if a == 0 else (y if a == 1 else z)) - value[node]
            offset = ox if a == 0 else (oy if a == 1 else oz)
            beyond = square - offset * offset + gap * gap
            if beyond <= second:
                top += 1
                bounds[top, 0] = beyond
                bounds[top, 1] = gap if a == 0 else ox
                bounds[top, 2] = gap if a == 1 else oy
                bounds[top, 3] = gap if a == 2 else oz
                if gap < 0:
                    stack[top, 0], stack[top, 1], stack[top, 2] = 2 * node + 2, middle, stop
                else:
                    stack[top, 0], stack[top, 1], stack[top, 2] = 2 * node + 1, start, middle
            if gap < 0:
                node, stop = 2 * node + 1, middle
            else:
                node, start = 2 * node + 2, middle
        for k in range(start, stop):
            dx, dy, dz = x - points[k, 0], y - points[k, 1], z - points[k, 2]
            distance = dx * dx + dy * dy + dz * dz
            if distance > second or rows[k] == best:
                continue
            if distance < best_square or (distance == best_square and (best < 0 or rows[k] < best)):
                second = best_square
                best, best_square = rows[k], distance
            else:
                second = distance
    return best, best_square, second


@kernel
def nearest_rows(
    queries: FloatArray, rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray, gate: float
) -> tuple[IntArray, FloatArray]:
    """Nearest row and distance of every query (m, 3) within the gate, which is inside."""
    m = len(queries)
    found, distance = np.full(m, -1, dtype=np.int64), np.full(m, np.inf)
    stack, bounds = np.zeros((STACK, 3), dtype=np.int64), np.zeros((STACK, 4))
    for q in range(m):
        row, square, _ = nearest_two(queries[q, 0], queries[q, 1], queries[q, 2], rows, points, axis, value,
                                     -1, gate * gate, gate * gate, stack, bounds)  # fmt: skip
        found[q] = row
        if row >= 0:
            distance[q] = np.sqrt(square)
    return found, distance


@kernel
def nearest_several(
    queries: FloatArray, rows: IntArray, points: FloatArray, axis: IntArray, value: FloatArray, count: int
) -> IntArray:
    """Rows (m, count) nearest to every query (m, 3), by distance, then by row."""
    m, nodes = len(queries), len(axis)
    found = np.full((m, count), -1, dtype=np.int64)
    squares = np.empty(count)
    stack, bounds = np.zeros((STACK, 3), dtype=np.int64), np.zeros((STACK, 4))
    for q in range(m):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        squares[:] = np.inf
        top = 0
        stack[0, 0], stack[0, 1], stack[0, 2] = 0, 0, len(rows)
        bounds[0, 0] = bounds[0, 1] = bounds[0, 2] = bounds[0, 3] = 0.0
        while top >= 0:
            node, start, stop = stack[top, 0], stack[top, 1], stack[top, 2]
            square, ox, oy, oz = bounds[top, 0], bounds[top, 1], bounds[top, 2], bounds[top, 3]
            top -= 1
            if square > squares[count - 1]:
                continue
            while node < nodes:
                a, middle = axis[node], (start + stop) // 2
                gap = (x if a == 0 else (y if a == 1 else z)) - value[node]
                offset = ox if a == 0 else (oy if a == 1 else oz)
                beyond = square - offset * offset + gap * gap
                if beyond <= squares[count - 1]:
                    top += 1
                    bounds[top, 0] = beyond
                    bounds[top, 1] = gap if a == 0 else ox
                    bounds[top, 2] = gap if a == 1 else oy
                    bounds[top, 3] = gap if a == 2 else oz
                    if gap < 0:
                        stack[top, 0], stack[top, 1], stack[top, 2] = 2 * node + 2, middle, stop
                    else:
                        stack[top, 0], stack[top, 1], stack[top, 2] = 2 * node + 1, start, middle
                if gap < 0:
                    node, stop = 2 * node + 1, middle
                else:
                    node, start = 2 * node + 2, middle
            for k in range(start, stop):
                dx, dy, dz = x - points[k, 0], y - points[k, 1], z - points[k, 2]
                distance, row = dx * dx + dy * dy + dz * dz, rows[k]
                if distance > squares[count - 1]:
                    continue
                at = count
                while at > 0 and (
                    distance < squares[at - 1]
                    or (distance == squares[at - 1] and (found[q, at - 1] < 0 or row < found[q, at - 1]))
                ):
                    at -= 1
                if at == count:
                    continue
                for j in range(count - 1, at, -1):
                    squares[j], found[q, j] = squares[j - 1], found[q, j - 1]
                squares[at], found[q, at] = distance, row
    return found
