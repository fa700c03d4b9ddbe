"""Multifrontal Cholesky factorisation of a sparse symmetric matrix of small square blocks, in numba.

Each supernode gathers its blocks and the updates of its children in a dense front, eliminates its columns and hands
the Schur complement to its parent by way of a stack (Duff and Reid 1983; Liu 1992). Small fronts, the rule in the
plane, are worked on in plain loops; large ones, the rule in space, by products of panels that stay in cache. No BLAS:
its threads cost more than they bring at these sizes, tenfold where other processes share the cores, and they would
make the result depend on their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.elimination import Elimination, analyze

PANEL = 32
"""Columns eliminated before the rest of a front is updated by one matrix product."""
STRIP = 128
"""Columns of that product made at a time: a panel of 32 rows of them, 32 KiB, stays in the first cache."""
PRODUCT_ROWS = 48
"""Fronts with fewer rows to update stay in plain loops: setting up the product costs more than it saves."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlockPattern:
    """Where the blocks of a symmetric matrix stand: n diagonal blocks and off-diagonal ones at (i, j), (E,) each.

    Off-diagonal blocks may repeat a place; they add up.
    """

    block: int
    elimination: Elimination
    entry_start: IntArray
    """Entries of each supernode (S+1,)."""
    entry: IntArray
    """Which block: below n a diagonal one, from n on off-diagonal ones; -1 - number: to be transposed."""
    entry_row: IntArray
    entry_column: IntArray
    factor_start: IntArray
    """Where the columns of each supernode begin in the factor's storage (S+1,)."""
    largest_front: int
    stack_size: int

    @property
    def size(self) -> int:
        """Number of block rows."""
        return len(self.elimination.position)


def block_pattern(count: int, i: IntArray, j: IntArray, block: int) -> BlockPattern:
    """Analyse a matrix of `count` block rows with off-diagonal blocks at (i, j) (E,), i != j."""
    tree = analyze(count, i, j, block)
    here, there = tree.position[i], tree.position[j]
    column = np.concatenate([tree.position, np.minimum(here, there)])
    row = np.concatenate([tree.position, np.maximum(here, there)])
    number = np.arange(count + len(i))
    number[count:] = np.where(here > there, number[count:], -1 - number[count:])
    order = np.argsort(column, kind="stable")
    column, row, number = column[order], row[order], number[order]
    owner = tree.owner[column]
    width, below = np.diff(tree.start), np.diff(tree.row_start)
    sizes = (width + below) * width * block**2
    return BlockPattern(
        block=block,
        elimination=tree,
        entry_start=np.searchsorted(owner, np.arange(len(width) + 1)),
        entry=number,
        entry_row=_front_rows(row, owner, tree.start, tree.row_start, tree.rows),
        entry_column=column - tree.start[owner],
        factor_start=np.concatenate([[0], np.cumsum(sizes)]),
        largest_front=int((width + below).max()) * block,
        stack_size=_stack_size(below * block, tree.parent),
    )


def factorize(
    pattern: BlockPattern, diagonal: FloatArray, off_diagonal: FloatArray, damping: float
) -> FloatArray | None:
    """Factor M + damping I given the blocks of M: `diagonal` (n, p, p) and `off_diagonal` (E, p, p) at (i, j).

    Returns the factor for `solve_factored`, or None where the matrix is not positive definite.
    """
    tree, factor = pattern.elimination, np.empty(pattern.factor_start[-1])
    front = np.empty(pattern.largest_front**2)
    stack = np.empty(pattern.stack_size)
    panel = np.empty(2 * pattern.largest_front * PANEL)
    positive = _factorize(
        pattern.block, tree.start, tree.row_start, tree.relative, tree.parent, pattern.entry_start, pattern.entry,
        pattern.entry_row, pattern.entry_column, pattern.factor_start, diagonal, off_diagonal, damping,
        factor, front, stack, panel)  # fmt: skip
    return factor if positive else None


def solve_factored(pattern: BlockPattern, factor: FloatArray, right: FloatArray) -> FloatArray:
    """Solve for the right-hand side (n, p) with a factor of `factorize`."""
    tree = pattern.elimination
    x = np.empty_like(right)
    x[tree.position] = right
    flat = x.reshape(-1)
    _substitute(pattern.block, tree.start, tree.row_start, tree.rows, pattern.factor_start, factor, flat)
    return np.asarray(x[tree.position])


