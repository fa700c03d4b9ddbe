"""Where the cells of a map lie: the only place where world coordinates and cells are turned into each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError

SMALLEST_CELL_M, LARGEST_CELL_M = 1e-6, 1e6
MAXIMUM_CELLS = 100_000_000
"""Largest grid: at 13 bytes a cell while it is built, 1.3 GB; 500 x 500 m at 0.05 m."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GridGeometry:
    """A grid of square cells: `shape` (rows, columns), rows along +y, columns along +x.

    `origin_m` (2,) is the lower-left corner of cell (0, 0) in the map frame; `yaw_rad` turns the grid about it
    (zero for every map built here, other values come from map files of other programs).
    """

    origin_m: FloatArray
    resolution_m: float
    shape: tuple[int, int]
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        origin = read_only(self.origin_m)
        rows, columns = (int(n) for n in self.shape)
        if origin.shape != (2,) or not np.isfinite(origin).all() or not np.isfinite(self.yaw_rad):
            raise InputError(
                "grid geometry", f"origin {self.origin_m} must be two finite numbers and yaw {self.yaw_rad} finite"
            )
        if not SMALLEST_CELL_M <= self.resolution_m <= LARGEST_CELL_M:
            problem = f"resolution {self.resolution_m} m is not between {SMALLEST_CELL_M:g} and {LARGEST_CELL_M:g} m"
            raise InputError("grid geometry", problem, "it must be positive, in metres a cell")
        if rows < 1 or columns < 1 or rows * columns > MAXIMUM_CELLS:
            size = f"{columns * self.resolution_m:.0f} x {rows * self.resolution_m:.0f} m"
            raise InputError(
                "grid geometry",
                f"{rows} x {columns} cells ({size}) are not between 1 and {MAXIMUM_CELLS} cells",
                "use a coarser resolution or a shorter maximum range, or check the trajectory",
            )
        object.__setattr__(self, "origin_m", origin)
        object.__setattr__(self, "shape", (rows, columns))

    @classmethod
    def around(cls, points_m: FloatArray, *, resolution_m: float, margin_m: float = 0.0) -> GridGeometry:
        """Return the smallest grid that holds `points_m` (n, 2) and `margin_m` on every side.

        The origin is a whole multiple of the resolution, so that maps of one log have their cells in common.
        """
        points = np.asarray(points_m, dtype=np.float64).reshape(-1, 2)
        if len(points) == 0 or not np.isfinite(points).all():
            raise InputError("grid geometry", "the points to hold are none or not finite", "check the trajectory")
        # A millionth of a cell more on every side, so that rounding leaves no point outside; and the cell of a point
        # on a line is the one above it: floor + 1, not ceil.
        low = np.floor((points.min(axis=0) - margin_m) / resolution_m - 1e-6)
        high = np.floor((points.max(axis=0) + margin_m) / resolution_m + 1e-6) + 1
        columns, rows = (high - low).tolist()
        return cls(origin_m=low * resolution_m, resolution_m=resolution_m, shape=(int(rows), int(columns)))

    @classmethod
    def square(cls, size_m: float, *, resolution_m: float) -> GridGeometry:
        """Return a square grid of side `size_m` centred at the origin of the map frame."""
        cells = int(np.ceil(size_m / resolution_m - 1e-9))
        return cls(origin_m=np.full(2, -size_m / 2), resolution_m=resolution_m, shape=(cells, cells))

    @property
    def cells_from_map(self) -> FloatArray:
        """Affine map (3, 3) from (x, y, 1) in the map frame to (column, row, 1), measured in cells from the corner."""
        c, s = np.cos(self.yaw_rad) / self.resolution_m, np.sin(self.yaw_rad) / self.resolution_m
        x, y = self.origin_m
        return np.array([[c, s, -(c * x + s * y)], [-s, c, s * x - c * y], [0.0, 0.0, 1.0]])

    def world_to_cell(self, points_m: FloatArray) -> IntArray:
        """Return the cell (..., 2) [row, column] of each point (..., 2); cells may lie outside the grid."""
        M = self.cells_from_map
        offset = np.asarray(points_m, dtype=np.float64) - self.origin_m
        return np.floor(offset @ M[:2, :2].T).astype(np.int64)[..., ::-1]

    def cell_to_world(self, cells: IntArray) -> FloatArray:
        """Return the centre (..., 2) [x, y] of each cell (..., 2) [row, column]."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        offset = (np.asarray(cells)[..., ::-1] + 0.5) * self.resolution_m
        return np.asarray(offset @ np.array([[c, s], [-s, c]]) + self.origin_m)

    def contains(self, cells: IntArray) -> BoolArray:
        """Return which cells (..., 2) [row, column] belong to the grid."""
        return np.asarray(((cells >= 0) & (cells < np.array(self.shape))).all(axis=-1))

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top edge in the map frame of a grid without yaw, as image plots want it."""
        x, y = (float(v) for v in self.origin_m)
        return x, x + self.shape[1] * self.resolution_m, y, y + self.shape[0] * self.resolution_m
