"""A voxel table that tells the nearest model point for a place at the cost of one look-up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from posegraph_slam.arrays import FloatArray
from posegraph_slam.registration.cloud import prepare_cloud

MARGIN_SHARE = 0.25
"""Rim about the model, in its longest side; places beyond are looked up where they meet the rim."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NearestField:
    """`row` (x, y, z) names for every voxel the occupied voxel nearest to it: its mean point and normal (k, 3).

    Voxel (0, 0, 0) has its lower corner at `origin` (3,).
    """

    row: npt.NDArray[np.int32]
    points: FloatArray
    normals: FloatArray
    origin: FloatArray
    voxel_m: float


def build_nearest_field(points: FloatArray, voxels_along: int) -> NearestField:
    """Tabulate the nearest of points (m, 3) in space; `voxels_along` their longest side gives the size of a voxel.

    Uses the exact Euclidean distance transform, which also tells the nearest feature of every voxel.
    """
    low, side = points.min(axis=0), float(np.ptp(points, axis=0).max())
    voxel = max(side / voxels_along, 1e-9)
    rim = int(np.ceil(MARGIN_SHARE * voxels_along))
    origin = low - rim * voxel
    cells = np.floor((points - origin) / voxel).astype(np.int64)
    shape = tuple(cells.max(axis=0) + rim + 1)
    flat = np.ravel_multi_index((cells[:, 0], cells[:, 1], cells[:, 2]), shape)
    occupied, member = np.unique(flat, return_inverse=True)
    counts = np.bincount(member).astype(np.float64)
    means = np.column_stack([np.bincount(member, points[:, a]) / counts for a in range(3)])
    empty = np.ones(shape, dtype=np.bool_)
    empty.ravel()[occupied] = False
    surface = prepare_cloud(means).surface
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    number = np.zeros(empty.size, dtype=np.int32)
    number[occupied] = np.arange(len(occupied), dtype=np.int32)
    row = number[np.ravel_multi_index((nearest[0], nearest[1], nearest[2]), shape)]
    return NearestField(
        row=np.ascontiguousarray(row), points=means, normals=surface.normals, origin=origin, voxel_m=voxel
    )
