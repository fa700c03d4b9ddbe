"""A graph fed in pieces ends where the batch solution is."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.errors import ConfigurationError, GraphError
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph
from posegraph_slam.pose_graph.incremental import IncrementalSolver
from posegraph_slam.pose_graph.solve import graph_cost, solve
from posegraph_slam.pose_graph.solver_settings import SolverMethod, SolverSettings


def test_growing_ends_at_the_batch_optimum(graph: PoseGraph) -> None:
    c, solver = graph.constraints, IncrementalSolver(graph.group)
    latest = np.maximum(c.i, c.j)
    solver.add(graph.poses[:1], c.select(latest < 1))
    for node in range(1, len(graph)):
        new = c.select(latest == node)
        before = solver.poses()
        k = int(np.argmin(np.where(new.j == node, new.i, len(graph))))
        guess = before[new.i[k]] @ new.T_i_j[k]
        solver.add(guess[None], new)
    for _ in range(10):
        solver.add(graph.group.identity(0), c.select(np.zeros(0, np.int64)))
    assert len(solver) == len(graph)
    batch = solve(graph)
    assert graph_cost(graph.with_poses(solver.poses())) == pytest.approx(batch.cost, rel=1e-3)
    np.testing.assert_allclose(solver.poses(), batch.poses, atol=0.02)


def test_what_cannot_be_added_is_named(graph: PoseGraph) -> None:
    c, solver = graph.constraints, IncrementalSolver(graph.group)
    assert solver.poses().shape == (0, graph.group.matrix_size, graph.group.matrix_size)
    with pytest.raises(GraphError, match="of a graph of 3 nodes"):
        solver.add(graph.poses[:3], c.select(np.array([0, 1, 2])))
    with pytest.raises(GraphError, match="row 2"):
        solver.add(graph.poses[:3], c.select(np.array([0])))


def test_a_whole_graph_is_solved_batch_by_batch(graph: PoseGraph) -> None:
    shuffled = np.random.default_rng(0).permutation(len(graph))
    place = np.argsort(shuffled)
    c = graph.constraints
    renamed = Constraints(i=place[c.i], j=place[c.j], T_i_j=c.T_i_j, information=c.information, kind=c.kind)
    mixed = PoseGraph(poses=graph.poses[shuffled], session=graph.session, index=graph.index,
                      fixed=graph.fixed[shuffled], constraints=renamed)  # fmt: skip
    expected = solve(mixed)
    found = solve(mixed, SolverSettings(method=SolverMethod.ISAM2))
    assert found.converged
    assert found.cost == pytest.approx(expected.cost, rel=1e-8)
    np.testing.assert_array_equal(found.poses[mixed.fixed], mixed.poses[mixed.fixed])
    assert found.record.cost[0] > found.record.cost[-1]


def test_isam2_says_what_it_cannot_do(graph: PoseGraph) -> None:
    two = PoseGraph(poses=graph.poses, session=graph.session, index=graph.index, fixed=np.arange(len(graph)) < 2,
                    constraints=graph.constraints)  # fmt: skip
    with pytest.raises(ConfigurationError, match="one fixed node and no loss"):
        solve(two, SolverSettings(method=SolverMethod.ISAM2))
