"""Multifrontal Cholesky factorisation of a sparse symmetric matrix of small square blocks, in numba.

Each supernode gathers its blocks and the updates of its children in a dense front, eliminates its rows and leaves the
Schur complement to its parent (Duff and Reid 1983; Liu 1992). Upper triangles U with U^T U = M are kept: the pivot rows
of a front are the factor's own storage, the rest is the update, on one of two stacks, so that nothing is copied. No
BLAS: its threads cost more than they bring at these sizes, and they would make results depend on their number.
"""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.block_pattern import BlockPattern
from posegraph_slam.pose_graph.dense_tile import TILE, subtract_tile, subtract_wide_tile

PANEL = 48
"""Pivot rows eliminated before the rest of a front is updated by them; a multiple of the tile."""
STRIP = 96
"""Columns of an update made at a time: a panel of them, 36 KiB, stays in the first cache."""


def factorize(
    pattern: BlockPattern, diagonal: FloatArray, off_diagonal: FloatArray, damping: float
) -> FloatArray | None:
    """Factor M + damping I given the blocks of M: `diagonal` (n, p, p) and `off_diagonal` (E, p, p) at (i, j).

    Blocks of rows that the pattern leaves out are not looked at.

    Returns the factor for `solve_factored`, or None where the matrix is not positive definite.
    """
    tree = pattern.elimination
    # Tiles reach over the end of a supernode's rows into what is written later; the last one needs room for that.
    factor = np.empty(pattern.factor_start[-1] + TILE * (pattern.largest_front + TILE))
    stacks = np.empty(pattern.stack_sizes.sum())
    positive = _factorize(
        pattern.block, tree.start, tree.row_start, tree.relative, tree.parent, pattern.side, pattern.stack_sizes,
        pattern.entry_start, pattern.entry, pattern.entry_row, pattern.entry_column, pattern.factor_start, diagonal,
        off_diagonal, damping, factor, stacks)  # fmt: skip
    return factor if positive else None


@kernel
def _subtract_rows(target: FloatArray, t: int, target_stride: int, source: FloatArray, a: int, b: int,
                   source_stride: int, depth: int, width: int) -> None:  # fmt: skip
    """Do T -= A^T B on four rows of the target from t on, A (depth, 4) and B (depth, width) within the source."""
    column = 0
    while column + 2 * TILE <= width:
        subtract_wide_tile(target, t + column, target_stride, source, a, b + column, source_stride, depth)
        column += 2 * TILE
    while column < width:
        subtract_tile(target, t + column, target_stride, source, a, b + column, source_stride, depth)
        column += TILE


@kernel
def _finish_rows(factor: FloatArray, base: int, size: int, first: int, count: int) -> bool:
    """Eliminate rows first:first+count, at most a tile, among themselves."""
    for row in range(first, first + count):
        target = factor[base + row * size + row : base + (row + 1) * size]
        for above in range(first, row):
            source = factor[base + above * size + row : base + (above + 1) * size]
            scale = source[0]
            for k in range(len(target)):
                target[k] -= scale * source[k]
        value = target[0]
        if not value > 0.0 or value == np.inf:
            return False
        scale = 1.0 / np.sqrt(value)
        for k in range(len(target)):
            target[k] *= scale
    return True


@kernel
def _eliminate(factor: FloatArray, base: int, pivots: int, size: int, update: FloatArray, top: int,
               stride: int) -> bool:  # fmt: skip
    """Eliminate the pivot rows (pivots, size) at `base` and subtract what they say of the others from the update."""
    for begin in range(0, pivots, PANEL):
        end = min(begin + PANEL, pivots)
        depth, panel = end - begin, base + begin * size
        for row in range(begin, end, TILE):
            if row > begin:
                _subtract_rows(factor, base + row * size + row, size, factor, panel + row, panel + row, size,
                               row - begin, size - row)  # fmt: skip
            if not _finish_rows(factor, base, size, row, min(TILE, end - row)):
                return False
        for row in range(end, pivots, TILE):
            _subtract_rows(factor, base + row * size + row, size, factor, panel + row, panel + row, size, depth,
                           size - row)  # fmt: skip
        for low in range(0, stride, STRIP):
            high = min(low + STRIP, stride)
            for row in range(0, high, TILE):
                left = max(low, row)
                _subtract_rows(update, top + row * stride + left, stride, factor, panel + pivots + row,
                               panel + pivots + left, size, depth, high - left)  # fmt: skip
    return True


