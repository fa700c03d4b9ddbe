"""What it costs that colour and depth of a frame were not taken at the same time."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.geometry import SE3, Trajectory

LAG_SHARE = 0.5
"""An alignment lies between what the colours tell and what the depths tell: its deviation is half their difference."""


def lag_motion(trajectory: Trajectory, rows: IntArray, lag_s: FloatArray) -> FloatArray:
    """Tangents (K, 6) by which the camera moved between colour and depth of the frames `rows` (K,).

    `lag_s` (N,) is how much later the depth was taken; the speed is that from the frame before to the one after.
    """
    before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, len(trajectory) - 1)
    elapsed = trajectory.stamps_s[after] - trajectory.stamps_s[before]
    share = np.divide(lag_s[rows], elapsed, out=np.zeros(len(rows)), where=elapsed > 0)
    return np.asarray(SE3.log(SE3.between(trajectory.poses[before], trajectory.poses[after])) * share[:, None])


def loosened(
    information: FloatArray, T_i_j: FloatArray, motion_i: FloatArray, motion_j: FloatArray, depth_m: FloatArray
) -> FloatArray:
    """Return the information (E, 6, 6) of alignments T_i_j (E, 4, 4) with the lag of depth in both frames added.

    `motion_i`, `motion_j` (E, 6) are those of `lag_motion`, of which equal ones cancel: colours tell T_i_j, depths
    exp(-motion_i) T_i_j exp(motion_j). A turn that they differ by shifts what is seen at `depth_m` (E,) as a motion
    across the view would.
    """
    moved = np.any(motion_i != motion_j, axis=1)
    result = information.copy()
    if not moved.any():
        return result
    T = T_i_j[moved]
    apart = SE3.local(T, SE3.exp(-motion_i[moved]) @ T @ SE3.exp(motion_j[moved]))
    turn = np.linalg.norm(apart[:, :3], axis=1)
    shift = np.linalg.norm(apart[:, 3:], axis=1) + turn * depth_m[moved]
    sigma = LAG_SHARE * np.repeat(np.column_stack([turn, shift]), 3, axis=1)
    covariance = np.linalg.inv(information[moved])
    covariance[:, range(6), range(6)] += sigma**2
    inverse = np.linalg.inv(covariance)
    result[moved] = 0.5 * (inverse + inverse.transpose(0, 2, 1))
    return result
