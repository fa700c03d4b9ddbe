"""Thinning of dense clouds to one point a voxel, and of scan lines until they are no denser than they are apart."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import inverse_pose, transform_points
from posegraph_slam.registration.cloud import Cloud, prepare_cloud
from posegraph_slam.registration.principal_axes import axes_of_all
from posegraph_slam.registration.rotation_grid import principal_frame
from posegraph_slam.registration.scan_lines import LONGEST_SHARE
from posegraph_slam.registration.small_matrices import TINY
from posegraph_slam.registration.voxel_hash import AXIS_BITS, voxel_keys

EVEN_SHARE = 1.6
"""Median length of neighbourhoods over their width up to which points count as spread evenly, for which it is 1.5."""

FEWEST = 1000
"""Points that are left at least."""


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


def thin_scan_lines(cloud: Cloud) -> Cloud:
    """Thin a cloud in space whose points lie on few dense lines until they are spread evenly; others are left alone.

    Of a scan of 64 lines most points lie on the few lines near the scanner: they would outvote all walls, and
    neighbours on one line hold no plane. The voxel grows by the root of two from half the neighbours' reach, in a grid
    that turns with the cloud.
    """
    if cloud.dimension != 3 or len(cloud) <= FEWEST:
        return cloud
    shape, reach = shape_of_neighbourhoods(cloud)
    if shape <= LONGEST_SHARE:
        return cloud
    thinned, frame = cloud, principal_frame(cloud.points)
    framed = transform_points(inverse_pose(frame), cloud.points)
    voxel_m = max(reach / 2, float(np.ptp(framed, axis=0).max()) / 2 ** (AXIS_BITS - 1))
    while shape > EVEN_SHARE:
        coarser = transform_points(frame, downsample(framed, voxel_m))
        if len(coarser) < FEWEST:
            break
        thinned = prepare_cloud(coarser, neighbours=cloud.neighbours)
        shape, _ = shape_of_neighbourhoods(thinned)
        voxel_m *= np.sqrt(2.0)
    return thinned


def shape_of_neighbourhoods(cloud: Cloud) -> tuple[float, float]:
    """Median length over width of the neighbourhoods of all points (n, 3), and the median of their reach."""
    index = cloud.tree.neighbours_of_all(cloud.neighbours)
    _, _, variances = axes_of_all(cloud.points, index)
    reach = np.linalg.norm(cloud.points[index[:, -1]] - cloud.points, axis=1)
    return float(np.sqrt(np.median(variances[:, 2] / np.maximum(variances[:, 1], TINY)))), float(np.median(reach))
