"""Symbolic analysis of a sparse symmetric block matrix: ordering, elimination tree, supernodes and their fronts.

Done once a graph; the numbers follow in `block_cholesky`. The ordering is SuperLU's multiple minimum degree as scipy
ships it: on the block graph it takes milliseconds, and its fill is less than that of COLAMD and METIS on most standard
graphs. Where fill is heavy METIS is tried too: it halves the work on a cube of 8000 poses. Tree and column structures:
Davis, Direct Methods for Sparse Linear Systems (2006), chapter 4; joining supernodes with some explicit zeros: Ashcraft
and Grimes (1989).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import gtsam
import numpy as np
from scipy.sparse import coo_array, csc_array, eye_array
from scipy.sparse.linalg import spilu

from posegraph_slam.arrays import IntArray
from posegraph_slam.jit import kernel

RELAXED_COLUMNS = (4, 16, 48)
"""Supernodes of up to so many scalar columns are joined to their parents ..."""
RELAXED_ZEROS = (1.0, 0.5, 0.1, 0.05)
"""... if the share of zeros that this stores stays below these (the last: larger ones)."""


HEAVY = 1e7
"""Products of blocks in a factorisation (in space 0.1 s of them) from which a second ordering is worth its time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Elimination:
    """In which order blocks are eliminated, and what each supernode's dense front holds.

    `position` (n,) is the place of each block row in the elimination; supernode s owns the places
    start[s]:start[s+1], and below them the block rows rows[row_start[s]:row_start[s+1]] (places, ascending), which
    sit in the front of parent[s] at block rows relative[...].
    """

    position: IntArray
    start: IntArray
    row_start: IntArray
    rows: IntArray
    relative: IntArray
    parent: IntArray
    owner: IntArray
    """Supernode (n,) of each place."""


