from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from posegraph_slam.errors import GraphError
from posegraph_slam.geometry import SE2, Group
from posegraph_slam.pose_graph.checks import check_graph, component_labels
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph


def with_fixed(graph: PoseGraph, fixed: np.ndarray) -> PoseGraph:
    return PoseGraph(
        poses=graph.poses, session=graph.session, index=graph.index + 100, fixed=fixed, constraints=graph.constraints
    )


def edited(array: np.ndarray, where: object, value: object) -> np.ndarray:
    result = np.array(array)
    result[where] = value
    return result


def test_a_good_graph_passes(graph: PoseGraph) -> None:
    check_graph(graph)


def test_missing_gauge_is_named(graph: PoseGraph) -> None:
    with pytest.raises(GraphError, match="no node is fixed; fix one, for instance node 100"):
        check_graph(with_fixed(graph, np.zeros(len(graph), dtype=bool)))


def test_disconnected_part_is_named(graph: PoseGraph) -> None:
    c = graph.constraints
    keep = (c.i < 25) & (c.j < 25) | (c.i >= 25) & (c.j >= 25)
    cut = with_fixed(graph.with_constraints(c.select(keep)), graph.fixed)
    with pytest.raises(
        GraphError, match=r"2 disconnected parts of 25, 15 nodes, and the part of node 125 has no fixed"
    ):
        check_graph(cut)
    check_graph(with_fixed(cut, np.isin(np.arange(len(graph)), [0, 30])))
    assert np.array_equal(component_labels(cut), (np.arange(len(graph)) >= 25).astype(int))


def test_sessions_are_named(graph: PoseGraph) -> None:
    poses = edited(graph.poses, (7, 0, 0), np.nan)
    named = PoseGraph(
        poses=poses, session=np.full(len(graph), 3), index=graph.index, fixed=graph.fixed, constraints=graph.constraints
    )
    with pytest.raises(GraphError, match="node 7 of session 3: its pose is not finite"):
        check_graph(named)


@pytest.mark.parametrize(
    ("field", "where", "value", "message"),
    [
        ("T_i_j", (5, 0, 1), np.nan, r"edge 5 \(node 5 to node 6\): its measurement is not finite"),
        ("T_i_j", (5, 0, 0), 3.0, r"edge 5 \(node 5 to node 6\): the rotation of its measurement is not orthonormal"),
        ("information", (5, 0, 0), np.inf, r"edge 5 \(node 5 to node 6\): its information is not finite"),
        ("T_i_j", (5, 0, 2), 1e300, r"edge 5 \(node 5 to node 6\): its measurement is beyond 1e\+30"),
        ("information", (5, 0, 0), 1e40, r"edge 5 \(node 5 to node 6\): its information is beyond 1e\+30"),
        ("information", (5, 0, 1), 1e6, r"edge 5 \(node 5 to node 6\): its information is not symmetric"),
        ("information", (5, 0, 0), -1e6, r"edge 5 \(node 5 to node 6\): its information is not positive definite"),
        ("information", (5,), 0.0, r"edge 5 \(node 5 to node 6\): its information is not positive definite"),
        ("j", (5,), 5, r"edge 5 \(node 5 to node 5\): joins a node to itself"),
        ("j", (5,), 400, r"edge 5: joins rows 5 and 400 of a graph of 40 nodes"),
        ("i", (5,), -1, r"edge 5: joins rows -1 and 6"),
    ],
)
def test_bad_edges_are_named(
    graph: PoseGraph, change: Callable[..., Constraints], field: str, where: tuple[int], value: float, message: str
) -> None:
    array = edited(getattr(graph.constraints, field), where, value)
    with pytest.raises(GraphError, match=message):
        check_graph(graph.with_constraints(change(graph.constraints, **{field: array})))


def test_other_faults(group: Group, graph: PoseGraph, graph_maker: Callable[..., PoseGraph]) -> None:
    with pytest.raises(GraphError, match="node 3: its rotation is not orthonormal"):
        check_graph(graph.with_poses(edited(graph.poses, (3, 0, 0), 1.1)))
    with pytest.raises(GraphError, match="no nodes"):
        check_graph(PoseGraph(poses=group.identity(0), session=np.zeros(0), index=np.zeros(0), fixed=np.zeros(0),
                              constraints=Constraints.empty(group)))  # fmt: skip
    if group is not SE2:
        with pytest.raises(GraphError, match="do not fit"):
            check_graph(graph.with_constraints(graph_maker(SE2).constraints))
