"""Edits give the graph that they name, and refuse what is not there."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.errors import GraphError
from posegraph_slam.pose_graph.checks import check_graph, component_labels
from posegraph_slam.pose_graph.editing import (
    Component,
    add_edge,
    clamp_indefinite,
    drop_edges,
    duplicate_edges,
    edges_between,
    keep_component,
    with_information,
)
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.solve import solve


@pytest.fixture
def broken(graph: PoseGraph) -> PoseGraph:
    """Two parts: the first 25 nodes and the other 15."""
    c = graph.constraints
    return graph.with_constraints(c.select((c.i < 25) == (c.j < 25)))


def test_the_largest_part_is_kept(broken: PoseGraph) -> None:
    with pytest.raises(GraphError, match="2 disconnected parts of 25, 15 nodes"):
        check_graph(broken)
    change = keep_component(broken, Component.LARGEST)
    check_graph(change.graph)
    np.testing.assert_array_equal(change.graph.index, np.arange(25))
    assert "25 of 40 nodes" in change.note
    c = broken.constraints
    np.testing.assert_array_equal(change.kept, c.i < 25)
    np.testing.assert_array_equal(change.graph.constraints.T_i_j, c.T_i_j[c.i < 25])


def test_all_parts_get_a_fixed_node(broken: PoseGraph) -> None:
    change = keep_component(broken, Component.ALL)
    check_graph(change.graph)
    assert np.flatnonzero(change.graph.fixed).tolist() == [0, 25]
    assert np.max(component_labels(change.graph)) == 1
    assert solve(change.graph).converged


def test_a_connected_graph_is_left_alone(graph: PoseGraph) -> None:
    for component in Component:
        change = keep_component(graph, component)
        assert change.note == ""
        assert change.kept.all()


def test_indefinite_information_is_repaired_and_named(graph: PoseGraph) -> None:
    information = np.array(graph.constraints.information)
    values, vectors = np.linalg.eigh(information[7])
    values[0] = -1.0
    information[7] = (vectors * values) @ vectors.T
    information[9, 0, 1] += 1.0
    spoilt = graph.with_constraints(with_information(graph.constraints, information))
    with pytest.raises(GraphError):
        check_graph(spoilt)
    change = clamp_indefinite(spoilt)
    check_graph(change.graph)
    assert "2 of" in change.note
    assert "edge 7" in change.note
    same = np.ones(len(information), bool)
    same[[7, 9]] = False
    np.testing.assert_array_equal(change.graph.constraints.information[same], information[same])
    information[3] = -np.eye(graph.group.dof)
    with pytest.raises(GraphError, match="edge 3"):
        clamp_indefinite(graph.with_constraints(with_information(graph.constraints, information)))


def test_edges_are_dropped_and_added_back(graph: PoseGraph) -> None:
    c = graph.constraints
    less = drop_edges(graph, edges=[45], kinds=(ConstraintKind.START_END,))
    assert len(less.constraints) == len(c) - 1
    again = add_edge(less, int(c.i[45]), int(c.j[45]), c.T_i_j[45], information=c.information[45],
                     kind=ConstraintKind(int(c.kind[45])))  # fmt: skip
    warm = solve(graph.with_poses(solve(less).poses))
    assert warm.cost == pytest.approx(solve(again).cost, rel=1e-9)
    assert len(drop_edges(graph, kinds=(ConstraintKind.PROXIMITY,)).constraints) == 39


def test_what_is_not_there_is_refused(graph: PoseGraph) -> None:
    with pytest.raises(GraphError, match="no edge 70"):
        drop_edges(graph, edges=[70])
    with pytest.raises(GraphError, match="no node 99"):
        edges_between(graph, 0, 99)
    with pytest.raises(GraphError, match="no edge joins"):
        edges_between(graph.with_constraints(graph.constraints.select(np.arange(39))), 0, 5)
    assert edges_between(graph, 1, 0)[0] == 0


def test_duplicates_are_found(graph: PoseGraph) -> None:
    c = graph.constraints
    twice = graph.with_constraints(Constraints.concatenate([c, c.select(np.array([3]))]))
    np.testing.assert_array_equal(duplicate_edges(twice), [len(c)])
    assert len(duplicate_edges(graph)) == 0
