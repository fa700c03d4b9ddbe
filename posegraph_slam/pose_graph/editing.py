"""Changing a graph: keeping one part, limiting information, dropping and adding edges. All return a new graph."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, in_range
from posegraph_slam.errors import GraphError
from posegraph_slam.pose_graph.checks import component_labels, edge_name
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.graph_file import node_ids
from posegraph_slam.pose_graph.noise import symmetrised

CLAMP_CONDITION = 1e12
"""Largest ratio of information eigenvalues of an edge that `clamp_indefinite` leaves."""


class Component(StrEnum):
    """What to do with a graph that falls into parts."""

    LARGEST = "largest"
    """Keep the largest part."""
    ALL = "all"
    """Keep all; in each part without a fixed node its first is fixed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edited:
    """A graph after a change, which edges (E,) of the old one it kept, and a line on what was done ("": nothing)."""

    graph: PoseGraph
    kept: BoolArray
    note: str


def keep_component(graph: PoseGraph, component: Component) -> Edited:
    """Keep the largest connected part of a graph, or fix a node in every part."""
    labels, all_edges = component_labels(graph), np.ones(len(graph.constraints), dtype=np.bool_)
    sizes = np.bincount(labels)
    if component is Component.ALL or len(sizes) == 1:
        first = np.unique(labels, return_index=True)[1]
        held = np.bincount(labels, weights=graph.fixed) > 0
        fixed = np.array(graph.fixed)
        fixed[first[~held]] = True
        changed = PoseGraph(poses=graph.poses, session=graph.session, index=graph.index, fixed=fixed,
                            constraints=graph.constraints)  # fmt: skip
        note = "" if held.all() else f"{int((~held).sum())} of {len(sizes)} disconnected parts got a fixed node"
        return Edited(graph=changed, kept=all_edges, note=note)
    rows = np.flatnonzero(labels == int(np.argmax(sizes)))
    part, kept = take_nodes(graph, rows)
    note = f"kept the largest of {len(sizes)} disconnected parts: {len(rows)} of {len(graph)} nodes"
    return Edited(graph=part, kept=kept, note=note)


def take_nodes(graph: PoseGraph, rows: IntArray) -> tuple[PoseGraph, BoolArray]:
    """Return the graph of the nodes at `rows` and which edges it kept; its first node is fixed if none was."""
    c, place = graph.constraints, np.full(len(graph), -1)
    place[rows] = np.arange(len(rows))
    kept = (place[c.i] >= 0) & (place[c.j] >= 0)
    inside = c.select(kept)
    constraints = Constraints(i=place[inside.i], j=place[inside.j], T_i_j=inside.T_i_j,
                              information=inside.information, kind=inside.kind)  # fmt: skip
    fixed = np.array(graph.fixed[rows])
    if not fixed.any():
        fixed[0] = True
    return PoseGraph(poses=graph.poses[rows], session=graph.session[rows], index=graph.index[rows], fixed=fixed,
                     constraints=constraints), kept  # fmt: skip


def clamp_indefinite(graph: PoseGraph) -> Edited:
    """Make every edge's information symmetric and positive definite.

    Eigenvalues below 1e-12 of the edge's largest are raised to it; edges whose largest is not positive cannot be
    repaired: `GraphError` names the first.
    """
    c, all_edges = graph.constraints, np.ones(len(graph.constraints), dtype=np.bool_)
    if not in_range(c.information).all():
        return Edited(graph=graph, kept=all_edges, note="")  # the check of the graph names the edge
    symmetric = symmetrised(c.information)
    values, vectors = np.linalg.eigh(symmetric)
    largest = values[:, -1:]
    if np.any(largest <= 0):
        edge = int(np.argmax(largest[:, 0] <= 0))
        raise GraphError(edge_name(graph, edge), "its information has no positive eigenvalue", "remove the edge")
    bad = (values[:, 0] < largest[:, 0] / CLAMP_CONDITION) | np.any(c.information != symmetric, axis=(1, 2))
    if not bad.any():
        return Edited(graph=graph, kept=all_edges, note="")
    raised = np.maximum(values, largest / CLAMP_CONDITION)
    repaired = symmetrised((vectors * raised[:, None, :]) @ np.swapaxes(vectors, 1, 2))
    constraints = with_information(c, np.where(bad[:, None, None], repaired, c.information))
    note = (
        f"clamped the information of {int(bad.sum())} of {len(c)} edges, first {edge_name(graph, int(np.argmax(bad)))}"
    )
    return Edited(graph=graph.with_constraints(constraints), kept=all_edges, note=note)


def with_information(constraints: Constraints, information: FloatArray) -> Constraints:
    """Return the constraints with other information (E, p, p)."""
    c = constraints
    return Constraints(i=c.i, j=c.j, T_i_j=c.T_i_j, information=information, kind=c.kind)


def drop_edges(graph: PoseGraph, *, edges: npt.ArrayLike = (), kinds: tuple[ConstraintKind, ...] = ()) -> PoseGraph:
    """Return the graph without the edges at numbers `edges` (order of the file, from 0) and those of `kinds`."""
    numbers = np.asarray(edges, dtype=np.int64)
    outside = (numbers < 0) | (numbers >= len(graph.constraints))
    if np.any(outside):
        raise GraphError("pose graph", f"it has no edge {numbers[outside][0]}",
                         f"edges are numbered 0 to {len(graph.constraints) - 1}")  # fmt: skip
    gone = np.isin(graph.constraints.kind, [int(kind) for kind in kinds])
    gone[numbers] = True
    return graph.with_constraints(graph.constraints.select(~gone))


def edges_between(graph: PoseGraph, first: int, second: int) -> IntArray:
    """Return the numbers of the edges that join two nodes, given by their file ids, in either direction."""
    a, b = row_of(graph, first), row_of(graph, second)
    c = graph.constraints
    found = np.flatnonzero(((c.i == a) & (c.j == b)) | ((c.i == b) & (c.j == a)))
    if len(found) == 0:
        raise GraphError("pose graph", f"no edge joins nodes {first} and {second}")
    return found


def row_of(graph: PoseGraph, node: int) -> int:
    """Return the row of the node with a file id; `GraphError` if there is none."""
    found = np.flatnonzero(node_ids(graph) == node)
    if len(found) == 0:
        raise GraphError("pose graph", f"it has no node {node}")
    return int(found[0])


def add_edge(
    graph: PoseGraph, i: int, j: int, T_i_j: FloatArray, *, information: FloatArray,
    kind: ConstraintKind = ConstraintKind.EXTERNAL,
) -> PoseGraph:  # fmt: skip
    """Return the graph with one more edge, last: T_i_j (d+1, d+1) between the nodes with file ids i and j."""
    new = Constraints(i=np.array([row_of(graph, i)]), j=np.array([row_of(graph, j)]), T_i_j=np.asarray(T_i_j)[None],
                      information=np.asarray(information)[None], kind=np.array([int(kind)]))  # fmt: skip
    return graph.with_constraints(Constraints.concatenate([graph.constraints, new]))


def duplicate_edges(graph: PoseGraph) -> IntArray:
    """Return the numbers of edges that repeat an earlier one between the same nodes with the same measurement."""
    c = graph.constraints
    rows = np.column_stack([c.i, c.j, c.T_i_j.reshape(len(c), -1).view(np.int64)]) if len(c) else np.zeros((0, 2))
    _, first = np.unique(rows, axis=0, return_index=True)
    return np.setdiff1d(np.arange(len(c)), first)
