"""A start that needs no start: the chordal relaxation of a pose graph, SE(2) and SE(3) by one code.

Rotations first, as free matrices: min sum k |R_i R_ij - R_j|^2 is linear least squares over their entries; each is then
projected onto the rotations (Martinec and Pajdla 2007; Carlone et al. 2015). With rotations known, translations are
linear least squares too. Both systems have the graph's own pattern, so that one symbolic analysis serves them.
"""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.errors import GraphError
from posegraph_slam.geometry import pose_from_rotation_translation
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.block_cholesky import factorize
from posegraph_slam.pose_graph.block_pattern import BlockPattern, block_pattern
from posegraph_slam.pose_graph.block_substitution import solve_many
from posegraph_slam.pose_graph.graph import PoseGraph


def chordal_poses(graph: PoseGraph) -> FloatArray:
    """Return poses (N, d+1, d+1) from the constraints and the poses of the fixed nodes alone.

    The graph must pass `check_graph`. Rotations are weighted by the mean of their information, translations by
    theirs in full. Raises `GraphError` where the relaxation is singular.
    """
    if graph.fixed.all():
        return graph.poses
    c = graph.constraints
    pattern = block_pattern(len(graph), c.i, c.j, graph.group.dimension, kept=~graph.fixed)
    rotations = _rotations(graph, pattern)
    return pose_from_rotation_translation(rotations, _translations(graph, pattern, rotations))


def _blocks(graph: PoseGraph) -> tuple[slice, slice]:
    """Return where rotation and translation stand in the tangent."""
    p, d = graph.group.dof, graph.group.dimension
    return (slice(2, 3), slice(0, 2)) if d == 2 else (slice(0, 3), slice(p - d, p))


def _rotations(graph: PoseGraph, pattern: BlockPattern) -> FloatArray:
    """Solve for X_i = R_i^T with R_ij^T X_i = X_j in the least squares sense, and project."""
    c, d = graph.constraints, graph.group.dimension
    turn, _ = _blocks(graph)
    weight = np.trace(c.information[:, turn, turn], axis1=1, axis2=2) / (turn.stop - turn.start)
    R = c.T_i_j[:, :d, :d]
    ones = weight[:, None, None] * np.eye(d)
    known = np.swapaxes(graph.poses[:, :d, :d], 1, 2)
    X = _solve(graph, pattern, ones, ones, -weight[:, None, None] * R, np.zeros_like(known), known)
    U, _, Vt = np.linalg.svd(np.swapaxes(X, 1, 2))
    U[:, :, -1] *= np.linalg.det(U @ Vt)[:, None]
    return np.where(graph.fixed[:, None, None], graph.poses[:, :d, :d], U @ Vt)


def _translations(graph: PoseGraph, pattern: BlockPattern, rotations: FloatArray) -> FloatArray:
    """Solve for t with t_j - t_i = R_i t_ij in the least squares sense."""
    c, d = graph.constraints, graph.group.dimension
    _, shift = _blocks(graph)
    R = rotations[c.i]
    W = R @ c.information[:, shift, shift] @ np.swapaxes(R, 1, 2)
    pull = W @ (R @ c.T_i_j[:, :d, d, None])
    right = np.zeros((len(graph), d, 1))
    _add_blocks(right, c.i, -pull)
    _add_blocks(right, c.j, pull)
    t = _solve(graph, pattern, W, W, -W, right, graph.poses[:, :d, d, None])[..., 0]
    return np.where(graph.fixed[:, None], graph.poses[:, :d, d], t)


def _solve(
    graph: PoseGraph,
    pattern: BlockPattern,
    at_i: FloatArray,
    at_j: FloatArray,
    between: FloatArray,
    right: FloatArray,
    known: FloatArray,
) -> FloatArray:
    """Solve the block system with edge blocks [[at_i, between], [between^T, at_j]] for columns (N, d, m).

    Fixed nodes keep the values `known` (N, d, m) and move to the right-hand side.
    """
    c, held = graph.constraints, graph.fixed[:, None, None] * known
    diagonal, right = np.zeros((len(graph), *at_i.shape[1:])), np.array(right)
    _add_blocks(diagonal, c.i, at_i)
    _add_blocks(diagonal, c.j, at_j)
    touched = np.flatnonzero(graph.fixed[c.i] | graph.fixed[c.j])
    i, j, blocks = c.i[touched], c.j[touched], between[touched]
    _add_blocks(right, i, -blocks @ held[j])
    _add_blocks(right, j, -np.swapaxes(blocks, 1, 2) @ held[i])
    factor = factorize(pattern, diagonal, between, 0.0)
    if factor is None:
        raise GraphError("pose graph", "its chordal relaxation is singular", "start from its own poses")
    return held + solve_many(pattern, factor, right)


@kernel
def _add_blocks(target: FloatArray, index: IntArray, blocks: FloatArray) -> None:
    """Do target[index] += blocks, indices repeating: (N, a, b), (E,), (E, a, b)."""
    for e in range(len(index)):
        into = target[index[e]]
        for row in range(blocks.shape[1]):
            for column in range(blocks.shape[2]):
                into[row, column] += blocks[e, row, column]
