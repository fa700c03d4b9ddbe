"""What a trajectory says of itself: its length, and how far apart it starts and ends."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.association import rotation_angle_deg
from posegraph_slam.geometry import Trajectory, inverse_pose


@dataclass(frozen=True, slots=True, kw_only=True)
class PathSummary:
    """Poses, duration, length, and the gap between the first and the last pose (m, and degrees of rotation)."""

    poses: int
    duration_s: float
    length_m: float
    start_end_gap_m: float
    start_end_gap_deg: float

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return asdict(self)


def summarise_path(trajectory: Trajectory) -> PathSummary:
    """Measure a trajectory in recorded order; raises InputError when it has no pose or one that is not finite.

    Robots seldom end exactly where they started: the gap is a value to compare between trajectories, not an error.
    """
    if len(trajectory) == 0:
        raise InputError("evaluation", "the trajectory is empty")
    bad = np.flatnonzero(~np.isfinite(trajectory.poses).all(axis=(1, 2)))
    if len(bad):
        raise InputError("evaluation", f"pose {bad[0]} of the trajectory is not finite ({len(bad)} in all)")
    across = inverse_pose(trajectory.poses[:1]) @ trajectory.poses[-1:]
    return PathSummary(
        poses=len(trajectory),
        duration_s=float(np.ptp(trajectory.stamps_s)),
        length_m=trajectory.path_length_m,
        start_end_gap_m=float(np.linalg.norm(across[0, :-1, -1])),
        start_end_gap_deg=float(rotation_angle_deg(across)[0]),
    )