@kernel
def _front_rows(row: IntArray, owner: IntArray, start: IntArray, row_start: IntArray, rows: IntArray) -> IntArray:
    """Return the block row of each entry in the front of its supernode."""
    result = np.empty(len(row), np.int64)
    for k in range(len(row)):
        node = owner[k]
        if row[k] < start[node + 1]:
            result[k] = row[k] - start[node]
        else:
            below = rows[row_start[node] : row_start[node + 1]]
            result[k] = start[node + 1] - start[node] + np.searchsorted(below, row[k])
    return result


@kernel
def _stack_size(rows: IntArray, parent: IntArray) -> int:
    """Return the most entries that the stack of updates holds at once."""
    waiting = np.zeros(len(rows), np.int64)  # entries that the children of each supernode left
    used, most = 0, 0
    for node in range(len(rows)):
        used += rows[node] ** 2 - waiting[node]
        most = max(most, used + waiting[node])
        if parent[node] >= 0:
            waiting[parent[node]] += rows[node] ** 2
    return most


@kernel
def _eliminate_plainly(front: FloatArray, begin: int, end: int, reach: int, column: FloatArray) -> bool:
    """Eliminate columns begin:end of the lower triangle, updating rows and columns up to `reach`."""
    for pivot in range(begin, end):
        value = front[pivot, pivot]
        if not value > 0.0 or value == np.inf:
            return False
        scale = 1.0 / np.sqrt(value)
        front[pivot, pivot] = np.sqrt(value)
        count = reach - pivot - 1
        source = column[:count]
        for k in range(count):
            source[k] = front[pivot + 1 + k, pivot] * scale
            front[pivot + 1 + k, pivot] = source[k]
        for row in range(count):
            factor = source[row]
            if factor != 0.0:
                target = front[pivot + 1 + row, pivot + 1 : pivot + 2 + row]
                for k in range(row + 1):  # from 0: then LLVM drops numba's wrap-around test and vectorises
                    target[k] -= factor * source[k]
    return True


@kernel
def _inverse_lower(front: FloatArray, begin: int, width: int, inverse: FloatArray) -> None:
    """Invert the lower triangle front[begin:begin+width, ...] into `inverse` (width, width)."""
    inverse[:] = 0.0
    for row in range(width):
        target = inverse[row]
        for k in range(row):
            factor, source = front[begin + row, begin + k], inverse[k]
            for m in range(k + 1):
                target[m] -= factor * source[m]
        scale = 1.0 / front[begin + row, begin + row]
        for m in range(row):
            target[m] *= scale
        target[row] = scale


@kernel
def _subtract_rows(target: FloatArray, scale: FloatArray, rows: FloatArray, low: int) -> None:
    """Do target -= scale @ rows[:len(scale), low:low+len(target)], four rows a pass."""
    count, high = len(scale), low + len(target)
    k = 0
    while k + 4 <= count:
        a, b, c, d = scale[k], scale[k + 1], scale[k + 2], scale[k + 3]
        p, q = rows[k][low:high], rows[k + 1][low:high]
        r, s = rows[k + 2][low:high], rows[k + 3][low:high]
        for m in range(len(target)):
            target[m] -= (a * p[m] + b * q[m]) + (c * r[m] + d * s[m])
        k += 4
    while k < count:
        a, p = scale[k], rows[k][low:high]
        for m in range(len(target)):
            target[m] -= a * p[m]
        k += 1


@kernel
def _eliminate(front: FloatArray, size: int, pivots: int, column: FloatArray, memory: FloatArray) -> bool:
    """Eliminate the first `pivots` columns of the lower triangle of a front (size, size) in place."""
    scale = np.empty(PANEL)
    inverse_memory = np.empty(PANEL * PANEL)
    for begin in range(0, pivots, PANEL):
        end = min(begin + PANEL, pivots)
        width, height = end - begin, size - end
        if height < PRODUCT_ROWS or width < 8:
            if not _eliminate_plainly(front, begin, end, size, column):
                return False
            continue
        if not _eliminate_plainly(front, begin, end, end, column):
            return False
        inverse = inverse_memory[: width * width].reshape(width, width)
        _inverse_lower(front, begin, width, inverse)
        raw = memory[: width * height].reshape(width, height)
        panel = memory[width * height : 2 * width * height].reshape(width, height)  # transposed: long rows
        for row in range(height):
            source = front[end + row, begin:end]
            for k in range(width):
                raw[k, row] = source[k]
        panel[:] = 0.0
        for k in range(width):
            for m in range(k + 1):
                scale[m] = -inverse[k, m]
            _subtract_rows(panel[k], scale[: k + 1], raw, 0 * begin)  # a literal 0 would compile a second version
        for row in range(height):
            target = front[end + row, begin:end]
            for k in range(width):
                target[k] = panel[k, row]
        for low in range(0, height, STRIP):
            for row in range(low, height):
                for k in range(width):
                    scale[k] = panel[k, row]
                reach = min(row + 1, low + STRIP)
                _subtract_rows(front[end + row, end + low : end + reach], scale[:width], panel, low)
    return True


