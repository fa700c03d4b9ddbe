"""Carrying the correction of some poses of a trajectory over to all of them."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry.trajectory import Trajectory


def deform(trajectory: Trajectory, anchors: IntArray, poses: FloatArray) -> Trajectory:
    """Return the trajectory with the poses at rows `anchors` (K,) replaced by `poses` (K, d+1, d+1).

    A pose between two anchors is reached from either by the trajectory's own motion; the two results are blended
    along the geodesic, by the share of the path (and, standing still, of the rows) that lies behind. Before the
    first and after the last anchor the motion is appended. `anchors` must rise; raises InputError otherwise.
    """
    if len(anchors) == 0 or np.any(np.diff(anchors) <= 0) or len(anchors) != len(poses):
        raise InputError("trajectory", f"{len(anchors)} anchors in rising order need as many poses, not {len(poses)}")
    group, old = trajectory.group, trajectory.poses
    rows = np.arange(len(trajectory))
    before = np.clip(np.searchsorted(anchors, rows, side="right") - 1, 0, len(anchors) - 1)
    after = np.minimum(before + 1, len(anchors) - 1)
    after = np.where(rows < anchors[0], before, after)
    from_before = poses[before] @ group.between(old[anchors[before]], old)
    from_after = poses[after] @ group.between(old[anchors[after]], old)
    steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1) + 1e-6
    path = np.concatenate([[0.0], np.cumsum(steps)])
    length = np.maximum(path[anchors[after]] - path[anchors[before]], 1e-12)
    share = np.clip((path - path[anchors[before]]) / length, 0.0, 1.0)
    blended = group.retract(from_before, share[:, None] * group.local(from_before, from_after))
    blended[anchors] = poses
    return trajectory.with_poses(blended)
