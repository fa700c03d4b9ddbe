"""Exact ray traversal of a grid, and the evidence that scans leave on it.

Positions here are [column, row] in cells from the corner of cell (0, 0), in fixed point: whole multiples of 1 / CELL
cells, always odd ones, so that no position lies on a line of the grid and every comparison is exact. The caller folds
origin, resolution and poses into one affine map for each scan.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray, IntArray
from posegraph_slam.errors import InputError
from posegraph_slam.jit import kernel
from posegraph_slam.mapping.grid import GridGeometry

FRACTION_BITS = 20
CELL = 1 << FRACTION_BITS
"""Positions are rounded to a millionth of a cell: 50 nm at 0.05 m, far below any sensor's noise."""

LONGEST_RAY_CELLS = 1 << 20
"""Products of two lengths in fixed point then stay below 2^61."""

PACKED = 1 << 32
"""Pitch of indices for rays that leave the grid: rows and columns, negative ones too, can be told apart again."""

NEVER_SEEN = np.int32(-(2**31))
"""Evidence of cells that no scan has touched."""

Int32Array = npt.NDArray[np.int32]


class BeamLimits(NamedTuple):
    """What a range means, in metres: returns lie in [shortest, longest), those below `trusted` mark their cell.

    Returns free the cells before them up to `free`; beams without return, at or beyond `longest`, up to `no_return`.
    """

    shortest: float
    trusted: float
    longest: float
    free: float
    no_return: float


class Walk(NamedTuple):
    """A ray's way through the grid: indices (row * pitch + column) of its ends, the steps, and which comes next."""

    first: int
    last: int
    step_column: int
    step_row: int
    width: int
    height: int
    lead: int


@kernel
def reach(range_m: float, limits: BeamLimits) -> tuple[bool, float]:
    """Return whether a beam marks the cell at its range, and how far it frees the cells on its way."""
    if range_m >= limits.longest:
        return False, limits.no_return
    if not range_m >= limits.shortest:  # too short or NaN: the beam says nothing
        return False, 0.0
    return range_m < limits.trusted, min(range_m, limits.free)


@kernel
def fixed_point(M: FloatArray, x: float, y: float, out: IntArray) -> None:
    """Write the position [column, row] of (x, y) under the affine map `M` (cells) in fixed point."""
    out[0] = int(np.floor((M[0, 0] * x + M[0, 1] * y + M[0, 2]) * CELL)) | 1
    out[1] = int(np.floor((M[1, 0] * x + M[1, 1] * y + M[1, 2]) * CELL)) | 1


@kernel
def beam_end(length: float, direction: FloatArray, part: float, motion: FloatArray) -> tuple[float, float]:
    """Return where a beam ends, in the lidar frame amid its sweep, during which the lidar moves by `motion` (3,).

    The beam is measured when `part` of the sweep, from -1/2 to 1/2, has passed since its middle.
    """
    x, y = length * direction[0], length * direction[1]
    return x + part * (motion[0] - motion[2] * y), y + part * (motion[1] + motion[2] * x)


@kernel
def plan_walk(start: IntArray, end: IntArray, pitch: int) -> Walk:
    """Prepare the walk over every cell whose interior the segment from `start` to `end` crosses, both ends included.

    After Amanatides and Woo (1987), with the next crossing found by comparing products of whole numbers instead of
    quotients: exact, so that the walk ends in the last cell without counting, and without a division.
    """
    column, row = start[0] >> FRACTION_BITS, start[1] >> FRACTION_BITS
    width, height = abs(end[0] - start[0]), abs(end[1] - start[1])
    right, up = end[0] > start[0], end[1] > start[1]
    to_column = (column + 1) * CELL - start[0] if right else start[0] - column * CELL
    to_row = (row + 1) * CELL - start[1] if up else start[1] - row * CELL
    return Walk(
        row * pitch + column,
        (end[1] >> FRACTION_BITS) * pitch + (end[0] >> FRACTION_BITS),
        1 if right else -1,
        pitch if up else -pitch,
        width * CELL,
        height * CELL,
        to_column * height - to_row * width,
    )


@kernel
def next_cell(walk: Walk, index: int, lead: int) -> tuple[int, int]:
    """Return index and lead of the next cell: across while `lead` < 0, along the column while > 0, diagonal at 0."""
    across, along = lead <= 0, lead >= 0
    index += (walk.step_column if across else 0) + (walk.step_row if along else 0)
    lead += (walk.height if across else 0) - (walk.width if along else 0)
    return index, lead


