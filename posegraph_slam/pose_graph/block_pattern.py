"""Where the blocks of a sparse symmetric matrix stand in the fronts of its factorisation: once a pattern."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.dense_tile import TILE
from posegraph_slam.pose_graph.elimination import Elimination, analyze


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlockPattern:
    """Where the blocks of a symmetric matrix stand: n diagonal blocks and off-diagonal ones at (i, j), (E,) each.

    Off-diagonal blocks may repeat a place; they add up. Of the matrix only the rows and columns `rows` (k,) are
    factored.
    """

    block: int
    count: int
    """Block rows n of the whole matrix."""
    rows: IntArray
    elimination: Elimination
    entry_start: IntArray
    """Entries of each supernode (S+1,)."""
    entry: IntArray
    """Which block: below n a diagonal one, from n on off-diagonal ones; -1 - number: to be transposed."""
    entry_row: IntArray
    entry_column: IntArray
    """Block row and block column in the front, row <= column."""
    factor_start: IntArray
    """Where the rows of each supernode begin in the factor's storage (S+1,)."""
    side: IntArray
    """On which of two stacks (0 or 1) each supernode leaves its update: another one than its children."""
    largest_front: int
    stack_sizes: IntArray
    """Entries that each of the stacks needs."""

    @property
    def work(self) -> float:
        """Multiplications of a factorisation."""
        tree = self.elimination
        width, below = np.diff(tree.start) * self.block, np.diff(tree.row_start) * self.block
        return float(np.sum(width * ((below + 0.5 * width) ** 2 + width**2 / 12.0)))


def block_pattern(count: int, i: IntArray, j: IntArray, block: int, *, kept: BoolArray | None = None) -> BlockPattern:
    """Analyse a matrix of `count` block rows with off-diagonal blocks at (i, j) (E,), i != j.

    `kept` (count,) marks the rows and columns that stay; at least one must.
    """
    rows, inner = np.arange(count), np.arange(len(i))
    if kept is not None:
        rows, inner = np.flatnonzero(kept), np.flatnonzero(kept[i] & kept[j])
        place = np.cumsum(kept) - 1
        i, j = place[i[inner]], place[j[inner]]
    tree = analyze(len(rows), i, j, block)
    here, there = tree.position[i], tree.position[j]
    row = np.concatenate([tree.position, np.minimum(here, there)])
    column = np.concatenate([tree.position, np.maximum(here, there)])
    number = np.concatenate([rows, np.where(here < there, count + inner, -1 - count - inner)])
    order = np.argsort(row, kind="stable")
    row, column, number = row[order], column[order], number[order]
    owner = tree.owner[row]
    width, below = np.diff(tree.start), np.diff(tree.row_start)
    side, stack_sizes = _stacks(stored_update(below * block), tree.parent)
    return BlockPattern(
        block=block,
        count=count,
        rows=rows,
        elimination=tree,
        entry_start=np.searchsorted(owner, np.arange(len(width) + 1)),
        entry=number,
        entry_row=row - tree.start[owner],
        entry_column=_front_places(column, owner, tree.start, tree.row_start, tree.rows),
        factor_start=np.concatenate([[0], np.cumsum((width + below) * width * block**2)]),
        side=side,
        largest_front=int((width + below).max()) * block,
        stack_sizes=stack_sizes,
    )


def stored_update(rows: IntArray) -> IntArray:
    """Return the side length at which an update of so many rows is stored: a multiple of the tile."""
    return (rows + TILE - 1) // TILE * TILE


@kernel
def _front_places(place: IntArray, owner: IntArray, start: IntArray, row_start: IntArray, rows: IntArray) -> IntArray:
    """Return where each place of the elimination stands in the front of its owner, counted in blocks."""
    result = np.empty(len(place), np.int64)
    for k in range(len(place)):
        node = owner[k]
        if place[k] < start[node + 1]:
            result[k] = place[k] - start[node]
        else:
            below = rows[row_start[node] : row_start[node + 1]]
            result[k] = start[node + 1] - start[node] + np.searchsorted(below, place[k])
    return result


@kernel
def _stacks(sides: IntArray, parent: IntArray) -> tuple[IntArray, IntArray]:
    """Return each supernode's stack, by the parity of its depth, and the most entries that both stacks hold.

    A supernode builds its update on one stack while those of its children still lie on the other.
    """
    count = len(parent)
    stack, waiting = np.zeros(count, np.int64), np.zeros(count, np.int64)  # entries that children left
    for node in range(count - 1, -1, -1):
        if parent[node] >= 0:
            stack[node] = 1 - stack[parent[node]]
    used, most = np.zeros(2, np.int64), np.zeros(2, np.int64)
    for node in range(count):
        mine = stack[node]
        most[mine] = max(most[mine], used[mine] + sides[node] ** 2)
        used[1 - mine] -= waiting[node]
        used[mine] += sides[node] ** 2
        if parent[node] >= 0:
            waiting[parent[node]] += sides[node] ** 2
    return stack, most