@kernel
def _factorize(p: int, start: IntArray, row_start: IntArray, relative: IntArray, parent: IntArray,
               entry_start: IntArray, entry: IntArray, entry_row: IntArray, entry_column: IntArray,
               factor_start: IntArray, diagonal: FloatArray, off_diagonal: FloatArray, damping: float,
               factor: FloatArray, front_memory: FloatArray, stack: FloatArray,
               panel: FloatArray) -> bool:  # fmt: skip
    count, supernodes = len(diagonal), len(parent)
    top = 0
    pending = np.empty(supernodes, np.int64)  # supernodes whose updates lie on the stack
    waiting = 0
    largest = 0
    for node in range(supernodes):
        largest = max(largest, start[node + 1] - start[node] + row_start[node + 1] - row_start[node])
    column_memory, scalar = np.empty(largest * p), np.empty(largest * p, np.int64)
    for node in range(supernodes):
        pivots = (start[node + 1] - start[node]) * p
        size = pivots + (row_start[node + 1] - row_start[node]) * p
        front = front_memory[: size * size].reshape(size, size)
        for row in range(size):
            target = front[row]
            for k in range(row + 1):
                target[k] = 0.0
        for slot in range(entry_start[node], entry_start[node + 1]):
            row, column, which = entry_row[slot] * p, entry_column[slot] * p, entry[slot]
            for a in range(p):
                for b in range(p):
                    if which < 0:
                        front[row + a, column + b] += off_diagonal[-1 - which - count, b, a]
                    elif which >= count:
                        front[row + a, column + b] += off_diagonal[which - count, a, b]
                    elif b <= a:
                        front[row + a, column + b] += diagonal[which, a, b] + (damping if a == b else 0.0)
        while waiting > 0 and parent[pending[waiting - 1]] == node:
            waiting -= 1
            child = pending[waiting]
            rows = row_start[child + 1] - row_start[child]
            top -= (rows * p) ** 2
            update = stack[top : top + (rows * p) ** 2].reshape(rows * p, rows * p)
            for r in range(rows):
                for a in range(p):
                    scalar[r * p + a] = relative[row_start[child] + r] * p + a
            for row in range(rows * p):
                source, target = update[row], front[scalar[row]]
                for k in range(row + 1):
                    target[scalar[k]] += source[k]
        if not _eliminate(front, size, pivots, column_memory, panel):
            return False
        columns = factor[factor_start[node] : factor_start[node + 1]].reshape(size, pivots)
        for row in range(size):
            source, target = front[row], columns[row]
            for k in range(pivots):
                target[k] = source[k]
        rest = size - pivots
        if rest > 0:
            update = stack[top : top + rest * rest].reshape(rest, rest)
            for row in range(rest):
                source, target = front[pivots + row, pivots:], update[row]
                for k in range(row + 1):
                    target[k] = source[k]
            top += rest * rest
            pending[waiting] = node
            waiting += 1
    return True


@kernel
def _substitute(p: int, start: IntArray, row_start: IntArray, rows: IntArray, factor_start: IntArray,
                factor: FloatArray, x: FloatArray) -> None:  # fmt: skip
    supernodes = len(start) - 1
    for node in range(supernodes):
        base, pivots = start[node] * p, (start[node + 1] - start[node]) * p
        below = rows[row_start[node] : row_start[node + 1]]
        columns = factor[factor_start[node] : factor_start[node + 1]].reshape(pivots + len(below) * p, pivots)
        for row in range(pivots):
            value = x[base + row]
            for k in range(row):
                value -= columns[row, k] * x[base + k]
            x[base + row] = value / columns[row, row]
        for r in range(len(below)):
            for a in range(p):
                value = 0.0
                for k in range(pivots):
                    value += columns[pivots + r * p + a, k] * x[base + k]
                x[below[r] * p + a] -= value
    for node in range(supernodes - 1, -1, -1):
        base, pivots = start[node] * p, (start[node + 1] - start[node]) * p
        below = rows[row_start[node] : row_start[node + 1]]
        columns = factor[factor_start[node] : factor_start[node + 1]].reshape(pivots + len(below) * p, pivots)
        for r in range(len(below)):
            for a in range(p):
                value = x[below[r] * p + a]
                for k in range(pivots):
                    x[base + k] -= columns[pivots + r * p + a, k] * value
        for row in range(pivots - 1, -1, -1):
            x[base + row] /= columns[row, row]
            for k in range(row):
                x[base + k] -= columns[row, k] * x[base + row]
