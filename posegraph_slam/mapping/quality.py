"""How good a map looks by itself, without truth: sharp, thin and single walls."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.mapping.crispness import crispness, entropy_bits, wall_area_m2
from posegraph_slam.mapping.occupancy import OccupancyGrid

LONGEST_WALL_M = 1.0
"""A run of occupied cells is followed so far to either side: what is thicker is no wall of a laser map."""
GHOST_GAP_M = 0.5
"""A wall this near to another, seen free in between, is taken for the same wall drawn twice."""
DIRECTIONS = np.array([[0, 1], [1, 0], [1, 1], [1, -1]], dtype=np.int64)
"""Row and column steps across a wall."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapQuality:
    """Figures of one map; compare maps of one log with one set of map settings only.

    `crispness`: 1 minus the mean entropy at the walls (higher is better). `entropy_bits`: mean entropy of all observed
    cells. `wall_thickness_m`: mean shortest run of occupied cells through an occupied cell. `double_walls`: share of
    wall cells that have a parallel wall within 0.5 m across cells that were seen free. `wall_area_m2`: area of the
    occupied cells. Of all but the first, lower is better.
    """

    crispness: float
    entropy_bits: float
    wall_thickness_m: float
    double_walls: float
    wall_area_m2: float

    def as_dict(self) -> dict[str, float]:
        """Return the fields for JSON."""
        return asdict(self)


def map_quality(grid: OccupancyGrid) -> MapQuality:
    """Measure a map; thickness and double walls are zero without occupied cells."""
    thickness, doubled = walls(grid.occupied, grid.observed & ~grid.occupied, grid.geometry.resolution_m)
    return MapQuality(
        crispness=crispness(grid),
        entropy_bits=float(entropy_bits(grid.log_odds)[grid.observed].mean()) if grid.observed.any() else 1.0,
        wall_thickness_m=float(thickness.mean()) if len(thickness) else 0.0,
        double_walls=float(doubled.mean()) if len(doubled) else 0.0,
        wall_area_m2=wall_area_m2(grid),
    )


def walls(occupied: BoolArray, free: BoolArray, resolution_m: float) -> tuple[FloatArray, BoolArray]:
    """Return for every occupied cell (n,) the thickness of its wall in m and whether the wall is drawn twice.

    The wall's normal is the one of four directions in which the run of occupied cells is shortest. It is drawn twice
    where along that normal, after free cells alone for at most 0.5 m, a wall with the same normal follows.
    """
    cells = np.argwhere(occupied)
    limit, gap = int(np.ceil(LONGEST_WALL_M / resolution_m)), int(np.floor(GHOST_GAP_M / resolution_m + 1e-9))
    normal = np.full(occupied.shape, -1, dtype=np.int64)
    thickness = _shortest_runs(occupied, cells, DIRECTIONS, limit, normal)
    doubled = _have_partner(occupied, free, cells, DIRECTIONS, gap, normal)
    return np.asarray(thickness * resolution_m), doubled


@kernel
def _shortest_runs(
    occupied: BoolArray, cells: IntArray, directions: IntArray, limit: int, normal: IntArray
) -> FloatArray:
    """Length (n,) in cells of the shortest run through each cell; its direction goes into `normal` (R, C)."""
    rows, columns = occupied.shape
    best = np.full(len(cells), np.inf)
    for n in range(len(cells)):
        for k in range(len(directions)):
            dr, dc = directions[k, 0], directions[k, 1]
            step = np.sqrt(float(dr * dr + dc * dc))
            count = 1
            for side in (-1, 1):
                for distance in range(1, limit + 1):
                    r, c = cells[n, 0] + side * distance * dr, cells[n, 1] + side * distance * dc
                    if not (0 <= r < rows and 0 <= c < columns) or not occupied[r, c]:
                        break
                    count += 1
            if count * step < best[n]:
                best[n] = count * step
                normal[cells[n, 0], cells[n, 1]] = k
    return best


@kernel
def _have_partner(
    occupied: BoolArray, free: BoolArray, cells: IntArray, directions: IntArray, gap: int, normal: IntArray
) -> BoolArray:
    """Whether each cell's wall (n,) is followed by a parallel one across free cells alone, at most `gap` steps away."""
    rows, columns = occupied.shape
    found = np.zeros(len(cells), dtype=np.bool_)
    for n in range(len(cells)):
        k = normal[cells[n, 0], cells[n, 1]]
        dr, dc = directions[k, 0], directions[k, 1]
        reach = int(gap / np.sqrt(float(dr * dr + dc * dc)))
        for side in (-1, 1):
            r, c = cells[n, 0], cells[n, 1]
            while 0 <= r < rows and 0 <= c < columns and occupied[r, c]:
                r, c = r + side * dr, c + side * dc
            crossed = 0
            while 0 <= r < rows and 0 <= c < columns and free[r, c] and crossed < reach:
                crossed += 1
                r, c = r + side * dr, c + side * dc
            inside = 0 <= r < rows and 0 <= c < columns
            if crossed > 0 and inside and occupied[r, c] and normal[r, c] == k:
                found[n] = True
    return found
