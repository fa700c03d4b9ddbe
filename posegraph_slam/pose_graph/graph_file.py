"""From the records of a pose-graph file to a graph: ids to rows, kinds of constraints, missing vertices, the gauge."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.errors import InputError
from posegraph_slam.files import replacing
from posegraph_slam.geometry import SE2, SE3, Group
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.graph_text import Records
from posegraph_slam.pose_graph.initialization import propagate_poses

TRANSLATION_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""Where translation-first tangents of SE(3) stand in rotation-first ones."""
SESSION_BITS = 32
"""A file knows one id a node: session * 2^32 + index, so that files of one log keep their numbers."""


def node_ids(graph: PoseGraph) -> IntArray:
    """Return the file id (N,) of every node: session * 2^32 + index, which is the index in session 0."""
    return (graph.session << SESSION_BITS) | graph.index


def assemble_graph(
    path: Path,
    group: Group,
    *,
    vertices: tuple[Records, FloatArray],
    edges: tuple[Records, FloatArray],
    information: FloatArray,
    fixed: Records,
) -> PoseGraph:
    """Build the graph of a file from its records and their poses.

    Nodes stand in the order of their vertex records, then those that only edges name, by id; the latter get poses by
    composing edges. Edges between ids of a session that follow each other are `ODOMETRY`, others `EXTERNAL`. Without
    fixed ids the first node is fixed. Raises `InputError` with file and line for a vertex given twice, a self edge or
    an unknown fixed id.
    """
    vertex_ids, ends = vertices[0].ids[:, 0], edges[0].ids
    _check_vertices(path, vertices[0])
    if len(itself := np.flatnonzero(ends[:, 0] == ends[:, 1])):
        raise InputError(f"{path}:{edges[0].lines[itself[0]]}", f"edge joins node {ends[itself[0], 0]} to itself")
    ids = np.concatenate([vertex_ids, np.setdiff1d(ends, vertex_ids)])
    ends_rows = _rows_of(ids, ends)
    held = _rows_of(ids, fixed.ids[:, 0])
    if len(unknown := np.flatnonzero(held < 0)):
        raise InputError(
            f"{path}:{fixed.lines[unknown[0]]}", f"FIX names node {fixed.ids[unknown[0], 0]}, which is not there"
        )
    rank = np.argsort(np.argsort(ids))[ends_rows]
    odometry = (np.abs(rank[:, 1] - rank[:, 0]) == 1) & (ends[:, 0] >> SESSION_BITS == ends[:, 1] >> SESSION_BITS)
    constraints = Constraints(
        i=ends_rows[:, 0],
        j=ends_rows[:, 1],
        T_i_j=edges[1],
        information=information,
        kind=np.where(odometry, int(ConstraintKind.ODOMETRY), int(ConstraintKind.EXTERNAL)),
    )
    known = np.arange(len(ids)) < len(vertex_ids)
    poses = np.concatenate([vertices[1], group.identity(len(ids) - len(vertex_ids))])
    if not known.all():
        poses = propagate_poses(group, poses, known, constraints)
    is_fixed = np.isin(np.arange(len(ids)), held if len(held) else [0])
    index = ids & ((1 << SESSION_BITS) - 1)
    return PoseGraph(poses=poses, session=ids >> SESSION_BITS, index=index, fixed=is_fixed, constraints=constraints)


def _check_vertices(path: Path, vertices: Records) -> None:
    _, first, counts = np.unique(vertices.ids[:, 0], return_index=True, return_counts=True)
    if np.any(counts > 1):
        once = np.isin(np.arange(len(vertices.lines)), first)
        row = int(np.argmin(once))
        raise InputError(f"{path}:{vertices.lines[row]}", f"node {vertices.ids[row, 0]} is given twice")


def _rows_of(ids: IntArray, wanted: IntArray) -> IntArray:
    """Return the positions of `wanted`, any shape, in `ids`; -1 where there is none."""
    order = np.argsort(ids)
    place = np.minimum(np.searchsorted(ids, wanted, sorter=order), len(ids) - 1)
    rows = order[place]
    return np.where(ids[rows] == wanted, rows, -1)


def group_of(path: Path, records: Mapping[str, Records], tags: Mapping[str, tuple[str, str]]) -> Group:
    """Return the group whose tags a file's records have; `tags` maps a group's name to its vertex and edge tags."""
    present = [g for g in (SE2, SE3) if any(len(records[tag].lines) for tag in tags[g.name])]
    if len(present) != 1:
        problem = "it mixes planar and spatial records" if present else "it holds no pose and no edge"
        raise InputError(path, problem, "give a file of either kind")
    return present[0]


def unfold_information(group: Group, upper: FloatArray) -> FloatArray:
    """Unfold upper triangles, row by row (n, p(p+1)/2), translation first, into information in GTSAM's order."""
    rows, columns = _places(group)
    matrix = np.zeros((len(upper), group.dof, group.dof))
    matrix[:, rows, columns] = upper
    matrix[:, columns, rows] = upper
    return matrix


def fold_information(group: Group, information: FloatArray) -> FloatArray:
    """Invert `unfold_information`."""
    rows, columns = _places(group)
    return information[:, rows, columns]


def _places(group: Group) -> tuple[IntArray, IntArray]:
    """Return where in GTSAM's order the entries of a translation-first upper triangle stand."""
    rows, columns = np.triu_indices(group.dof)
    return (rows, columns) if group is SE2 else (TRANSLATION_FIRST[rows], TRANSLATION_FIRST[columns])


def write_text(path: Path, text: str) -> None:
    """Write a file that appears complete or not at all; `InputError` where that is not possible."""
    try:
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise InputError(path, f"cannot be written ({error.strerror})", "give another place") from None
