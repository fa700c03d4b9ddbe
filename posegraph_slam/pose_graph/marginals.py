"""Uncertainty of poses, and of one pose seen from another, from the factored normal equations of a solved graph.

Covariances are in the tangent of the right update T exp(d), in GTSAM's order, at the poses of the graph given: solve
it first. A fixed node has covariance zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.errors import GraphError
from posegraph_slam.pose_graph.block_cholesky import factorize
from posegraph_slam.pose_graph.block_inverse import inverse_blocks, inverse_columns
from posegraph_slam.pose_graph.block_pattern import BlockPattern
from posegraph_slam.pose_graph.checks import check_graph
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph
from posegraph_slam.pose_graph.linearization import normal_equations
from posegraph_slam.pose_graph.noise import symmetrised
from posegraph_slam.pose_graph.sparse_solver import free_pattern

COLUMNS_AT_ONCE = 64
"""Nodes whose columns of the covariance are solved for together: bounds memory at 64 p columns of it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Marginals:
    """A graph factored at its poses, to be asked for covariances many times."""

    graph: PoseGraph
    pattern: BlockPattern | None
    """None where every node is fixed."""
    factor: FloatArray

    def covariances(self) -> FloatArray:
        """Return the covariance (N, p, p) of every pose, in the frame of each pose."""
        return self._blocks()[0]

    def of_constraints(self) -> FloatArray:
        """Return the covariances (E, p, p) of T_i_j between the nodes of every constraint: no more work than poses."""
        c, (own, between) = self.graph.constraints, self._blocks()
        return self._relative(c.i, c.j, own, between)

    def _blocks(self) -> tuple[FloatArray, FloatArray]:
        p, c = self.graph.group.dof, self.graph.constraints
        if self.pattern is None:
            return np.zeros((len(self.graph), p, p)), np.zeros((len(c), p, p))
        own, between = inverse_blocks(self.pattern, self.factor, len(c))
        return symmetrised(own), between

    def cross_covariances(self, i: IntArray, j: IntArray) -> FloatArray:
        """Return the covariances (K, p, p) between poses i (rows) and j (columns)."""
        p, fixed = self.graph.group.dof, self.graph.fixed
        result = np.zeros((len(i), p, p))
        pairs = np.flatnonzero(~(fixed[i] | fixed[j]))
        if self.pattern is None or len(pairs) == 0:
            return result
        transposed = len(np.unique(i[pairs])) < len(np.unique(j[pairs]))
        rows, columns = (j[pairs], i[pairs]) if transposed else (i[pairs], j[pairs])
        wanted, which = np.unique(columns, return_inverse=True)
        for begin in range(0, len(wanted), COLUMNS_AT_ONCE):
            now = np.flatnonzero((which >= begin) & (which < begin + COLUMNS_AT_ONCE))
            solved = inverse_columns(self.pattern, self.factor, wanted[begin : begin + COLUMNS_AT_ONCE])
            blocks = solved[rows[now], :, which[now] - begin]
            result[pairs[now]] = np.swapaxes(blocks, 1, 2) if transposed else blocks
        return result

    def relative(self, i: npt.ArrayLike, j: npt.ArrayLike) -> FloatArray:
        """Return the covariances (K, p, p) of T_i_j for pairs of rows i, j (K,), in the frame of each j."""
        first, second = _rows(self.graph, i), _rows(self.graph, j)
        return self._relative(first, second, self.covariances(), self.cross_covariances(first, second))

    def _relative(self, i: IntArray, j: IntArray, own: FloatArray, between: FloatArray) -> FloatArray:
        """With d_i, d_j the updates of both poses, that of T_i_j is d_j - Ad(T_j_i) d_i (Sola et al. 2018, sec. IV)."""
        group = self.graph.group
        A = group.adjoint(group.between(self.graph.poses[j], self.graph.poses[i]))
        mixed = A @ between
        result = A @ own[i] @ np.swapaxes(A, 1, 2) + own[j] - mixed - np.swapaxes(mixed, 1, 2)
        return symmetrised(np.where((i == j)[:, None, None], 0.0, result))


def factored_marginals(graph: PoseGraph, *, weights: FloatArray | None = None) -> Marginals:
    """Linearise and factor a graph at its poses.

    `weights` (E,), such as those of a robust solution, scale the information of the constraints. Raises `GraphError`
    for a graph that fails `check_graph` (no fixed node, say) or is singular at its poses.
    """
    check_graph(graph)
    if weights is not None:
        graph = graph.with_constraints(scale_information(graph.constraints, weights))
    if graph.fixed.all():
        return Marginals(graph=graph, pattern=None, factor=np.zeros(0))
    pattern = free_pattern(graph)
    linear = normal_equations(graph.poses, graph.constraints, np.ones(len(graph.constraints)))
    factor = factorize(pattern, linear.diagonal, linear.off_diagonal, 0.0)
    if factor is None:
        raise GraphError("marginals", "the graph is singular at its poses", "check weights and information")
    return Marginals(graph=graph, pattern=pattern, factor=factor)


def marginal_covariances(graph: PoseGraph, nodes: npt.ArrayLike, *, weights: FloatArray | None = None) -> FloatArray:
    """Return the covariances (K, p, p) of the poses at rows `nodes` (K,); see `factored_marginals` for the rest."""
    rows = _rows(graph, nodes)
    return np.asarray(factored_marginals(graph, weights=weights).covariances()[rows])


def relative_covariance(graph: PoseGraph, i: int, j: int, *, weights: FloatArray | None = None) -> FloatArray:
    """Return the covariance (p, p) of T_i_j = T_i^-1 T_j, in the frame of node j."""
    return np.asarray(relative_covariances(graph, [i], [j], weights=weights)[0])


def relative_covariances(
    graph: PoseGraph, i: npt.ArrayLike, j: npt.ArrayLike, *, weights: FloatArray | None = None
) -> FloatArray:
    """Return the covariances (K, p, p) of T_i_j for pairs of rows i, j (K,), in the frame of each j."""
    first, second = _rows(graph, i), _rows(graph, j)
    return factored_marginals(graph, weights=weights).relative(first, second)


def scale_information(constraints: Constraints, weights: FloatArray) -> Constraints:
    """Return the constraints with their information multiplied by `weights` (E,)."""
    return Constraints(
        i=constraints.i,
        j=constraints.j,
        T_i_j=constraints.T_i_j,
        information=constraints.information * np.asarray(weights)[:, None, None],
        kind=constraints.kind,
    )


def _rows(graph: PoseGraph, nodes: npt.ArrayLike) -> IntArray:
    rows = np.atleast_1d(np.asarray(nodes, dtype=np.int64))
    outside = (rows < 0) | (rows >= len(graph))
    if np.any(outside):
        raise GraphError("marginals", f"row {rows[outside][0]} is not one of {len(graph)} nodes")
    return rows
