from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from posegraph_slam.errors import GraphError
from posegraph_slam.geometry import Group
from posegraph_slam.pose_graph.chordal import chordal_poses
from posegraph_slam.pose_graph.g2o import read_g2o
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.solve import graph_cost, solve
from posegraph_slam.pose_graph.starts import Start, starting_poses

Maker = Callable[..., PoseGraph]


def lost(graph: PoseGraph, seed: int = 0) -> PoseGraph:
    """The graph with every pose but the fixed ones replaced by a random one."""
    random = graph.group.exp(3 * np.random.default_rng(seed).normal(size=(len(graph), graph.group.dof)))
    return graph.with_poses(np.where(graph.fixed[:, None, None], graph.poses, random))


@pytest.mark.parametrize("start", [s for s in Start if s is not Start.GIVEN])
@pytest.mark.parametrize("fixed", [[0], [17], [0, 39]])
def test_a_consistent_graph_is_found_from_nothing(
    graph_maker: Maker, group: Group, start: Start, fixed: list[int]
) -> None:
    exact = graph_maker(group, noise=0.0)
    held = PoseGraph(
        poses=exact.poses,
        session=exact.session,
        index=exact.index,
        fixed=np.isin(np.arange(len(exact)), fixed),
        constraints=exact.constraints,
    )
    poses, _ = starting_poses(lost(held), start)
    np.testing.assert_allclose(poses, exact.poses, atol=1e-6)


def test_the_chordal_start_is_close_and_needs_no_poses(graph: PoseGraph) -> None:
    poses = chordal_poses(graph)
    np.testing.assert_allclose(chordal_poses(lost(graph)), poses, atol=1e-9)
    optimum = solve(graph).cost
    assert graph_cost(graph.with_poses(poses)) < 0.3 * graph_cost(graph) + optimum
    assert solve(graph.with_poses(poses)).cost == pytest.approx(optimum, rel=1e-6)
    rotations = poses[:, :-1, :-1]
    np.testing.assert_allclose(np.linalg.det(rotations), 1)


def test_the_best_start_names_its_winner(graph: PoseGraph) -> None:
    solved = graph.with_poses(solve(graph).poses)
    poses, winner = starting_poses(lost(solved), Start.BEST)
    assert winner in (Start.ODOMETRY, Start.SPANNING_TREE, Start.CHORDAL)
    assert graph_cost(graph.with_poses(poses)) < 1.1 * graph_cost(solved)
    poses, winner = starting_poses(graph, Start.GIVEN)
    assert winner is Start.GIVEN
    assert poses is graph.poses


def test_graphs_without_gauge_are_refused(graph: PoseGraph) -> None:
    loose = PoseGraph(
        poses=graph.poses,
        session=graph.session,
        index=graph.index,
        fixed=np.zeros(len(graph)),
        constraints=graph.constraints,
    )
    with pytest.raises(GraphError, match="no node is fixed"):
        starting_poses(loose, Start.CHORDAL)


@pytest.mark.data
@pytest.mark.parametrize(("name", "optimum"), [("manhattan", 1774.5205), ("intel", 22.5021), ("sphere2500", 675.70096)])
def test_standard_graphs_from_the_chordal_start(psg_data: Path, name: str, optimum: float) -> None:
    graph = read_g2o(psg_data / "g2o" / f"{name}.g2o")
    result = solve(graph.with_poses(chordal_poses(graph)))
    assert result.cost == pytest.approx(optimum, rel=2e-6)
    assert result.iterations <= 5
