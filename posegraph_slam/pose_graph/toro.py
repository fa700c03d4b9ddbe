"""TORO files (.graph): VERTEX2, EDGE2, VERTEX3 and EDGE3, read and written in full precision.

Orders of its own: EDGE2 lists its information as xx xy yy tt xt yt; EDGE3 has roll, pitch, yaw (R = Rz Ry Rx) and the
upper triangle in [x, y, z, roll, pitch, yaw], here turned into GTSAM's order. The format knows no fixed nodes: the
first is.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, SE3, Group, pose_from_rotation_translation, pose_from_xyt, xyt_from_pose
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.graph_file import (
    assemble_graph,
    fold_information,
    group_of,
    node_ids,
    unfold_information,
    write_text,
)
from posegraph_slam.pose_graph.graph_text import RecordFormat, Records, format_records, read_records

FORMATS = {
    "VERTEX2": RecordFormat(ids=1, reals=3),
    "EDGE2": RecordFormat(ids=2, reals=9),
    "VERTEX3": RecordFormat(ids=1, reals=6),
    "EDGE3": RecordFormat(ids=2, reals=27),
}
TAGS = {"SE(2)": ("VERTEX2", "EDGE2"), "SE(3)": ("VERTEX3", "EDGE3")}
ROWS_OF_EDGE2 = np.array([0, 1, 4, 2, 5, 3])
"""Which of EDGE2's six information values is each of the upper triangle xx xy xt yy yt tt; `COLUMNS` inverts it."""
COLUMNS_OF_EDGE2 = np.argsort(ROWS_OF_EDGE2)


def read_toro(path: Path | str) -> PoseGraph:
    """Read a TORO file; nodes, kinds of constraints, missing vertices and errors are those of `read_g2o`."""
    path = Path(path)
    records = read_records(path, FORMATS)
    group = group_of(path, records, TAGS)
    vertices, edges = (records[tag] for tag in TAGS[group.name])
    size = group.dof
    upper = edges.reals[:, size:]
    nothing = Records(ids=np.zeros((0, 1), dtype=np.int64), reals=np.zeros((0, 0)), lines=np.zeros(0, dtype=np.int64))
    return assemble_graph(
        path,
        group,
        vertices=(vertices, _poses(group, vertices.reals)),
        edges=(edges, _poses(group, edges.reals[:, :size])),
        information=unfold_information(group, upper[:, ROWS_OF_EDGE2] if group is SE2 else upper),
        fixed=nothing,
    )


def write_toro(graph: PoseGraph, path: Path | str) -> None:
    """Write a graph as TORO; raises `InputError` if other nodes than the first are fixed, which it cannot say."""
    path, c, ids = Path(path), graph.constraints, node_ids(graph)
    if not np.array_equal(np.flatnonzero(graph.fixed), [0]):
        raise InputError(path, "a TORO file cannot say which nodes are fixed, and here it is not just the first",
                         "write g2o")  # fmt: skip
    vertex, edge = TAGS[graph.group.name]
    upper = fold_information(graph.group, c.information)
    upper = upper[:, COLUMNS_OF_EDGE2] if graph.group is SE2 else upper
    reals = np.concatenate([_reals(c.T_i_j), upper], axis=1)
    lines = [
        *format_records(vertex, ids[:, None], _reals(graph.poses)),
        *format_records(edge, np.stack([ids[c.i], ids[c.j]], axis=1), reals),
    ]
    write_text(path, "\n".join(lines) + "\n")


def _poses(group: Group, reals: FloatArray) -> FloatArray:
    if group is SE2:
        return pose_from_xyt(reals)
    if len(reals) == 0:
        return SE3.identity(0)
    return pose_from_rotation_translation(Rotation.from_euler("xyz", reals[:, 3:]).as_matrix(), reals[:, :3])


def _reals(poses: FloatArray) -> FloatArray:
    if poses.shape[-1] == 3:
        return xyt_from_pose(poses)
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz") if len(poses) else np.zeros((0, 3))
    return np.concatenate([poses[:, :3, 3], angles], axis=1)
