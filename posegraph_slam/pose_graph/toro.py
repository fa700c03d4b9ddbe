"""TORO files (.graph): VERTEX2, EDGE2, VERTEX3 and EDGE3, read and written in full precision.

Orders of its own: EDGE2 lists its information as xx xy yy tt xt yt; EDGE3 has roll, pitch, yaw (R = Rz Ry Rx) and the
upper triangle in [x, y, z, roll, pitch, yaw], here turned into GTSAM's order. The format knows no fixed nodes: the
first is.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.geometry import pose_from_rotation_translation
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.graph_format import GraphFormat, read_graph_text, write_graph_text


def read_toro(path: Path | str) -> PoseGraph:
    """Read a TORO file (`read_graph_text`)."""
    return read_graph_text(path, TORO)


def write_toro(graph: PoseGraph, path: Path | str) -> None:
    """Write a graph as TORO (`write_graph_text`)."""
    write_graph_text(graph, path, TORO)


def _poses(_path: Path, reals: FloatArray, _lines: IntArray) -> FloatArray:
    """Turn x y z roll pitch yaw (n, 6) into matrices."""
    return pose_from_rotation_translation(Rotation.from_euler("xyz", reals[:, 3:]).as_matrix(), reals[:, :3])


def _reals(poses: FloatArray) -> FloatArray:
    return np.concatenate([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz")], axis=1)


TORO = GraphFormat(
    name="TORO",
    tags={"SE(2)": ("VERTEX2", "EDGE2"), "SE(3)": ("VERTEX3", "EDGE3")},
    fix=None,
    spatial_size=6,
    spatial_poses=_poses,
    spatial_reals=_reals,
    planar_order=(0, 1, 4, 2, 5, 3),
)
