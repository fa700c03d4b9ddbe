"""Solving with a factor of `block_cholesky`: one right-hand side, or many at once."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.block_pattern import BlockPattern


def solve_factored(pattern: BlockPattern, factor: FloatArray, right: FloatArray) -> FloatArray:
    """Solve for the right-hand side (n, p) with a factor of `factorize`; rows that are left out get zero."""
    tree = pattern.elimination
    x, result = np.empty((len(pattern.rows), pattern.block)), np.zeros((pattern.count, pattern.block))
    _copy_rows(pattern.rows, tree.position, right, x)
    front = np.empty(pattern.largest_front)
    _substitute(
        pattern.block, tree.start, tree.row_start, tree.rows, pattern.factor_start, factor, x.reshape(-1), front
    )
    _copy_rows(tree.position, pattern.rows, x, result)
    return result


def solve_many(pattern: BlockPattern, factor: FloatArray, right: FloatArray) -> FloatArray:
    """Solve for right-hand sides (n, p, m); rows that are left out get zero."""
    tree, many = pattern.elimination, right.shape[2]
    x, result = np.empty((len(pattern.rows), pattern.block * many)), np.zeros(right.shape)
    _copy_rows(pattern.rows, tree.position, right.reshape(len(right), -1), x)
    flat = x.reshape(-1, many)
    _substitute_many(pattern.block, tree.start, tree.row_start, tree.rows, pattern.factor_start, factor, flat)
    _copy_rows(tree.position, pattern.rows, x, result.reshape(len(right), -1))
    return result


@kernel
def _copy_rows(origin: IntArray, place: IntArray, source: FloatArray, target: FloatArray) -> None:
    """Do target[place] = source[origin]."""
    for k in range(len(origin)):
        from_row, to_row = source[origin[k]], target[place[k]]
        for m in range(len(from_row)):
            to_row[m] = from_row[m]


@kernel
def _substitute(p: int, start: IntArray, row_start: IntArray, rows: IntArray, factor_start: IntArray,
                factor: FloatArray, x: FloatArray, front: FloatArray) -> None:  # fmt: skip
    """Solve U^T y = x, then U x = y, in place; `front` holds the part of x that a supernode touches."""
    supernodes = len(start) - 1
    for node in range(supernodes):
        base, pivots = start[node] * p, (start[node + 1] - start[node]) * p
        below = rows[row_start[node] : row_start[node + 1]]
        size = pivots + len(below) * p
        part = front[:size]
        for k in range(pivots):
            part[k] = x[base + k]
        for k in range(pivots, size):
            part[k] = 0.0
        for row in range(pivots):
            at = factor_start[node] + row * size
            value = part[row] / factor[at + row]
            x[base + row] = value
            source, target = factor[at + row : at + size], part[row:size]
            for k in range(len(source)):
                target[k] -= value * source[k]
        for r in range(len(below)):
            for a in range(p):
                x[below[r] * p + a] += part[pivots + r * p + a]
    for node in range(supernodes - 1, -1, -1):
        base, pivots = start[node] * p, (start[node + 1] - start[node]) * p
        below = rows[row_start[node] : row_start[node + 1]]
        size = pivots + len(below) * p
        part = front[:size]
        for k in range(pivots):
            part[k] = x[base + k]
        for r in range(len(below)):
            for a in range(p):
                part[pivots + r * p + a] = x[below[r] * p + a]
        for row in range(pivots - 1, -1, -1):
            at = factor_start[node] + row * size
            source, known = factor[at + row + 1 : at + size], part[row + 1 : size]
            first, second, third, fourth, k = 0.0, 0.0, 0.0, 0.0, 0  # four sums: one would wait for itself
            while k + 4 <= len(source):
                first += source[k] * known[k]
                second += source[k + 1] * known[k + 1]
                third += source[k + 2] * known[k + 2]
                fourth += source[k + 3] * known[k + 3]
                k += 4
            while k < len(source):
                first += source[k] * known[k]
                k += 1
            part[row] = (part[row] - ((first + second) + (third + fourth))) / factor[at + row]
            x[base + row] = part[row]


@kernel
def _substitute_many(p: int, start: IntArray, row_start: IntArray, rows: IntArray, factor_start: IntArray,
                     factor: FloatArray, x: FloatArray) -> None:  # fmt: skip
    """Solve in place for many right-hand sides x (n * p, m)."""
    supernodes, many = len(start) - 1, x.shape[1]
    for node in range(supernodes):
        base, pivots = start[node] * p, (start[node + 1] - start[node]) * p
        below = rows[row_start[node] : row_start[node + 1]]
        U = factor[factor_start[node] : factor_start[node + 1]].reshape(pivots, pivots + len(below) * p)
        for row in range(pivots):
            source, scale = x[base + row], 1.0 / U[row, row]
            for m in range(many):
                source[m] *= scale
            for k in range(row + 1, U.shape[1]):
                scale = U[row, k]
                target = x[base + k] if k < pivots else x[below[(k - pivots) // p] * p + (k - pivots) % p]
                for m in range(many):
                    target[m] -= scale * source[m]
    for node in range(supernodes - 1, -1, -1):
        base, pivots = start[node] * p, (start[node + 1] - start[node]) * p
        below = rows[row_start[node] : row_start[node + 1]]
        U = factor[factor_start[node] : factor_start[node + 1]].reshape(pivots, pivots + len(below) * p)
        for row in range(pivots - 1, -1, -1):
            target = x[base + row]
            for k in range(row + 1, U.shape[1]):
                scale = U[row, k]
                source = x[base + k] if k < pivots else x[below[(k - pivots) // p] * p + (k - pivots) % p]
                for m in range(many):
                    target[m] -= scale * source[m]
            scale = 1.0 / U[row, row]
            for m in range(many):
                target[m] *= scale