@kernel
def _gather(p: int, first: int, last: int, entry: IntArray, entry_row: IntArray, entry_column: IntArray,
            diagonal: FloatArray, off_diagonal: FloatArray, damping: float,
            pivot_rows: FloatArray) -> None:  # fmt: skip
    """Add a supernode's own blocks to its pivot rows."""
    count = len(diagonal)
    for slot in range(first, last):
        row, column, which = entry_row[slot] * p, entry_column[slot] * p, entry[slot]
        if which < 0:
            block = off_diagonal[-1 - which - count]
            for a in range(p):
                for b in range(p):
                    pivot_rows[row + a, column + b] += block[b, a]
        else:
            block = diagonal[which] if which < count else off_diagonal[which - count]
            for a in range(p):
                for b in range(p):
                    pivot_rows[row + a, column + b] += block[a, b]
        if 0 <= which < count:
            for a in range(p):
                pivot_rows[row + a, column + a] += damping


@kernel
def _join_runs(p: int, relative: IntArray, runs: IntArray) -> int:
    """Write begin, end (3, n) of pieces of a child's rows that stay together in the parent, and where; return n."""
    found, block = 0, 0
    while block < len(relative):
        behind = block + 1
        while behind < len(relative) and relative[behind] == relative[behind - 1] + 1:
            behind += 1
        runs[0, found], runs[1, found], runs[2, found] = block * p, behind * p, relative[block] * p
        found, block = found + 1, behind
    return found


@kernel
def _add_update(runs: IntArray, count: int, child: FloatArray, pivot_rows: FloatArray, update: FloatArray) -> None:
    """Add the upper triangle of a child's update to the pivot rows and the update of its parent."""
    pivots = len(pivot_rows)
    for first in range(count):
        begin, end, place = runs[0, first], runs[1, first], runs[2, first]
        for row in range(begin, end):
            at, source = place + row - begin, child[row]
            inside = at < pivots
            target = pivot_rows[at] if inside else update[at - pivots]
            shift = at if inside else at - pivots
            piece, into = source[row:end], target[shift : shift + end - row]
            for k in range(len(piece)):
                into[k] += piece[k]
            for run in range(first + 1, count):
                shift = runs[2, run] if inside else runs[2, run] - pivots
                piece = source[runs[0, run] : runs[1, run]]
                into = target[shift : shift + len(piece)]
                for k in range(len(piece)):
                    into[k] += piece[k]


@kernel
def _factorize(p: int, start: IntArray, row_start: IntArray, relative: IntArray, parent: IntArray, side: IntArray,
               stack_sizes: IntArray, entry_start: IntArray, entry: IntArray, entry_row: IntArray,
               entry_column: IntArray, factor_start: IntArray, diagonal: FloatArray, off_diagonal: FloatArray,
               damping: float, factor: FloatArray, stacks: FloatArray) -> bool:  # fmt: skip
    supernodes = len(parent)
    top = np.zeros(2, np.int64)
    top[1] = stack_sizes[0]
    waiting = np.zeros(2, np.int64)  # how many, and which, supernodes' updates lie on each stack
    pending = np.empty((2, supernodes), np.int64)
    runs = np.empty((3, np.max(np.diff(row_start)) + 1), np.int64)
    for node in range(supernodes):
        pivots, rest = (start[node + 1] - start[node]) * p, (row_start[node + 1] - row_start[node]) * p
        mine, size, stride = side[node], pivots + rest, (rest + TILE - 1) // TILE * TILE
        base, other = factor_start[node], 1 - mine
        factor[base : base + pivots * size] = 0.0
        stacks[top[mine] : top[mine] + stride * stride] = 0.0
        pivot_rows = factor[base : base + pivots * size].reshape(pivots, size)
        update = stacks[top[mine] : top[mine] + stride * stride].reshape(stride, stride)
        _gather(p, entry_start[node], entry_start[node + 1], entry, entry_row, entry_column, diagonal, off_diagonal,
                damping, pivot_rows)  # fmt: skip
        while waiting[other] > 0 and parent[pending[other, waiting[other] - 1]] == node:
            waiting[other] -= 1
            child = pending[other, waiting[other]]
            length = ((row_start[child + 1] - row_start[child]) * p + TILE - 1) // TILE * TILE
            top[other] -= length * length
            count = _join_runs(p, relative[row_start[child] : row_start[child + 1]], runs)
            below = stacks[top[other] : top[other] + length * length].reshape(length, length)
            _add_update(runs, count, below, pivot_rows, update)
        if not _eliminate(factor, base, pivots, size, stacks, top[mine], stride):
            return False
        if rest > 0:
            top[mine] += stride * stride
            pending[mine, waiting[mine]] = node
            waiting[mine] += 1
    return True
