"""The map that particle-filter SLAM draws: evidence of every cell, and squared distances to the obstacles near it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.localization.cell_counts import free_before, refresh_free_before
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.mapping.raycast import FRACTION_BITS, NEVER_SEEN, fixed_point, plan_walk

UNITS_A_STEP = 1024
"""Whole units of a miss's log-odds: sums are exact."""
FAR = 255
"""Squared distance in cells, where no obstacle is within reach."""

Int32Array = npt.NDArray[np.int32]


@dataclass(slots=True, kw_only=True, eq=False)
class SlamMap:
    """A map that grows scan by scan: the one mutable record here, for a copy a scan would cost more than the filter.

    `evidence` (R, C) in units of a miss / 1024, `near` (R, C) squared distance in cells to the nearest obstacle,
    `stamps` (R, C) the marks of the scan that last touched a cell.
    """

    geometry: GridGeometry
    evidence: Int32Array
    near: ByteArray
    stamps: ByteArray
    mark: int
    reach: int
    steps: IntArray
    """Units of a hit, of a miss, of the clamp, and above which a cell is an obstacle."""
    unit: float
    free_before: Int32Array | None = None
    """Free cells (R, C + 1) of each row to the left of every column, where cells are counted."""

    def occupancy(self) -> OccupancyGrid:
        """Return the map as an occupancy grid."""
        observed = self.evidence != NEVER_SEEN
        log_odds: Float32Array = np.where(observed, self.evidence, 0) * np.float32(self.unit)
        return OccupancyGrid(geometry=self.geometry, log_odds=log_odds, observed=observed)


