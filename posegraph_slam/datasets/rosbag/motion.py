"""Odometry, true poses and inertial measurements of a bag, a row a message."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray, in_range
from posegraph_slam.datasets.rosbag.frames import bare
from posegraph_slam.datasets.rosbag.growing import GrowingRows
from posegraph_slam.geometry import pose_from_rotation_translation


@dataclass(slots=True)
class PoseCollector:
    """Takes Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped messages."""

    topic: str
    child: str = ""
    _rows: GrowingRows = field(default_factory=lambda: GrowingRows((9,)))

    def add(self, message: Any, recorded_ns: int) -> None:
        """Take one pose."""
        self.child = self.child or bare(getattr(message, "child_frame_id", ""))
        t, q = _position_and_rotation(message)
        stamp = message.header.stamp
        seconds = stamp.sec + 1e-9 * stamp.nanosec
        self._rows.append((seconds, 1e-9 * recorded_ns, t.x, t.y, t.z, q.x, q.y, q.z, q.w))

    def finish(self) -> tuple[FloatArray, FloatArray, FloatArray, int]:
        """Return stamps (N,), times of recording (N,), poses (N, 4, 4), and how many were not finite and left out."""
        rows = self._rows.take()
        usable = in_range(rows).all(axis=1) & (np.linalg.norm(rows[:, 5:], axis=1) > 1e-6)
        dropped = int(np.count_nonzero(~usable))
        rows = rows[usable]
        R = Rotation.from_quat(rows[:, 5:]).as_matrix() if len(rows) else np.empty((0, 3, 3))
        return rows[:, 0], rows[:, 1], pose_from_rotation_translation(R, rows[:, 2:5]), dropped


def _position_and_rotation(message: Any) -> tuple[Any, Any]:
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return pose.position, pose.orientation


@dataclass(slots=True)
class ImuCollector:
    """Takes Imu messages; their orientation is the driver's own estimate and not used."""

    topic: str
    frame: str = ""
    _rows: GrowingRows = field(default_factory=lambda: GrowingRows((8,)))

    def add(self, message: Any, recorded_ns: int) -> None:
        """Take one measurement."""
        self.frame = self.frame or bare(message.header.frame_id)
        stamp, w, a = message.header.stamp, message.angular_velocity, message.linear_acceleration
        self._rows.append((stamp.sec + 1e-9 * stamp.nanosec, 1e-9 * recorded_ns, w.x, w.y, w.z, a.x, a.y, a.z))

    def finish(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, int]:
        """Return stamps, times of recording (N,), rates and accelerations (N, 3), and how many were not finite."""
        rows = self._rows.take()
        usable = in_range(rows).all(axis=1)
        kept = rows[usable]
        return kept[:, 0], kept[:, 1], kept[:, 2:5], kept[:, 5:8], int(np.count_nonzero(~usable))
