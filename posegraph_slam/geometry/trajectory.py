"""A stamped sequence of poses of one frame in another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.geometry.groups import SE2, SE3, Group
from posegraph_slam.geometry.spatial import spatial_from_planar


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Poses T_parent_child (N, d+1, d+1) at `stamps_s` (N,), in the order in which they were recorded.

    Stamps are not required to rise: some loggers write scans out of order, and their file order is the physical one.
    """

    stamps_s: FloatArray
    poses: FloatArray
    parent: str
    child: str

    def __post_init__(self) -> None:
        stamps, poses = read_only(self.stamps_s), read_only(self.poses)
        if (
            stamps.ndim != 1
            or poses.ndim != 3
            or poses.shape[0] != stamps.shape[0]
            or poses.shape[1:]
            not in (
                (3, 3),
                (4, 4),
            )
        ):
            raise InputError("trajectory", f"stamps {stamps.shape} and poses {poses.shape} do not fit together")
        object.__setattr__(self, "stamps_s", stamps)
        object.__setattr__(self, "poses", poses)

    def __len__(self) -> int:
        return int(self.stamps_s.shape[0])

    @property
    def group(self) -> Group:
        """SE2 for (N, 3, 3) poses, SE3 for (N, 4, 4)."""
        return SE2 if self.poses.shape[1] == 3 else SE3

    @property
    def positions(self) -> FloatArray:
        """Translations (N, d)."""
        return self.poses[:, :-1, -1]

    @property
    def path_length_m(self) -> float:
        """Sum of the distances between consecutive positions, in recorded order."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def select(self, index: IntArray) -> Trajectory:
        """Return the poses at `index`, in that order."""
        return Trajectory(stamps_s=self.stamps_s[index], poses=self.poses[index], parent=self.parent, child=self.child)

    def in_stamp_order(self) -> Trajectory:
        """Return the poses ordered by stamp (stable), each stamp keeping its own pose."""
        return self.select(np.argsort(self.stamps_s, kind="stable"))

    def spatial(self) -> Trajectory:
        """Return the trajectory with (N, 4, 4) poses; planar ones get z, roll and pitch zero."""
        poses = self.poses if self.poses.shape[1] == 4 else spatial_from_planar(self.poses)
        return Trajectory(stamps_s=self.stamps_s, poses=poses, parent=self.parent, child=self.child)

    def with_poses(self, poses: FloatArray, *, parent: str | None = None) -> Trajectory:
        """Return the same stamps with other poses."""
        return Trajectory(stamps_s=self.stamps_s, poses=poses, parent=parent or self.parent, child=self.child)

    def restamped(self, stamps_s: FloatArray) -> Trajectory:
        """Return the same poses with other stamps."""
        return Trajectory(stamps_s=stamps_s, poses=self.poses, parent=self.parent, child=self.child)
