"""Parts of the inverse of a factored block matrix: the blocks within its pattern, and whole block columns.

The first come from Takahashi's recursion on supernodes: with J the pivots of a supernode and R the rest of its
front, Z_RJ = -Z_RR U_JR^T U_JJ^-T and Z_JJ = U_JJ^-1 U_JJ^-T - U_JJ^-1 U_JR Z_RJ, from the last supernode to the
first; Z_RR lies in the front of the parent (Erisman and Tinney 1975).
"""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.block_pattern import BlockPattern
from posegraph_slam.pose_graph.block_substitution import solve_many


def inverse_blocks(pattern: BlockPattern, factor: FloatArray, edges: int) -> tuple[FloatArray, FloatArray]:
    """Return the blocks of the inverse of a matrix factored by `factorize` where the matrix has its own.

    These are the diagonal ones (n, p, p) and those at (i, j) (`edges`, p, p), as many as the pattern was made of; zero
    where a row is left out.
    """
    tree, p = pattern.elimination, pattern.block
    sizes = p * (np.diff(tree.start) + np.diff(tree.row_start))
    diagonal, off = np.zeros((pattern.count, p, p)), np.zeros((edges, p, p))
    stack = np.empty(_path_size(sizes, tree.parent))
    _inverse_blocks(p, tree.start, tree.row_start, tree.relative, tree.parent, pattern.factor_start, factor,
                    pattern.entry_start, pattern.entry, pattern.entry_row, pattern.entry_column,
                    pattern.largest_front, stack, diagonal, off)  # fmt: skip
    return diagonal, off


def inverse_columns(pattern: BlockPattern, factor: FloatArray, rows: IntArray) -> FloatArray:
    """Return the block columns (n, p, K, p) of the inverse that belong to block rows `rows` (K,)."""
    p = pattern.block
    right = np.zeros((pattern.count, p, len(rows), p))
    for k in range(p):
        right[rows, k, np.arange(len(rows)), k] = 1.0
    return solve_many(pattern, factor, right.reshape(pattern.count, p, -1)).reshape(right.shape)


@kernel
def _path_size(sizes: IntArray, parent: IntArray) -> int:
    """Return the most entries of all fronts between a supernode and its root."""
    total, most = np.zeros(len(sizes), np.int64), 0
    for node in range(len(sizes) - 1, -1, -1):
        total[node] = sizes[node] ** 2 + (total[parent[node]] if parent[node] >= 0 else 0)
        most = max(most, total[node])
    return most


@kernel
def _inverse_blocks(p: int, start: IntArray, row_start: IntArray, relative: IntArray, parent: IntArray,
                    factor_start: IntArray, factor: FloatArray, entry_start: IntArray, entry: IntArray,
                    entry_row: IntArray, entry_column: IntArray, largest: int, stack: FloatArray,
                    diagonal: FloatArray, off: FloatArray) -> None:  # fmt: skip
    supernodes = len(parent)
    offset = np.zeros(supernodes, np.int64)  # where the inverse of each front on the path begins
    column, where = np.empty(largest), np.empty(largest, np.int64)
    for node in range(supernodes - 1, -1, -1):
        pivots, rest = (start[node + 1] - start[node]) * p, (row_start[node + 1] - row_start[node]) * p
        size, above = pivots + rest, parent[node]
        U = factor[factor_start[node] : factor_start[node + 1]].reshape(pivots, size)
        offset[node] = 0
        if above >= 0:
            upper = (start[above + 1] - start[above] + row_start[above + 1] - row_start[above]) * p
            offset[node] = offset[above] + upper * upper
        Z = stack[offset[node] : offset[node] + size * size].reshape(size, size)
        if above >= 0:
            outer = stack[offset[above] : offset[above] + upper * upper].reshape(upper, upper)
            for r in range(rest // p):
                for a in range(p):
                    where[r * p + a] = relative[row_start[node] + r] * p + a
            for r in range(rest):
                source, target = outer[where[r]], Z[pivots + r]
                for c in range(rest):
                    target[pivots + c] = source[where[c]]
        # Column by column from the last pivot: all of Z below and right of it is known by then.
        for k in range(pivots - 1, -1, -1):
            scale = 1.0 / U[k, k]
            for row in range(k + 1, size):
                column[row] = U[k, row] * scale
            result, count = Z[k, k + 1 : size], size - k - 1
            for m in range(count):
                result[m] = 0.0
            for row in range(k + 1, size):  # Z is symmetric: sums of its rows, which LLVM vectorises
                weight, source = column[row], Z[row, k + 1 : size]
                for m in range(count):
                    result[m] -= weight * source[m]
            total = scale * scale
            for m in range(count):
                total -= result[m] * column[k + 1 + m]
                Z[k + 1 + m, k] = result[m]
            Z[k, k] = total
        for slot in range(entry_start[node], entry_start[node + 1]):
            top, left, which = entry_row[slot] * p, entry_column[slot] * p, entry[slot]
            for r in range(p):
                for c in range(p):
                    if which < 0:
                        off[-1 - which - len(diagonal), c, r] = Z[top + r, left + c]
                    elif which < len(diagonal):
                        diagonal[which, r, c] = Z[top + r, left + c]
                    else:
                        off[which - len(diagonal), r, c] = Z[top + r, left + c]
