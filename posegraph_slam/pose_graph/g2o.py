"""g2o files: VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX, read and written in full precision.

Two orders meet here and nowhere else: g2o writes SE(3) information translation first, GTSAM has rotation first. g2o
takes the vector part of the quaternion (theta/2) for the rotation error, GTSAM the angle: numbers are kept as they
are, GTSAM's reading, so a rotation weighs four times as much here as in the g2o program. Ids below 2^32 are nodes
of session 0; above, the upper half is the session (`node_ids`). FIX is written last because GTSAM's own reader drops
every SE(2) edge behind it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import pose_from_rotation_translation
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.graph_format import GraphFormat, read_graph_text, write_graph_text

QUATERNION_TOLERANCE = 1e-3
"""Largest deviation of |q| from 1 taken for rounding; files of four digits exist."""


def read_g2o(path: Path | str) -> PoseGraph:
    """Read a g2o file (`read_graph_text`)."""
    return read_graph_text(path, G2O)


def write_g2o(graph: PoseGraph, path: Path | str) -> None:
    """Write a graph as g2o (`write_graph_text`)."""
    write_graph_text(graph, path, G2O)


def pose_of_numbers(where: str, numbers: FloatArray) -> FloatArray:
    """Return the pose (d+1, d+1) of x y theta (3,) or x y z qx qy qz qw (7,)."""
    return np.asarray(G2O.poses(Path(where), numbers[None], np.zeros(1, dtype=np.int64))[0])


def _poses(path: Path, reals: FloatArray, lines: IntArray) -> FloatArray:
    """Turn x y z qx qy qz qw (n, 7) into matrices."""
    norm = np.linalg.norm(reals[:, 3:], axis=1)
    if np.any(bad := np.abs(norm - 1) > QUATERNION_TOLERANCE):
        row = int(np.argmax(bad))
        raise InputError(
            f"{path}:{lines[row]}", f"quaternion has length {norm[row]:.6g}", "expected qx qy qz qw of length 1"
        )
    return pose_from_rotation_translation(Rotation.from_quat(reals[:, 3:]).as_matrix(), reals[:, :3])


def _reals(poses: FloatArray) -> FloatArray:
    return np.concatenate([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()], axis=1)


G2O = GraphFormat(
    name="g2o",
    tags={"SE(2)": ("VERTEX_SE2", "EDGE_SE2"), "SE(3)": ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")},
    fix="FIX",
    spatial_size=7,
    spatial_poses=_poses,
    spatial_reals=_reals,
    planar_order=(0, 1, 2, 3, 4, 5),
)