def empty_map(geometry: GridGeometry, settings: ParticleSlamSettings) -> SlamMap:
    """Return a map in which nothing has been seen."""
    unit = settings.free_log_odds / UNITS_A_STEP
    corner = int(np.ceil(np.sqrt(2) * (settings.window_cells // 2)))
    steps = np.rint([
        settings.free_log_odds * settings.occupied_per_free / unit, UNITS_A_STEP, settings.clamp_log_odds / unit,
        settings.occupied_above / unit,
    ]).astype(np.int64)  # fmt: skip
    return SlamMap(
        geometry=geometry,
        evidence=np.full(geometry.shape, NEVER_SEEN),
        near=np.full(geometry.shape, FAR, dtype=np.uint8),
        stamps=np.zeros(geometry.shape, dtype=np.uint8),
        mark=0,
        reach=min(max(int(np.ceil(3 * settings.sigma_m / settings.resolution_m)), corner), 15),
        steps=steps,
        unit=unit,
        free_before=free_before(np.full(geometry.shape, NEVER_SEEN)) if settings.weighting == "cell_counts" else None,
    )


def draw_scan(slam_map: SlamMap, points: FloatArray, pose: FloatArray, sensor: FloatArray) -> None:
    """Add a scan's returns `points` (n, 2) (base frame), seen from `sensor` (2,), at `pose` (3,), by exact rays.

    A cell changes at most once; a hit wins over misses. Of the beams that end in one cell the first is walked: the
    others cross the same cells but for slivers, and near surfaces are hit five times a cell.
    """
    slam_map.mark = slam_map.mark % 255 + 1
    if slam_map.mark == 1:
        slam_map.stamps[:] = 0
    M = cells_from_base(slam_map.geometry.cells_from_map, pose)
    trace_scan(
        points, M, sensor, slam_map.steps, slam_map.evidence, slam_map.near, slam_map.stamps,
        np.uint8(slam_map.mark), slam_map.reach,
    )  # fmt: skip
    if slam_map.free_before is not None:
        low_row, end_row, low_column, end_column = touched_box(points, sensor, M, *slam_map.geometry.shape)
        refresh_free_before(slam_map.evidence, slam_map.free_before, low_row, end_row, low_column, end_column)


@kernel
def cells_from_base(M, pose):  # type: ignore[no-untyped-def]
    """Return the affine map (3, 3) from the base frame at `pose` (3,) to cells, `M` being that of the map frame."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return M @ np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


@kernel
def touched_box(points, sensor, M, rows, columns):  # type: ignore[no-untyped-def]
    """Return low row, end row, low column, end column of the cells, within the grid, between sensor and returns."""
    low_x = high_x = M[0, 0] * sensor[0] + M[0, 1] * sensor[1] + M[0, 2]
    low_y = high_y = M[1, 0] * sensor[0] + M[1, 1] * sensor[1] + M[1, 2]
    for b in range(len(points)):
        x = M[0, 0] * points[b, 0] + M[0, 1] * points[b, 1] + M[0, 2]
        y = M[1, 0] * points[b, 0] + M[1, 1] * points[b, 1] + M[1, 2]
        low_x, high_x, low_y, high_y = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
    low_row, low_column = min(max(int(np.floor(low_y)), 0), rows), min(max(int(np.floor(low_x)), 0), columns)
    end_row, end_column = min(int(np.floor(high_y)) + 1, rows), min(int(np.floor(high_x)) + 1, columns)
    return low_row, max(end_row, low_row), low_column, max(end_column, low_column)


@kernel
def trace_scan(points, M, sensor, steps, evidence, near, stamps, mark, reach):  # type: ignore[no-untyped-def]
    """Add a scan by rays and bring the squared distances `near` around what changed up to date."""
    changes = np.empty((4096, 2), dtype=np.int64)
    count = add_scan(points, M, sensor, steps, evidence, stamps, mark, changes)
    if count <= len(changes):
        refresh_near(changes[:count], evidence, steps[3], reach, near)
    else:
        for row in range(near.shape[0]):
            for column in range(near.shape[1]):
                near[row, column] = nearest_obstacle(evidence, steps[3], reach, row, column)


@kernel
def change_cell(evidence, at, step, clamp, above):  # type: ignore[no-untyped-def]
    """Add `step` to a cell within the clamp; return 1 where it became an obstacle, -1 where it ceased, else 0."""
    before = evidence[at]
    old = 0 if before == NEVER_SEEN else before
    new = min(max(old + step, -clamp), clamp)
    evidence[at] = new
    return (1 if new > above else 0) - (1 if old > above else 0)


@kernel
def add_scan(points, M, sensor, steps, evidence, stamps, mark, changes):  # type: ignore[no-untyped-def]
    """Add hits, then misses on rays; write cells [row, column] whose class changed to `changes`.

    Returns how many there were, which may be more than `changes` holds.
    """
    rows, columns = evidence.shape
    total, marks = evidence.reshape(rows * columns), stamps.reshape(rows * columns)
    start, end = np.empty(2, dtype=np.int64), np.empty(2, dtype=np.int64)
    count, walked = 0, 0
    rays = np.empty(len(points), dtype=np.int64)
    hit, miss, clamp, above = np.int32(steps[0]), np.int32(steps[1]), np.int32(steps[2]), np.int32(steps[3])
    for b in range(len(points)):
        fixed_point(M, points[b, 0], points[b, 1], end)
        column, row = end[0] >> FRACTION_BITS, end[1] >> FRACTION_BITS
        if 0 <= row < rows and 0 <= column < columns and stamps[row, column] != mark:
            at = row * columns + column
            marks[at] = mark
            rays[walked] = b
            walked += 1
            if change_cell(total, at, hit, clamp, above) != 0:
                if count < len(changes):
                    changes[count, 0], changes[count, 1] = row, column
                count += 1
    fixed_point(M, sensor[0], sensor[1], start)
    for k in range(walked):
        b = rays[k]
        fixed_point(M, points[b, 0], points[b, 1], end)
        low = min(start[0], start[1], end[0], end[1]) >> FRACTION_BITS
        high_column = max(start[0], end[0]) >> FRACTION_BITS
        high_row = max(start[1], end[1]) >> FRACTION_BITS
        if low < 0 or high_column >= columns or high_row >= rows:
            continue  # the grid is made so large that only a pose far astray gets here
        walk = plan_walk(start, end, columns)
        index, lead, last = walk.first, walk.lead, walk.last
        while index != last:
            at = np.uint64(index)  # unsigned, or every access is checked for being negative
            if marks[at] != mark:
                marks[at] = mark
                before = total[at]
                old = np.int32(0) if before == NEVER_SEEN else before
                new = max(old - miss, -clamp)
                total[at] = new
                if old > above and new <= above:
                    if count < len(changes):
                        changes[count, 0], changes[count, 1] = index // columns, index % columns
                    count += 1
            # `next_cell` written out: branches predict well along a ray and cost a tenth less here than selections.
            if lead < 0:
                index += walk.step_column
                lead += walk.height
            elif lead > 0:
                index += walk.step_row
                lead -= walk.width
            else:
                index += walk.step_column + walk.step_row
                lead += walk.height - walk.width
    return count


@kernel
def refresh_near(changes, evidence, above, reach, near):  # type: ignore[no-untyped-def]
    """Bring the squared distances around changed cells up to date: new obstacles are stamped, lost ones recomputed."""
    rows, columns = evidence.shape
    for k in range(len(changes)):
        r, c = changes[k, 0], changes[k, 1]
        gained = evidence[r, c] > above
        for y in range(max(r - reach, 0), min(r + reach + 1, rows)):
            for x in range(max(c - reach, 0), min(c + reach + 1, columns)):
                d = (y - r) ** 2 + (x - c) ** 2
                if d > reach * reach or d > 254:
                    continue
                if gained:
                    near[y, x] = min(near[y, x], np.uint8(d))
                elif near[y, x] == d:
                    near[y, x] = nearest_obstacle(evidence, above, reach, y, x)


@kernel
def nearest_obstacle(evidence, above, reach, row, column):  # type: ignore[no-untyped-def]
    """Squared distance in cells to the nearest obstacle within `reach`, 255 for none."""
    rows, columns = evidence.shape
    best = 255
    for y in range(max(row - reach, 0), min(row + reach + 1, rows)):
        for x in range(max(column - reach, 0), min(column + reach + 1, columns)):
            d = (y - row) ** 2 + (x - column) ** 2
            if d < best and d <= reach * reach and evidence[y, x] > above:
                best = d
    return np.uint8(best)
