"""Interpolation of poses between stamps along the group's geodesic."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry.trajectory import Trajectory


def interpolate(trajectory: Trajectory, stamps_s: FloatArray) -> Trajectory:
    """Return the poses at `stamps_s` (M,), geodesic between the bracketing poses, held constant outside.

    The trajectory is taken in stamp order; of poses with equal stamps the last one counts.
    """
    if len(trajectory) == 0:
        raise InputError("trajectory", "has no poses to interpolate between")
    ordered = trajectory.in_stamp_order()
    last_of_equal = np.r_[np.diff(ordered.stamps_s) > 0, True]
    known = ordered.select(np.flatnonzero(last_of_equal))
    stamps = np.asarray(stamps_s, dtype=np.float64)
    if len(known) == 1:
        return known.select(np.zeros(len(stamps), dtype=np.int64)).restamped(stamps)
    after = np.clip(np.searchsorted(known.stamps_s, stamps, side="right"), 1, len(known) - 1)
    t0, t1 = known.stamps_s[after - 1], known.stamps_s[after]
    weight = np.clip((stamps - t0) / (t1 - t0), 0.0, 1.0)
    group = trajectory.group
    start = known.poses[after - 1]
    step = group.local(start, known.poses[after])
    poses = group.retract(start, weight[:, None] * step)
    return Trajectory(stamps_s=stamps, poses=poses, parent=trajectory.parent, child=trajectory.child)
