from __future__ import annotations

import gtsam
import numpy as np
import pytest

from posegraph_slam.errors import GraphError
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.gtsam_solver import to_factor_graph, to_values
from posegraph_slam.pose_graph.marginals import (
    factored_marginals,
    marginal_covariances,
    relative_covariance,
    relative_covariances,
)
from posegraph_slam.pose_graph.residuals import constraint_jacobians
from posegraph_slam.pose_graph.solve import solve


def dense_covariance(graph: PoseGraph, weights: np.ndarray) -> np.ndarray:
    """The inverse of the dense Hessian as (N, p, N, p), zero at fixed nodes."""
    n, p, c = len(graph), graph.group.dof, graph.constraints
    _, by_i, by_j = constraint_jacobians(graph)
    jacobian = np.zeros((len(c), p, n, p))
    jacobian[np.arange(len(c)), :, c.i], jacobian[np.arange(len(c)), :, c.j] = by_i, by_j
    information = c.information * weights[:, None, None]
    hessian = np.einsum("eanb,eac,ecmd->nbmd", jacobian, information, jacobian, optimize=True)
    free = np.flatnonzero(~graph.fixed)
    inverse = np.linalg.inv(hessian[np.ix_(free, range(p), free, range(p))].reshape(len(free) * p, -1))
    result = np.zeros((n, p, n, p))
    result[np.ix_(free, range(p), free, range(p))] = inverse.reshape(len(free), p, len(free), p)
    return result


@pytest.fixture
def solved(graph: PoseGraph) -> PoseGraph:
    return graph.with_poses(solve(graph).poses)


def test_marginals_equal_the_dense_inverse(solved: PoseGraph) -> None:
    nodes = np.array([0, 3, 39, 3])
    weights = np.linspace(0.2, 1, len(solved.constraints))
    for given, used in ((None, np.ones(len(solved.constraints))), (weights, weights)):
        expected = dense_covariance(solved, used)[nodes, :, nodes]
        covariances = marginal_covariances(solved, nodes, weights=given)
        np.testing.assert_allclose(covariances, expected, rtol=1e-6, atol=1e-12)
        np.testing.assert_array_equal(covariances[0], 0)


def test_relative_covariances_equal_the_dense_ones(solved: PoseGraph) -> None:
    i, j = np.array([3, 30, 0, 12, 5]), np.array([30, 3, 17, 0, 5])
    dense, p, group = dense_covariance(solved, np.ones(len(solved.constraints))), solved.group.dof, solved.group
    for a, b, covariance in zip(i, j, relative_covariances(solved, i, j), strict=True):
        ends = np.ix_([a, b], range(p), [a, b], range(p))
        J = np.concatenate([-group.adjoint(group.between(solved.poses[b], solved.poses[a])), np.eye(p)], axis=1)
        expected = J @ dense[ends].reshape(2 * p, 2 * p) @ J.T
        np.testing.assert_allclose(covariance, expected if a != b else 0, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(relative_covariance(solved, 3, 30), relative_covariances(solved, [3], [30])[0])


def test_uncertainty_of_a_relative_pose_does_not_depend_on_the_gauge(solved: PoseGraph) -> None:
    other = PoseGraph(
        poses=solved.poses,
        session=solved.session,
        index=solved.index,
        fixed=np.arange(len(solved)) == 20,
        constraints=solved.constraints,
    )
    expected = relative_covariance(solved, 5, 35)
    np.testing.assert_allclose(relative_covariance(other, 5, 35), expected, rtol=1e-6, atol=1e-10)


def test_missing_gauge_and_bad_rows_are_named(solved: PoseGraph) -> None:
    loose = PoseGraph(
        poses=solved.poses,
        session=solved.session,
        index=solved.index,
        fixed=np.zeros(len(solved)),
        constraints=solved.constraints,
    )
    with pytest.raises(GraphError, match="no node is fixed"):
        marginal_covariances(loose, [1])
    with pytest.raises(GraphError, match="row 40 is not one of 40 nodes"):
        marginal_covariances(solved, [1, 40])


def test_marginals_equal_gtsams(solved: PoseGraph) -> None:
    oracle = gtsam.Marginals(to_factor_graph(solved), to_values(solved.poses))
    nodes = np.array([1, 5, 25, 39])
    expected = [oracle.marginalCovariance(node) for node in nodes.tolist()]
    np.testing.assert_allclose(marginal_covariances(solved, nodes), expected, rtol=1e-6, atol=1e-12)


def test_many_pairs_are_solved_in_pieces(solved: PoseGraph) -> None:
    pairs = np.array([(a, b) for a in range(0, 40, 3) for b in range(40)])
    marginals = factored_marginals(solved)
    whole = marginals.relative(pairs[:, 0], pairs[:, 1])
    dense = dense_covariance(solved, np.ones(len(solved.constraints)))
    cross = marginals.cross_covariances(pairs[:, 0], pairs[:, 1])
    np.testing.assert_allclose(cross, dense[pairs[:, 0], :, pairs[:, 1]], rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(
        cross, np.swapaxes(marginals.cross_covariances(pairs[:, 1], pairs[:, 0]), 1, 2), atol=1e-10
    )
    np.testing.assert_allclose(whole[7], relative_covariance(solved, *pairs[7].tolist()))


def test_covariances_of_constraints_are_those_of_their_pairs(graph: PoseGraph) -> None:
    factored = factored_marginals(graph)
    c = graph.constraints
    expected = factored.relative(c.i, c.j)
    np.testing.assert_allclose(factored.of_constraints(), expected, rtol=1e-7, atol=1e-12 * np.abs(expected).max())
