"""g2o files: VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX, read and written in full precision.

Two orders meet here and nowhere else: g2o writes SE(3) information translation first, GTSAM has rotation first. g2o
takes the vector part of the quaternion (theta/2) for the rotation error, GTSAM the angle: numbers are kept as they
are, GTSAM's reading, so a rotation weighs four times as much here as in the g2o program. Ids below 2^32 are nodes
of session 0; above, the upper half is the session (`node_ids`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, pose_from_rotation_translation, pose_from_xyt, xyt_from_pose
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.graph_file import (
    assemble_graph,
    fold_information,
    group_of,
    node_ids,
    unfold_information,
    write_text,
)
from posegraph_slam.pose_graph.graph_text import RecordFormat, format_records, read_records

FORMATS = {
    "VERTEX_SE2": RecordFormat(ids=1, reals=3),
    "EDGE_SE2": RecordFormat(ids=2, reals=9),
    "VERTEX_SE3:QUAT": RecordFormat(ids=1, reals=7),
    "EDGE_SE3:QUAT": RecordFormat(ids=2, reals=28),
    "FIX": RecordFormat(ids=None, reals=0),
}
TAGS = {"SE(2)": ("VERTEX_SE2", "EDGE_SE2"), "SE(3)": ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")}
QUATERNION_TOLERANCE = 1e-3
"""Largest deviation of |q| from 1 taken for rounding; files of four digits exist."""


def read_g2o(path: Path | str) -> PoseGraph:
    """Read a g2o file; nodes stand in the order of their vertex lines, then those that only edges name, by id.

    Edges between successive ids are `ODOMETRY`, others `EXTERNAL`. Vertices that are missing get poses from the edges;
    without a FIX record the first node is fixed. Raises `InputError` with file and line for anything not understood.
    """
    path = Path(path)
    records = read_records(path, FORMATS)
    group = group_of(path, records, TAGS)
    vertices, edges = (records[tag] for tag in TAGS[group.name])
    size = 3 if group is SE2 else 7
    constraints_T = _poses(path, edges.reals[:, :size], edges.lines)
    return assemble_graph(
        path,
        group,
        vertices=(vertices, _poses(path, vertices.reals, vertices.lines)),
        edges=(edges, constraints_T),
        information=unfold_information(group, edges.reals[:, size:]),
        fixed=records["FIX"],
    )


def write_g2o(graph: PoseGraph, path: Path | str) -> None:
    """Write a graph as g2o: vertices, edges, then FIX records, each number with the digits that restore it.

    Ids are `node_ids`. FIX stands last because GTSAM's own reader drops every SE(2) edge behind it. The file appears
    complete or not at all.
    """
    path, c, ids = Path(path), graph.constraints, node_ids(graph)
    vertex, edge = TAGS[graph.group.name]
    ends = np.stack([ids[c.i], ids[c.j]], axis=1)
    reals = np.concatenate([_reals(c.T_i_j), fold_information(graph.group, c.information)], axis=1)
    lines = [
        *format_records(vertex, ids[:, None], _reals(graph.poses)),
        *format_records(edge, ends, reals),
        *(f"FIX {number}" for number in ids[graph.fixed].tolist()),
    ]
    write_text(path, "\n".join(lines) + "\n")


def pose_of_numbers(where: str, numbers: FloatArray) -> FloatArray:
    """Return the pose (d+1, d+1) of x y theta (3,) or x y z qx qy qz qw (7,)."""
    return np.asarray(_poses(Path(where), numbers[None], np.zeros(1, dtype=np.int64))[0])


def _poses(path: Path, reals: FloatArray, lines: IntArray) -> FloatArray:
    """Turn x y theta (n, 3) or x y z qx qy qz qw (n, 7) into matrices."""
    if reals.shape[1] == 3:
        return pose_from_xyt(reals)
    if len(reals) == 0:
        return np.zeros((0, 4, 4))
    norm = np.linalg.norm(reals[:, 3:], axis=1)
    if np.any(bad := np.abs(norm - 1) > QUATERNION_TOLERANCE):
        row = int(np.argmax(bad))
        raise InputError(
            f"{path}:{lines[row]}", f"quaternion has length {norm[row]:.6g}", "expected qx qy qz qw of length 1"
        )
    return pose_from_rotation_translation(Rotation.from_quat(reals[:, 3:]).as_matrix(), reals[:, :3])


def _reals(poses: FloatArray) -> FloatArray:
    """Invert `_poses`."""
    if poses.shape[-1] == 3:
        return xyt_from_pose(poses)
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat() if len(poses) else np.zeros((0, 4))
    return np.concatenate([poses[:, :3, 3], quaternions], axis=1)
