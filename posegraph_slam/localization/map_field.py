"""A known map prepared for localisation: likelihoods, nearest obstacles and the lines they form.

Everything here is in the grid frame: metres from the corner of cell (0, 0), x along columns. A map whose origin is
turned costs nothing more; poses are turned once, at the border.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, pose_from_xyt, xyt_from_pose
from posegraph_slam.jit import kernel
from posegraph_slam.localization.settings import BeamModelSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid

UNKNOWN, FREE, OCCUPIED = 0, 1, 2

Int32Array = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapField:
    """Per cell (R, C): its class, distance to the nearest obstacle in metres, that obstacle, and log-likelihood.

    `nearest` is the index of the nearest obstacle's line in `lines` (K, 4): unit normal, offset (normal . x = offset),
    and 1 where the cells around it form a line.
    """

    geometry: GridGeometry
    kind: ByteArray
    distance_m: Float32Array
    nearest: Int32Array
    lines: FloatArray
    log_likelihood: Float32Array
    outside: float
    """Log-likelihood of returns outside the map."""

    def to_grid(self, poses: FloatArray) -> FloatArray:
        """Return map poses (..., 3) [x, y, theta] in the grid frame."""
        return xyt_from_pose(SE2.inverse(self._corner) @ pose_from_xyt(np.asarray(poses, dtype=np.float64)))

    def from_grid(self, poses: FloatArray) -> FloatArray:
        """Return grid poses (..., 3) in the map frame."""
        return xyt_from_pose(self._corner @ pose_from_xyt(np.asarray(poses, dtype=np.float64)))

    @property
    def _corner(self) -> FloatArray:
        return pose_from_xyt(np.array([*self.geometry.origin_m, self.geometry.yaw_rad]))


def build_map_field(grid: OccupancyGrid, settings: BeamModelSettings, *, line_radius_m: float = 0.2) -> MapField:
    """Prepare a map. Raises InputError for one without obstacles."""
    occupied = grid.occupied
    if not occupied.any():
        raise InputError("map", "no cell is occupied", "check occupied_thresh and negate of the map")
    resolution = grid.geometry.resolution_m
    distance, (row, column) = distance_transform_edt(~occupied, return_indices=True)
    kind = np.where(occupied, OCCUPIED, np.where(grid.free, FREE, UNKNOWN)).astype(np.uint8)
    obstacles = np.argwhere(occupied)
    number = np.zeros(occupied.shape, dtype=np.int32)
    number[occupied] = np.arange(len(obstacles))
    distance_m = (distance * resolution).astype(np.float32)
    hit = np.exp(-0.5 * (distance_m / settings.sigma_m) ** 2)
    hit = np.where(kind == UNKNOWN, np.maximum(hit, settings.unknown_likelihood), hit)
    share = settings.random_share
    lines = fit_lines(grid.probability, occupied, obstacles, resolution, int(np.ceil(line_radius_m / resolution)))
    return MapField(
        geometry=grid.geometry,
        kind=read_only(kind, np.uint8),
        distance_m=read_only(distance_m, np.float32),
        nearest=read_only(number[row, column], np.int32),
        lines=read_only(lines),
        log_likelihood=read_only(np.log((1 - share) * hit + share), np.float32),
        outside=float(np.log((1 - share) * settings.unknown_likelihood + share)),
    )


@kernel
def fit_lines(probability, occupied, obstacles, resolution, reach):  # type: ignore[no-untyped-def]
    """Lines (K, 4) through the obstacle cells within `reach` cells of each, weighted by their probability.

    The average over many cells is what makes a match finer than the cells. No line where the cells deviate from it by
    more than 0.7 cell or are fewer than three; the offset is then that of the cell itself.
    """
    rows, columns = occupied.shape
    lines = np.zeros((len(obstacles), 4))
    for k in range(len(obstacles)):
        r, c = obstacles[k, 0], obstacles[k, 1]
        n, sx, sy, sxx, sxy, syy, cells = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
        for y in range(max(r - reach, 0), min(r + reach + 1, rows)):
            for x in range(max(c - reach, 0), min(c + reach + 1, columns)):
                if not occupied[y, x] or (x - c) ** 2 + (y - r) ** 2 > reach * reach:
                    continue
                w = probability[y, x]
                n += w
                sx += w * (x - c)
                sy += w * (y - r)
                sxx += w * (x - c) ** 2
                sxy += w * (x - c) * (y - r)
                syy += w * (y - r) ** 2
                cells += 1
        mx, my = sx / n, sy / n
        cxx, cxy, cyy = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
        half, diff = 0.5 * (cxx + cyy), 0.5 * (cxx - cyy)
        root = np.sqrt(diff * diff + cxy * cxy)
        angle = 0.5 * np.arctan2(2 * cxy, cxx - cyy)
        nx, ny = -np.sin(angle), np.cos(angle)
        lines[k, 0], lines[k, 1] = nx, ny
        lines[k, 2] = (nx * (c + 0.5 + mx) + ny * (r + 0.5 + my)) * resolution
        if cells >= 3 and half - root < 0.5 and half - root < 0.3 * (half + root):
            lines[k, 3] = 1.0
    return lines
