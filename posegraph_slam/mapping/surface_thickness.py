"""How crisp a cloud is: the thickness of its surfaces, and which way they face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only

CELL_M = 0.1
POINTS_MIN = 30
FLAT = 0.2
"""Cells whose second deviation is not several times the first hold no surface but an edge or a blob."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfaceCells:
    """Cells (n,) of a cloud that hold a piece of surface seen in several frames: its deviation, normal and points."""

    thickness_m: FloatArray
    normals: FloatArray
    counts: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "thickness_m", read_only(self.thickness_m))
        object.__setattr__(self, "normals", read_only(self.normals))
        object.__setattr__(self, "counts", read_only(self.counts, np.int64))

    @property
    def median_m(self) -> float:
        """Median thickness, NaN without any cell: the mean plane variance of Razlaw et al. 2015, as a deviation."""
        return float(np.median(self.thickness_m)) if len(self.thickness_m) else float("nan")


def surface_cells(points: FloatArray, frames: IntArray, *, cell_m: float = CELL_M) -> SurfaceCells:
    """Fit a plane in every cell of a grid to the points (n, 3) in it, where two or more of the `frames` (n,) saw it.

    A surface that two frames place differently is thick: drift shows without any truth.
    """
    none = SurfaceCells(thickness_m=np.zeros(0), normals=np.zeros((0, 3)), counts=np.zeros(0, np.int64))
    if len(points) == 0:
        return none
    cells = np.floor((points - points.min(axis=0)) / cell_m).astype(np.int64)
    span = cells.max(axis=0) + 1
    key = (cells[:, 0] * span[1] + cells[:, 1]) * span[2] + cells[:, 2]
    _, member, counts = np.unique(key, return_inverse=True, return_counts=True)
    seen_by = np.unique(np.column_stack([member, frames]), axis=0)
    seers = np.bincount(seen_by[:, 0], minlength=len(counts))
    mean = np.column_stack([np.bincount(member, points[:, a]) / counts for a in range(3)])
    off = points - mean[member]
    covariance = np.empty((len(counts), 3, 3))
    for a in range(3):
        for b in range(a + 1):
            covariance[:, a, b] = covariance[:, b, a] = np.bincount(member, off[:, a] * off[:, b]) / counts
    enough = np.flatnonzero((counts >= POINTS_MIN) & (seers >= 2))
    if len(enough) == 0:
        return none
    values, vectors = np.linalg.eigh(covariance[enough])
    deviation = np.sqrt(np.maximum(values, 0))
    flat = deviation[:, 0] < FLAT * deviation[:, 1] + 1e-9
    return SurfaceCells(thickness_m=deviation[flat, 0], normals=vectors[flat, :, 0], counts=counts[enough][flat])


def upward_direction(cells: SurfaceCells, guess: FloatArray) -> FloatArray:
    """Find the normal (3,) of floors and tables nearest to a guess of up: the mean of normals in a narrowing cone."""
    up = guess / np.linalg.norm(guess)
    for limit_deg in (40.0, 20.0, 10.0, 5.0):
        along = cells.normals @ up
        inside = np.abs(along) > np.cos(np.deg2rad(limit_deg))
        if cells.counts[inside].sum() < 0.02 * max(cells.counts.sum(), 1):
            break
        weights = cells.counts[inside] * np.sign(along[inside])
        total = weights @ cells.normals[inside]
        up = total / np.linalg.norm(total)
    return np.asarray(up)
