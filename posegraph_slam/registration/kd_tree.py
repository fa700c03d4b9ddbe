"""A balanced KD-tree in kernels, so that whole registrations run compiled; exact, and the lowest row of equals wins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, frozen, read_only
from posegraph_slam.jit import kernel
from posegraph_slam.registration.kd_search import nearest_rows, nearest_several, neighbours_of_all

LEAF = 8
"""Points in a leaf at most: 4 and 16 are slower with 1081 beams and with 6000 points in space."""


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
    rows, sorted_points, axis, value = split_points(spread)
    return KdTree(rows=frozen(rows), sorted_points=frozen(sorted_points), axis=frozen(axis), value=frozen(value))


def in_space(points: FloatArray) -> FloatArray:
    """Points (n, 3), not to be written to: those of the plane get a zero."""
    if points.shape[1] == 3:
        return read_only(points)
    padded = np.zeros((len(points), 3))
    padded[:, :2] = points
    return read_only(padded)  # always: writable arrays would compile every kernel anew


@kernel
def split_points(points: FloatArray) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
    """Order (n,) of the points (n, 3) by leaves, the points in it, and axis and value of every split.

    Splits are along the widest side, in the middle.
    """
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
    leaves = np.empty((n, 3))
    for k in range(n):
        row = order[k]
        leaves[k, 0], leaves[k, 1], leaves[k, 2] = points[row, 0], points[row, 1], points[row, 2]
    return order, leaves, axis, value


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
