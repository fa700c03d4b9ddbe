"""A walking humanoid: its head's angles, and where its laser points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError

COM_HEIGHT_M, HEAD_ABOVE_COM_M, LIDAR_ABOVE_HEAD_M = 0.93, 0.33, 0.15
"""Heights of the robot of the course: centre of mass above the ground, head above it, LiDAR above the head."""

AXES = {"x": np.array([1.0, 0.0, 0.0]), "y": np.array([0.0, 1.0, 0.0]), "z": np.array([0.0, 0.0, 1.0])}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointAngles:
    """Stamps (N,) that never fall, and the head's angles (N,): yaw positive to the left, pitch positive down."""

    stamps_s: FloatArray
    neck_yaw_rad: FloatArray
    head_pitch_rad: FloatArray

    def __post_init__(self) -> None:
        for name in ("stamps_s", "neck_yaw_rad", "head_pitch_rad"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
            if getattr(self, name).shape != self.stamps_s.shape or self.stamps_s.ndim != 1:
                raise InputError("joint angles", f"{name} does not fit {self.stamps_s.shape} stamps")

    def __len__(self) -> int:
        return int(self.stamps_s.shape[0])

    def nearest(self, stamps_s: FloatArray) -> IntArray:
        """Return the index (M,) of the sample nearest in time to each stamp (M,); the earlier one of two as near."""
        if len(self) == 0:
            raise InputError("joint angles", "hold no sample")
        after = np.clip(np.searchsorted(self.stamps_s, stamps_s), 1, max(len(self) - 1, 1))
        before = after - 1
        if len(self) == 1:
            return np.zeros(len(stamps_s), dtype=np.int64)
        later = self.stamps_s[after] - stamps_s < stamps_s - self.stamps_s[before]
        return np.where(later, after, before)


def lidar_on_level_body(
    neck_yaw_rad: FloatArray, head_pitch_rad: FloatArray, roll_rad: FloatArray, pitch_rad: FloatArray
) -> FloatArray:
    """Return T_base_lidar (N, 4, 4): base is the point of the ground below the body, x along its heading, z up.

    The chain of the course: ground from body (centre of mass, 0.93 m up), Ry(pitch) Rx(roll) of the body, Rz(neck yaw)
    with the head 0.33 m above the centre of mass, Ry(head pitch) with the LiDAR 0.15 m above the head. The body's yaw
    is left to the trajectory.
    """
    head_lidar = _pose("y", head_pitch_rad, LIDAR_ABOVE_HEAD_M)
    body_head = _pose("z", neck_yaw_rad, HEAD_ABOVE_COM_M)
    level_body = np.tile(np.eye(4), (len(np.atleast_1d(roll_rad)), 1, 1))
    level_body[:, :3, :3] = Rotation.from_euler("YX", np.column_stack([pitch_rad, roll_rad])).as_matrix()
    level_body[:, 2, 3] = COM_HEIGHT_M
    return np.asarray(level_body @ body_head @ head_lidar)


def _pose(axis: str, angle_rad: FloatArray, height_m: float) -> FloatArray:
    """Poses (N, 4, 4) turned about an axis, `height_m` up."""
    angle = np.atleast_1d(angle_rad)
    pose = np.tile(np.eye(4), (len(angle), 1, 1))
    pose[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * AXES[axis]).as_matrix()
    pose[:, 2, 3] = height_m
    return pose
