"""Parts of the inverse of a factored block matrix: its diagonal blocks, and whole block columns.

The diagonal comes from Takahashi's recursion on supernodes: with J the pivots of a supernode and R the rest of its
front, Z_RJ = -Z_RR U_JR^T U_JJ^-T and Z_JJ = U_JJ^-1 U_JJ^-T - U_JJ^-1 U_JR Z_RJ, from the last supernode to the
first; Z_RR lies in the front of the parent (Erisman and Tinney 1975).
"""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.block_pattern import BlockPattern
from posegraph_slam.pose_graph.block_substitution import solve_many


def inverse_diagonal(pattern: BlockPattern, factor: FloatArray) -> FloatArray:
    """Return the diagonal blocks (n, p, p) of the inverse of a matrix factored by `factorize`, zero where left out."""
    tree = pattern.elimination
    sizes = pattern.block * (np.diff(tree.start) + np.diff(tree.row_start))
    blocks = np.empty((len(pattern.rows), pattern.block, pattern.block))
    stack = np.empty(_path_size(sizes, tree.parent))
    _inverse_diagonal(pattern.block, tree.start, tree.row_start, tree.relative, tree.parent, pattern.factor_start,
                      factor, pattern.largest_front, stack, blocks)  # fmt: skip
    result = np.zeros((pattern.count, *blocks.shape[1:]))
    result[pattern.rows] = blocks[tree.position]
    return result


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
def _inverse_diagonal(p: int, start: IntArray, row_start: IntArray, relative: IntArray, parent: IntArray,
                      factor_start: IntArray, factor: FloatArray, largest: int, stack: FloatArray,
                      blocks: FloatArray) -> None:  # fmt: skip
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
        for b in range(start[node + 1] - start[node]):
            for r in range(p):
                for c in range(p):
                    blocks[start[node] + b, r, c] = Z[b * p + r, b * p + c]
