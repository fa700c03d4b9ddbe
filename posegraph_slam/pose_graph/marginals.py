"""Uncertainty of chosen poses and of one pose seen from another, from the linearised graph (GTSAM's Marginals).

Covariances are in the tangent of the right update T exp(d), in GTSAM's order, at the poses of the graph given: solve
it first. A fixed node has covariance zero.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import GraphError
from posegraph_slam.pose_graph.checks import check_graph
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph
from posegraph_slam.pose_graph.gtsam_solver import to_factor_graph, to_values
from posegraph_slam.pose_graph.noise import symmetrised


def marginal_covariances(graph: PoseGraph, nodes: npt.ArrayLike, *, weights: FloatArray | None = None) -> FloatArray:
    """Return the covariances (K, p, p) of the poses at rows `nodes` (K,), in the frame of each pose.

    `weights` (E,), such as those of a robust solution, scale the information of the constraints. Raises `GraphError`
    for a graph that fails `check_graph` (no fixed node, say) or is singular at its poses.
    """
    rows = _rows(graph, nodes)
    marginals = _marginals(graph, weights)
    return symmetrised(np.array([marginals.marginalCovariance(row) for row in rows]).reshape(-1, *_size(graph)))


def relative_covariance(graph: PoseGraph, i: int, j: int, *, weights: FloatArray | None = None) -> FloatArray:
    """Return the covariance (p, p) of T_i_j = T_i^-1 T_j, in the frame of node j; errors as `marginal_covariances`."""
    return np.asarray(relative_covariances(graph, [i], [j], weights=weights)[0])


def relative_covariances(
    graph: PoseGraph, i: npt.ArrayLike, j: npt.ArrayLike, *, weights: FloatArray | None = None
) -> FloatArray:
    """Return the covariances (K, p, p) of T_i_j for pairs of rows i, j (K,), in the frame of each j.

    With d the joint update of both poses, the update of T_i_j is d_j - Ad(T_j_i) d_i (Sola et al. 2018, section IV).
    """
    first, second = _rows(graph, i), _rows(graph, j)
    marginals, p = _marginals(graph, weights), graph.group.dof
    joint = np.zeros((len(first), 2 * p, 2 * p))
    for k, (a, b) in enumerate(zip(first, second, strict=True)):
        if a != b:
            joint[k] = _joint(graph, marginals, a, b)
    to_second = graph.group.between(graph.poses[second], graph.poses[first])
    jacobian = np.concatenate([-graph.group.adjoint(to_second), np.broadcast_to(np.eye(p), (len(first), p, p))], axis=2)
    return symmetrised(jacobian @ joint @ np.swapaxes(jacobian, 1, 2))


def scale_information(constraints: Constraints, weights: FloatArray) -> Constraints:
    """Return the constraints with their information multiplied by `weights` (E,)."""
    return Constraints(
        i=constraints.i,
        j=constraints.j,
        T_i_j=constraints.T_i_j,
        information=constraints.information * np.asarray(weights)[:, None, None],
        kind=constraints.kind,
    )


def _size(graph: PoseGraph) -> tuple[int, int]:
    return graph.group.dof, graph.group.dof


def _rows(graph: PoseGraph, nodes: npt.ArrayLike) -> list[int]:
    rows = np.atleast_1d(np.asarray(nodes, dtype=np.int64))
    if np.any((rows < 0) | (rows >= len(graph))):
        raise GraphError(
            "marginals", f"row {rows[(rows < 0) | (rows >= len(graph))][0]} is not one of {len(graph)} nodes"
        )
    return [int(row) for row in rows]


def _marginals(graph: PoseGraph, weights: FloatArray | None) -> Any:
    check_graph(graph)
    if weights is not None:
        graph = graph.with_constraints(scale_information(graph.constraints, np.maximum(weights, 1e-12)))
    try:
        return gtsam.Marginals(to_factor_graph(graph), to_values(graph.poses))
    except RuntimeError as error:
        raise GraphError(
            "marginals", f"the graph is singular at its poses ({str(error).strip().splitlines()[0]})"
        ) from None


def _joint(graph: PoseGraph, marginals: Any, a: int, b: int) -> FloatArray:
    """Return the joint covariance (2p, 2p) of two nodes, that of `a` first.

    GTSAM inverts the joint information for it, which is infinite, and the result wrong, where a node is fixed.
    """
    p = graph.group.dof
    result = np.zeros((2, p, 2, p))
    if graph.fixed[a] or graph.fixed[b]:
        for k, row in enumerate((a, b)):
            if not graph.fixed[row]:
                result[k, :, k] = marginals.marginalCovariance(row)
    else:
        joint = marginals.jointMarginalCovariance([a, b])
        for k, row in enumerate((a, b)):
            for m, column in enumerate((a, b)):
                result[k, :, m] = joint.at(row, column)
    return result.reshape(2 * p, 2 * p)
