"""Association and rejection of the compiled loop."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.kd_tree import STACK, nearest_two


@kernel
def nothing_known(count: int) -> tuple[IntArray, FloatArray, FloatArray]:
    """What `pair_nearest` remembers of `count` source points, before the first search: known, spare and moved."""
    return np.full((count, 2), -1, dtype=np.int64), np.zeros(count), np.zeros((count, 3))


@kernel
def pair_nearest(
    T: FloatArray, source: FloatArray, target: FloatArray, rows: IntArray, leaves: FloatArray, axis: IntArray,
    value: FloatArray, gate: float, known: IntArray, spare: FloatArray, moved: FloatArray, s: IntArray, t: IntArray,
    square: FloatArray,
) -> int:  # fmt: skip
    """Move the source and pair it with the nearest targets within the gate; number of pairs.

    `known` (n, 2) are the nearest and second nearest targets of the last search, -1 for none. `spare` (n,) is how near
    any target but the nearest may be: the distance of the second when it was searched, less all motion since. While
    the partner is nearer than that nothing needs to be searched (triangle inequality, as in Elkan 2003 for clusters);
    else both start the search.
    """
    count, limit = 0, gate * gate
    stack, bounds = np.zeros((STACK, 3), dtype=np.int64), np.zeros((STACK, 4))
    for k in range(len(source)):
        x = T[0, 0] * source[k, 0] + T[0, 1] * source[k, 1] + T[0, 2] * source[k, 2] + T[0, 3]
        y = T[1, 0] * source[k, 0] + T[1, 1] * source[k, 1] + T[1, 2] * source[k, 2] + T[1, 3]
        z = T[2, 0] * source[k, 0] + T[2, 1] * source[k, 1] + T[2, 2] * source[k, 2] + T[2, 3]
        u, v, w = x - moved[k, 0], y - moved[k, 1], z - moved[k, 2]
        moved[k, 0], moved[k, 1], moved[k, 2] = x, y, z
        best, first = -1, limit
        if known[k, 0] >= 0:
            at = known[k, 0]
            now = (x - target[at, 0]) ** 2 + (y - target[at, 1]) ** 2 + (z - target[at, 2]) ** 2
            if now <= limit:
                best, first = at, now
            spare[k] -= np.sqrt(u * u + v * v + w * w)
        if best < 0 or not (spare[k] > 0 and first < spare[k] ** 2 * (1 - 1e-12)):
            second, next_best = -1, limit
            if best >= 0 and known[k, 1] >= 0:
                at = known[k, 1]
                now = (x - target[at, 0]) ** 2 + (y - target[at, 1]) ** 2 + (z - target[at, 2]) ** 2
                if now < first or (now == first and at < best):
                    best, first, second, next_best = at, now, best, first
                elif now <= limit:
                    second, next_best = at, now
            best, first, second, next_best = nearest_two(x, y, z, rows, leaves, axis, value, best, first, second,
                                                         next_best, stack, bounds)  # fmt: skip
            known[k, 0], known[k, 1] = best, second
            spare[k] = np.sqrt(next_best)
        if best >= 0:
            s[count], t[count], square[count] = k, best, first
            count += 1
    return count


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
    limit = np.partition(square[:count], wanted - 1)[wanted - 1]
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