@kernel
def index_in_grid(packed: int, rows: int, columns: int) -> int:
    """Turn an index of pitch PACKED into one of pitch `columns`; -1 outside the grid."""
    row = (packed + PACKED // 2) >> 32  # half a pitch keeps negative columns in their own row
    column = packed - row * PACKED
    return row * columns + column if 0 <= row < rows and 0 <= column < columns else -1


@kernel
def beam_bounds(
    ranges_m: Float32Array, T_map_lidar: FloatArray, motion: FloatArray, directions: FloatArray, limits: BeamLimits
) -> FloatArray:
    """Return the bounding box (2, 2) [low, high] of what the beams mark and free, sensor positions included.

    `ranges_m` (N, B), planar sensor poses (N, 3, 3), `motion` (N, 3) of the lidar during a sweep, unit directions
    (B, 2) in the lidar frame. Infinite without any.
    """
    beams = ranges_m.shape[1]
    box = np.empty((2, 2))
    box[0], box[1] = np.inf, -np.inf
    for scan in range(ranges_m.shape[0]):
        M = T_map_lidar[scan]
        for beam in range(beams):
            hit, free = reach(ranges_m[scan, beam], limits)
            length = ranges_m[scan, beam] if hit else free
            if length <= 0.0:
                continue
            x, y = beam_end(length, directions[beam], (beam + 0.5) / beams - 0.5, motion[scan])
            for axis in range(2):
                here = M[axis, 2]
                end = here + M[axis, 0] * x + M[axis, 1] * y
                box[0, axis] = min(box[0, axis], here, end)
                box[1, axis] = max(box[1, axis], here, end)
    return box


@kernel
def changed(evidence: int, step: int, clamp: int) -> int:
    """Return the evidence of a cell after one more observation."""
    before = 0 if evidence == NEVER_SEEN else evidence
    return min(max(before + step, -clamp), clamp)


@kernel
def add_scans(
    ranges_m: Float32Array,
    T_cells_lidar: FloatArray,
    motion: FloatArray,
    directions: FloatArray,
    limits: BeamLimits,
    steps: IntArray,
    clamp: int,
    evidence: Int32Array,
    stamps: ByteArray,
) -> None:
    """Add the evidence of scans (N, B), in order, to `evidence` (R, C), which stays within [-clamp, clamp].

    `T_cells_lidar` (N, 3, 3) maps the lidar frame to cells; `motion` (N, 3) as in `beam_end`; `steps` (N, 2) is what a
    hit adds and a miss takes away.
    A cell changes at most once a scan, and a hit wins: the hits of a scan are written first and leave its mark in
    `stamps` (R, C), which is scratch. One byte a cell keeps the marks of a scan in the processor's nearest cache.
    """
    rows, columns = evidence.shape
    beams = ranges_m.shape[1]
    total, marks = evidence.reshape(rows * columns), stamps.reshape(rows * columns)
    start, end = np.empty(2, dtype=np.int64), np.empty(2, dtype=np.int64)
    mark = 255
    for scan in range(ranges_m.shape[0]):
        mark += 1
        if mark > 255:
            marks[:] = 0
            mark = 1
        M, hit_step, miss_step = T_cells_lidar[scan], steps[scan, 0], steps[scan, 1]
        if hit_step == 0 and miss_step == 0:
            continue
        for beam in range(beams):
            hit, _ = reach(ranges_m[scan, beam], limits)
            if hit:
                x, y = beam_end(ranges_m[scan, beam], directions[beam], (beam + 0.5) / beams - 0.5, motion[scan])
                fixed_point(M, x, y, end)
                column, row = end[0] >> FRACTION_BITS, end[1] >> FRACTION_BITS
                if 0 <= row < rows and 0 <= column < columns and stamps[row, column] != mark:
                    stamps[row, column] = mark
                    evidence[row, column] = changed(evidence[row, column], hit_step, clamp)
        fixed_point(M, 0.0, 0.0, start)
        for beam in range(beams):
            _, length = reach(ranges_m[scan, beam], limits)
            if length <= 0.0:
                continue
            x, y = beam_end(length, directions[beam], (beam + 0.5) / beams - 0.5, motion[scan])
            fixed_point(M, x, y, end)
            low, high_column, high_row = min(start.min(), end.min()), max(start[0], end[0]), max(start[1], end[1])
            within = low >= 0 and high_column < columns * CELL and high_row < rows * CELL
            walk = plan_walk(start, end, columns if within else PACKED)
            index, lead = walk.first, walk.lead
            # The last cell is where the beam ends: the obstacle itself, or a cell crossed in part.
            while index != walk.last:
                cell = index if within else index_in_grid(index, rows, columns)
                # Unsigned, or numba checks the index for being negative; arrays passed to a function would be counted
                # at every call, which makes the whole map eight times slower.
                at = np.uint64(cell)
                if cell >= 0 and marks[at] != mark:
                    marks[at] = mark
                    total[at] = changed(total[at], -miss_step, clamp)
                index, lead = next_cell(walk, index, lead)


@kernel
def list_cells(start: IntArray, end: IntArray, cells: IntArray) -> int:
    """Write the cells (n, 2) [row, column] of the walk from `start` to `end`; return how many."""
    walk = plan_walk(start, end, PACKED)
    index, lead, count = walk.first, walk.lead, 0
    while True:
        cells[count, 0] = (index + PACKED // 2) >> 32
        cells[count, 1] = index - cells[count, 0] * PACKED
        count += 1
        if index == walk.last:
            return count
        index, lead = next_cell(walk, index, lead)


def ray_cells(geometry: GridGeometry, start_m: FloatArray, end_m: FloatArray) -> IntArray:
    """Return the cells (n, 2) [row, column] whose interior the segment between two points (2,) of the map crosses.

    In order from start to end, both cells included; cells outside the grid are included too.
    """
    M = geometry.cells_from_map
    start, end = np.empty(2, dtype=np.int64), np.empty(2, dtype=np.int64)
    fixed_point(M, start_m[0], start_m[1], start)
    fixed_point(M, end_m[0], end_m[1], end)
    length = int(np.abs((end >> FRACTION_BITS) - (start >> FRACTION_BITS)).sum())
    check_ray_length(length)
    cells = np.empty((length + 1, 2), dtype=np.int64)
    return cells[: list_cells(start, end, cells)]


def check_ray_length(cells: float) -> None:
    """Raise InputError for rays so long that whole numbers of 64 bits do not hold the products of a walk."""
    if cells > LONGEST_RAY_CELLS:
        raise InputError("ray", f"{cells:.0f} cells are too many", "use a coarser resolution or a shorter range")
