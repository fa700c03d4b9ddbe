"""The tree of frames of a bag (TF): where sensors are mounted, and odometry where no topic of its own tells it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray, in_range
from posegraph_slam.datasets.rosbag.growing import GrowingRows
from posegraph_slam.geometry import Trajectory, inverse_pose, pose_from_rotation_translation

USUAL_BASES = ("base_link", "base_footprint", "base", "base_frame", "robot")
MOVES_M, MOVES_RAD = 1e-3, 2e-3
"""A mounting that is published again and again counts as fixed when it varies by less."""


@dataclass(slots=True)
class Link:
    """Poses T_parent_child over time, as rows [stamp, x, y, z, qx, qy, qz, qw]."""

    parent: str
    rows: GrowingRows


class FrameTree:
    """Collects the transforms of a bag; afterwards answers where one frame lies in another."""

    def __init__(self) -> None:
        self._links: dict[tuple[str, str], Link] = {}
        self._poses: dict[tuple[str, str], tuple[FloatArray, FloatArray]] = {}
        self.remarks: list[str] = []

    def add(self, message: Any) -> None:
        """Take over the transforms of one TFMessage."""
        for transform in message.transforms:
            stamp = transform.header.stamp
            t, q = transform.transform.translation, transform.transform.rotation
            parent, child = bare(transform.header.frame_id), bare(transform.child_frame_id)
            link = self._links.setdefault((parent, child), Link(parent=parent, rows=GrowingRows((8,))))
            link.rows.append((stamp.sec + 1e-9 * stamp.nanosec, t.x, t.y, t.z, q.x, q.y, q.z, q.w))

    def finish(self) -> None:
        """Turn what was collected into poses; a frame with several parents keeps the one told most often."""
        by_child: dict[str, list[tuple[int, str]]] = {}
        for (parent, child), link in self._links.items():
            by_child.setdefault(child, []).append((len(link.rows), parent))
        for child, parents in by_child.items():
            if len(parents) > 1:
                kept = max(parents)[1]
                names = ", ".join(sorted(parent for _, parent in parents))
                self.remarks.append(f"frame {child} has several parents ({names}): {kept} is taken")
                parents[:] = [(0, kept)]
            rows = self._links[(parents[0][1], child)].rows.take()
            rows = rows[in_range(rows).all(axis=1) & (np.linalg.norm(rows[:, 4:], axis=1) > 1e-6)]
            if len(rows):
                R = Rotation.from_quat(rows[:, 4:]).as_matrix()
                self._poses[(parents[0][1], child)] = rows[:, 0], pose_from_rotation_translation(R, rows[:, 1:4])
        self._links.clear()

    @property
    def frames(self) -> set[str]:
        """All frames of the tree."""
        return {name for link in self._poses for name in link}

    def chain(self, frame: str) -> list[tuple[str, str]]:
        """Return the links from `frame` up to its root, each (parent, child)."""
        parents = {child: parent for parent, child in self._poses}
        found: list[tuple[str, str]] = []
        while frame in parents and len(found) <= len(parents):  # the bound ends a ring
            found.append((parents[frame], frame))
            frame = parents[frame]
        return found

    def mounting(self, base: str, sensor: str) -> FloatArray | None:
        """Return T_base_sensor (4, 4); None where the two are not connected. A link that moves gets a remark."""
        base, sensor = bare(base), bare(sensor)
        if base == sensor:
            return np.eye(4)
        up, over = self.chain(sensor), self.chain(base)
        common = {child for _, child in up} | {up[-1][0] if up else sensor}
        meeting = next((name for name in [base, *(parent for parent, _ in over)] if name in common), None)
        if meeting is None:
            return None
        T_meeting_sensor, T_meeting_base = (self._compose(links, meeting) for links in (up, over))
        return np.asarray(inverse_pose(T_meeting_base) @ T_meeting_sensor)

    def _compose(self, links: list[tuple[str, str]], top: str) -> FloatArray:
        """Pose of the lowest frame of a chain in `top`."""
        T = np.eye(4)
        for parent, child in links:
            if child == top:
                break
            T = self._fixed(parent, child) @ T
        return T

    def _fixed(self, parent: str, child: str) -> FloatArray:
        poses = self._poses[(parent, child)][1]
        first: FloatArray = poses[0]
        relative = inverse_pose(first) @ poses
        turn = Rotation.from_matrix(relative[:, :3, :3]).magnitude()
        if np.linalg.norm(relative[:, :3, 3], axis=1).max() > MOVES_M or turn.max() > MOVES_RAD:
            self.remarks.append(f"{child} moves in {parent}: its first pose is taken as its mounting")
        return first

    def odometry_links(self) -> list[tuple[str, str]]:
        """Return the links whose parent is an odometry frame and which are told more than once."""
        return [
            (parent, child)
            for (parent, child), (stamps, _) in self._poses.items()
            if "odom" in parent.rsplit("/", 1)[-1].lower() and len(stamps) > 1
        ]

    def base_below_odometry(self, sensor: str) -> tuple[str, str] | None:
        """Return the link (odom, base) above `sensor`, else the one told most often."""
        links = self.odometry_links()
        above = [link for link in self.chain(bare(sensor)) if link in links]
        return next(iter(above), None) or max(links, key=lambda link: len(self._poses[link][0]), default=None)

    def trajectory(self, parent: str, child: str) -> Trajectory:
        """Return T_parent_child over time in the order of recording."""
        stamps, poses = self._poses[(parent, child)]
        return Trajectory(stamps_s=stamps, poses=poses, parent="odom", child="base")


def bare(frame: str) -> str:
    """Return a frame's name without the slash that ROS 1 may put before it."""
    return frame.lstrip("/")
