"""Starting poses from the constraints alone."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.geometry import Group
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.graph import Constraints


def propagate_poses(group: Group, poses: FloatArray, known: BoolArray, constraints: Constraints) -> FloatArray:
    """Fill the poses (N, d+1, d+1) that are not `known` (N,) by composing constraints from known ones.

    First once through the constraints in their order (for a log: the odometry chain), then breadth first over what is
    left. A part without any known pose starts at the identity in its first node.
    """
    result, done, inverse = _prepared(group, poses, known, constraints)
    _in_order(constraints.i, constraints.j, constraints.T_i_j, inverse, result, done)
    return _spread(result, done, inverse, constraints)


def spread_poses(group: Group, poses: FloatArray, known: BoolArray, constraints: Constraints) -> FloatArray:
    """Fill the poses that are not known by composing as few constraints as can be from known ones (breadth first)."""
    result, done, inverse = _prepared(group, poses, known, constraints)
    return _spread(result, done, inverse, constraints)


def _prepared(
    group: Group, poses: FloatArray, known: BoolArray, constraints: Constraints
) -> tuple[FloatArray, BoolArray, FloatArray]:
    result, done = np.array(poses, dtype=np.float64), np.array(known, dtype=np.bool_)
    result[~done] = np.eye(group.matrix_size)
    if len(done) and not done.any():
        done[0] = True
    return result, done, group.inverse(constraints.T_i_j)


def _spread(poses: FloatArray, done: BoolArray, inverse: FloatArray, constraints: Constraints) -> FloatArray:
    c = constraints
    ends, numbers = np.concatenate([c.i, c.j]), np.concatenate([np.arange(len(c)), np.arange(len(c))])
    order = np.lexsort((numbers, ends))  # incident edges of each node in the order of the constraints
    start = np.searchsorted(ends[order], np.arange(len(poses) + 1))
    _breadth_first(start, numbers[order], c.i, c.j, c.T_i_j, inverse, poses, done)
    return poses


@kernel
def _compose(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    for row in range(a.shape[0]):
        for column in range(a.shape[0]):
            total = 0.0
            for k in range(a.shape[0]):
                total += a[row, k] * b[k, column]
            out[row, column] = total


@kernel
def _in_order(
    i: IntArray, j: IntArray, T: FloatArray, T_inverse: FloatArray, poses: FloatArray, done: BoolArray
) -> None:
    for edge in range(len(i)):
        a, b = i[edge], j[edge]
        if done[a] and not done[b]:
            _compose(poses[a], T[edge], poses[b])
            done[b] = True
        elif done[b] and not done[a]:
            _compose(poses[b], T_inverse[edge], poses[a])
            done[a] = True


@kernel
def _breadth_first(start: IntArray, incident: IntArray, i: IntArray, j: IntArray, T: FloatArray, T_inverse: FloatArray,
                   poses: FloatArray, done: BoolArray) -> None:  # fmt: skip
    count = len(done)
    queue = np.empty(count, dtype=np.int64)
    queued = done.copy()
    head, tail = 0, 0
    for node in range(count):
        if done[node]:
            queue[tail] = node
            tail += 1
    for root in range(count):
        while head < tail:
            node = queue[head]
            head += 1
            for slot in range(start[node], start[node + 1]):
                edge = incident[slot]
                other = j[edge] if i[edge] == node else i[edge]
                if queued[other]:
                    continue
                _compose(poses[node], T[edge] if i[edge] == node else T_inverse[edge], poses[other])
                queued[other], done[other] = True, True
                queue[tail] = other
                tail += 1
        if not queued[root]:
            queued[root], done[root] = True, True
            queue[tail] = root
            tail += 1