def minimum_degree(count: int, i: IntArray, j: IntArray) -> IntArray:
    """Return an elimination order (count,) of little fill for a symmetric pattern with entries (i, j)."""
    links = coo_array((np.ones(2 * len(i)), (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(count, count))
    pattern = csc_array(links)
    pattern.data[:] = -1.0
    dominant = csc_array(pattern + eye_array(count) * (count + 1.0))
    # An incomplete factorisation that drops everything: only its column order is wanted.
    factor = spilu(
        dominant,
        drop_tol=1.0,
        fill_factor=1,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.argsort(np.asarray(factor.perm_c)).astype(np.int64)


def nested_dissection(count: int, i: IntArray, j: IntArray) -> IntArray:
    """Return an elimination order (count,) by METIS, which GTSAM carries: better where separators are large."""
    pattern = gtsam.SymbolicFactorGraph()
    for first, second in zip(i.tolist(), j.tolist(), strict=True):
        pattern.push_factor(first, second)
    ordering = gtsam.Ordering.MetisSymbolicFactorGraph(pattern)
    order = np.array([ordering.at(k) for k in range(ordering.size())], dtype=np.int64)
    return np.concatenate([np.setdiff1d(np.arange(count), order), order])


def analyze(count: int, i: IntArray, j: IntArray, block: int) -> Elimination:
    """Analyse a symmetric matrix of `count` block rows of size `block` with off-diagonal blocks at (i, j)."""
    place = np.empty(count, dtype=np.int64)
    place[_order(count, i.tobytes(), j.tobytes())] = np.arange(count)
    start, neighbours = _adjacency(count, place[i], place[j])
    parent = _elimination_tree(start, neighbours)
    place = _postorder(parent)[place]
    start, neighbours = _adjacency(count, place[i], place[j])
    parent = _elimination_tree(start, neighbours)
    column_start, column_rows = _column_structures(start, neighbours, parent)
    limits, zeros = np.array(RELAXED_COLUMNS), np.array(RELAXED_ZEROS)
    super_start = _supernodes(parent, column_start, block, limits, zeros)
    last = super_start[1:] - 1
    lengths = column_start[last + 1] - column_start[last]
    row_start = np.concatenate([[0], np.cumsum(lengths)])
    rows = column_rows[np.repeat(column_start[last] - row_start[:-1], lengths) + np.arange(row_start[-1])]
    owner = np.repeat(np.arange(len(last)), np.diff(super_start))
    has_rows = lengths > 0
    super_parent = np.full(len(last), -1)
    super_parent[has_rows] = owner[rows[row_start[:-1][has_rows]]]
    relative = _relative_rows(super_start, row_start, rows, super_parent)
    return Elimination(
        position=place,
        start=super_start,
        row_start=row_start,
        rows=rows,
        relative=relative,
        parent=super_parent,
        owner=owner,
    )


@lru_cache(maxsize=8)
def _order(count: int, i_bytes: bytes, j_bytes: bytes) -> IntArray:
    """Return the better elimination order; remembered, because starts, solver and certificate ask for the same."""
    i, j = np.frombuffer(i_bytes, np.int64), np.frombuffer(j_bytes, np.int64)
    order = minimum_degree(count, i, j)
    work = elimination_work(count, i, j, order)
    if work < HEAVY:
        return order
    other = nested_dissection(count, i, j)
    return other if elimination_work(count, i, j, other) < work else order


def elimination_work(count: int, i: IntArray, j: IntArray, order: IntArray) -> float:
    """Return the sum of squared column lengths of the factor: multiplications, in blocks, of a factorisation."""
    place = np.empty(count, dtype=np.int64)
    place[order] = np.arange(count)
    start, neighbours = _adjacency(count, place[i], place[j])
    lengths = _column_lengths(start, neighbours, _elimination_tree(start, neighbours))
    return float(np.sum((lengths + 1.0) ** 2))


def _adjacency(count: int, i: IntArray, j: IntArray) -> tuple[IntArray, IntArray]:
    """Return for each place the smaller places that it is linked to: CSR of the strict lower triangle."""
    key = np.unique(np.maximum(i, j) * count + np.minimum(i, j))
    return np.searchsorted(key, np.arange(count + 1) * count), key % count


@kernel
def _elimination_tree(start: IntArray, neighbours: IntArray) -> IntArray:
    count = len(start) - 1
    parent = np.full(count, -1)
    ancestor = np.full(count, -1)
    for row in range(count):
        for slot in range(start[row], start[row + 1]):
            node = neighbours[slot]
            while node != -1 and node < row:
                above = ancestor[node]
                ancestor[node] = row
                if above == -1:
                    parent[node] = row
                node = above
    return parent


@kernel
def _postorder(parent: IntArray) -> IntArray:
    """Return the new place (n,) of each node such that children stand before parents, subtrees in one piece."""
    count = len(parent)
    child, sibling = np.full(count, -1), np.full(count, -1)
    for node in range(count - 1, -1, -1):
        if parent[node] != -1:
            sibling[node] = child[parent[node]]
            child[parent[node]] = node
    place, stack, done = np.empty(count, np.int64), np.empty(count, np.int64), 0
    for root in range(count):
        if parent[root] != -1:
            continue
        top = 0
        stack[0] = root
        while top >= 0:
            node = stack[top]
            if child[node] != -1:
                top += 1
                stack[top] = child[node]
                child[node] = sibling[child[node]]
            else:
                place[node] = done
                done += 1
                top -= 1
    return place


@kernel
def _column_lengths(start: IntArray, neighbours: IntArray, parent: IntArray) -> IntArray:
    """Return how many rows below the diagonal every column of the factor has."""
    count = len(parent)
    mark, length = np.full(count, -1), np.zeros(count, np.int64)
    for row in range(count):
        mark[row] = row
        for slot in range(start[row], start[row + 1]):
            node = neighbours[slot]
            while mark[node] != row:
                mark[node] = row
                length[node] += 1
                node = parent[node]
    return length


@kernel
def _column_structures(start: IntArray, neighbours: IntArray, parent: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows below the diagonal of every column of the factor, ascending, as CSC."""
    count = len(parent)
    column_start = np.zeros(count + 1, np.int64)
    column_start[1:] = np.cumsum(_column_lengths(start, neighbours, parent))
    filled = column_start[:-1].copy()
    rows = np.empty(column_start[-1], np.int64)
    mark = np.full(count, -1)
    for row in range(count):
        mark[row] = row
        for slot in range(start[row], start[row + 1]):
            node = neighbours[slot]
            while mark[node] != row:
                mark[node] = row
                rows[filled[node]] = row
                filled[node] += 1
                node = parent[node]
    return column_start, rows


@kernel
def _supernodes(parent: IntArray, column_start: IntArray, block: int, limits: IntArray, shares: np.ndarray) -> IntArray:
    """Return the first columns of the supernodes, closed by the column count."""
    count = len(parent)
    first = np.empty(count + 1, np.int64)
    zeros = np.zeros(count + 1, np.int64)  # explicit zero blocks that each supernode stores
    found = 0
    for column in range(count):
        first[found], zeros[found] = column, 0
        found += 1
        # Join the last supernode to the one before it for as long as that is worth its zeros.
        while found > 1:
            low, high = first[found - 2], first[found - 1]
            above = parent[high - 1]
            if above == -1 or above > column:
                break
            below = column_start[column + 1] - column_start[column]
            width = column + 1 - low
            missing = column + 1 - high + below - (column_start[high] - column_start[high - 1])
            total = zeros[found - 2] + zeros[found - 1] + (high - low) * missing
            stored = width * (width + 1) // 2 + width * below
            kind = 0
            while kind < len(limits) and width * block > limits[kind]:
                kind += 1
            if missing > 0 and total > shares[kind] * stored:
                break
            zeros[found - 2] = total
            found -= 1
    first[found] = count
    return first[: found + 1].copy()


@kernel
def _relative_rows(start: IntArray, row_start: IntArray, rows: IntArray, parent: IntArray) -> IntArray:
    """Return where each row of a supernode sits in its parent's front, counted in block rows."""
    relative = np.zeros(len(rows), np.int64)
    for node in range(len(parent)):
        above = parent[node]
        if above < 0:
            continue
        width, slot = start[above + 1] - start[above], row_start[above]
        for k in range(row_start[node], row_start[node + 1]):
            if rows[k] < start[above + 1]:
                relative[k] = rows[k] - start[above]
            else:
                while rows[slot] != rows[k]:
                    slot += 1
                relative[k] = width + slot - row_start[above]
    return relative
