"""Thinning of dense clouds to one point a voxel."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.registration.voxel_hash import AXIS_BITS, voxel_keys


def downsample(points: FloatArray, voxel_m: float) -> FloatArray:
    """Return the mean (k, d) of the points (n, d), d = 2 or 3, in every voxel of a grid, ordered by voxel.

    Raises `InputError` for a voxel that is not positive or so small that the cloud spans more than two million.
    """
    if not voxel_m > 0:
        raise InputError("downsampling", f"a voxel of {voxel_m} m", "give a positive size")
    if len(points) == 0:
        return np.zeros_like(points, dtype=np.float64)
    if float(np.ptp(points, axis=0).max()) / voxel_m >= 2**AXIS_BITS - 1:
        raise InputError("downsampling", f"voxels of {voxel_m} m in so wide a cloud", "take larger voxels")
    keys = voxel_keys(points, np.floor(points.min(axis=0) / voxel_m) * voxel_m, voxel_m)
    _, member, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return np.column_stack([np.bincount(member, points[:, a]) / counts for a in range(points.shape[1])])
