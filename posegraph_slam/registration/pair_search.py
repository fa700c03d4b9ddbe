"""Association and rejection of the compiled loop."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import inline_kernel, kernel
from posegraph_slam.registration.kd_search import STACK, insert_near, search_near, square_between
from posegraph_slam.registration.selection import one_by_order

KNOWN = 4
"""Targets that are remembered for a source point: with two, twice as many searches are left (181 beams)."""

LISTED = 10
"""Neighbours of the partner that are looked at: more cost more than a search."""


@kernel
def nothing_known(count: int) -> tuple[IntArray, FloatArray, FloatArray]:
    """What `pair_nearest` remembers of `count` source points, before the first search: known, reach and moved."""
    return np.full((count, KNOWN), -1, dtype=np.int64), np.zeros((count, 2)), np.zeros((count, 3))


@kernel
def pair_nearest(
    T: FloatArray, source: FloatArray, target: FloatArray, rows: IntArray, leaves: FloatArray, axis: IntArray,
    value: FloatArray, neighbours: IntArray, gate: float, known: IntArray, reach: FloatArray, moved: FloatArray,
    s: IntArray, t: IntArray, square: FloatArray,
) -> int:  # fmt: skip
    """Move the source and pair it with the nearest targets within the gate; number of pairs.

    `known` (n, KNOWN) are the nearest targets of the last search, -1 for none. `reach` (n, 2) is how near any target
    but the first of them, and any that is not among them, may be: the distances at the search, less all motion since.
    While the partner is nearer than the one, or one of the known than the other, nothing needs to be searched
    (triangle inequality, as in Elkan 2003 for clusters). Else the neighbours (m, k) of the partner are looked at, where
    they are known of all targets: what is not among them is beyond the farthest. The tree is searched last.
    """
    count, limit, linked = 0, gate * gate, len(neighbours) == len(target) and neighbours.shape[1] >= KNOWN
    stack, bounds = np.zeros((STACK, 3), dtype=np.int64), np.zeros((STACK, 4))
    near, squares = np.empty(KNOWN, dtype=np.int64), np.empty(KNOWN)
    for k in range(len(source)):
        x = T[0, 0] * source[k, 0] + T[0, 1] * source[k, 1] + T[0, 2] * source[k, 2] + T[0, 3]
        y = T[1, 0] * source[k, 0] + T[1, 1] * source[k, 1] + T[1, 2] * source[k, 2] + T[1, 3]
        z = T[2, 0] * source[k, 0] + T[2, 1] * source[k, 1] + T[2, 2] * source[k, 2] + T[2, 3]
        u, v, w = x - moved[k, 0], y - moved[k, 1], z - moved[k, 2]
        moved[k, 0], moved[k, 1], moved[k, 2] = x, y, z
        best, first = known[k, 0], np.inf
        if best >= 0:
            step = np.sqrt(u * u + v * v + w * w)
            reach[k, 0] -= step
            reach[k, 1] -= step
            first = (x - target[best, 0]) ** 2 + (y - target[best, 1]) ** 2 + (z - target[best, 2]) ** 2
        if not (reach[k, 0] > 0 and first < reach[k, 0] ** 2 * (1 - 1e-12)):
            # neighbours in a scan are most often neighbours in space: one that knows nothing begins with the last's
            like = k if best >= 0 or k == 0 else k - 1
            held = rank_rows(x, y, z, target, known, like, near, squares)
            within = reach[k, 1] if like == k else 0.0
            if linked and held > 0 and not (within > 0 and squares[0] < within**2 * (1 - 1e-12)):
                at, farthest = near[0], neighbours[near[0], min(neighbours.shape[1], LISTED) - 1]
                within = np.sqrt(square_between(target, at, farthest)) - np.sqrt(squares[0])
                held = rank_rows(x, y, z, target, neighbours, at, near, squares)
                reach[k, 1] = min(within, np.sqrt(squares[KNOWN - 1]))
            if not (held > 0 and within > 0 and squares[0] < within**2 * (1 - 1e-12)):
                bound = min(limit, squares[KNOWN - 1]) if held == KNOWN else limit
                held = search_near(x, y, z, rows, leaves, axis, value, bound, near, squares, stack, bounds)
                reach[k, 1] = np.sqrt(squares[KNOWN - 1] if held == KNOWN else bound)
            reach[k, 0] = min(np.sqrt(squares[1]), reach[k, 1]) if held > 1 else reach[k, 1]
            for j in range(KNOWN):
                known[k, j] = near[j] if j < held else -1
            best, first = known[k, 0], squares[0]
        if best >= 0 and first <= limit:
            s[count], t[count], square[count] = k, best, first
            count += 1
    return count


@inline_kernel
def rank_rows(
    x: float, y: float, z: float, target: FloatArray, table: IntArray, row: int, near: IntArray, squares: FloatArray
) -> int:
    """Write the targets in a row of a table, -1 for none, by their squared distance from (x, y, z); their number."""
    held = 0
    for j in range(min(table.shape[1], LISTED)):
        at = table[row, j]
        if at >= 0:
            dx, dy, dz = x - target[at, 0], y - target[at, 1], z - target[at, 2]
            held = insert_near(at, dx * dx + dy * dy + dz * dz, near, squares, held)
    return held


@kernel
def with_normals(d: int, normals: FloatArray, s: IntArray, t: IntArray, square: FloatArray, count: int) -> int:
    """Keep the pairs whose target has a normal; number of them."""
    kept = 0
    for k in range(count):
        size = 0.0
        for a in range(d):
            size += abs(normals[t[k], a])
        if size > 0:
            s[kept], t[kept], square[kept] = s[k], t[k], square[k]
            kept += 1
    return kept


@kernel
def trim(keep: float, s: IntArray, t: IntArray, square: FloatArray, count: int) -> int:
    """Keep the nearest share of the pairs, of equals the first; number of them."""
    wanted = min(max(int(np.round(keep * count)), 1), count)
    limit = one_by_order(square, count, wanted)
    nearer = 0
    for k in range(count):
        nearer += square[k] < limit
    ties, kept = wanted - nearer, 0
    for k in range(count):
        tied = square[k] == limit
        if square[k] < limit or (tied and ties > 0):
            ties -= tied
            s[kept], t[kept], square[kept] = s[k], t[k], square[k]
            kept += 1
    return kept
