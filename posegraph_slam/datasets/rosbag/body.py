"""The robot's own frame in a bag, and where its sensors are on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.rosbag.bag import Bag
from posegraph_slam.datasets.rosbag.collecting import Collected
from posegraph_slam.datasets.rosbag.frames import USUAL_BASES, FrameTree, bare
from posegraph_slam.datasets.rosbag.topics import Choice
from posegraph_slam.errors import InputError


@dataclass(slots=True)
class BodyFrames:
    """The robot's frame, and the mounting of sensors on it."""

    tree: FrameTree
    base: str | None
    odometry_link: tuple[str, str] | None

    @classmethod
    def of(cls, bag: Bag, choice: Choice, found: Collected, remarks: list[str]) -> BodyFrames:
        """Find the base: as named, else the child of the odometry, else the frame below odom, else a usual name."""
        tree = found.tree
        sensor = found.scan.frame if found.scan else found.cloud_frame or (found.imu.frame if found.imu else "")
        link = tree.base_below_odometry(sensor)
        child = found.odom.child if found.odom else ""
        named = [choice.base] if choice.base else [child, link[1] if link else "", *USUAL_BASES]
        base = next((bare(name) for name in named if name and bare(name) in tree.frames), None)
        if choice.base and base is None:
            frames = ", ".join(sorted(tree.frames)) or "none"
            raise InputError(bag.path, f"has no frame {choice.base}", f"the frames of its tree are {frames}")
        if child and base is not None and bare(child) != base:
            remarks.append(f"the odometry is of frame {child}, which is not in the frame tree: taken as {base}")
        return cls(tree=tree, base=base or (child or None), odometry_link=link)

    def mounting(self, sensor: str, what: str, remarks: list[str]) -> FloatArray | None:
        """Return T_base_sensor; None, with a remark, where the frame tree does not tell it."""
        T = self.tree.mounting(self.base, sensor) if self.base and sensor else None
        if T is None:
            named = f"{what} ({sensor})" if sensor else what
            remarks.append(f"the frame tree does not say where {named} is on {self.base or 'the robot'}: at its centre")
            return None
        x, y, z = T[:3, 3]
        if np.abs(T - np.eye(4)).max() > 1e-9:
            turn = np.degrees(np.arctan2(T[1, 0], T[0, 0]))
            remarks.append(f"{what} ({sensor}) is at {x:.3f} {y:.3f} {z:.3f} m, {turn:.1f} deg on {self.base}")
        return T
