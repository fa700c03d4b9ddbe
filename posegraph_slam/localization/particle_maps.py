"""A map of its own for each particle, in tiles that particles share until one of them draws on one (copy on write).

Particles that stem from one ancestor differ only where they have drawn since: memory grows with the differences, not
with the number of particles times the area (after Eliazar and Parr 2003; Grisetti et al. 2007 do it with patches).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import ByteArray, FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.localization.cell_counts import count_scores, refresh_free_before
from posegraph_slam.localization.slam_map import FAR, SlamMap, cells_from_base, empty_map, touched_box, trace_scan
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.localization.slam_weights import field_scores, from_scores, weighed_scan, window_scores
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.mapping.raycast import NEVER_SEEN

TILE = 32
"""Cells along the side of a tile: 1.6 m at 0.05 m, 5 KiB."""
BLANK = 0
"""The tile in which nothing has been seen."""
WEIGHTINGS = ("likelihood_field", "window_correlation", "cell_counts")

Int32Array = npt.NDArray[np.int32]


class ParticleMaps:
    """Maps of all particles: a table (N, R, C) of tiles each, and the tiles' cells, both mutable."""

    def __init__(self, geometry: GridGeometry, settings: ParticleSlamSettings) -> None:
        self._settings = settings
        rows, columns = (-(-cells // TILE) for cells in geometry.shape)
        self._geometry = GridGeometry(
            origin_m=geometry.origin_m, resolution_m=geometry.resolution_m, shape=(rows * TILE, columns * TILE)
        )
        self.table: Int32Array = np.full((settings.particles, rows, columns), BLANK, dtype=np.int32)
        self._evidence: Int32Array = np.full((1, TILE, TILE), NEVER_SEEN)
        self._near: ByteArray = np.full((1, TILE, TILE), FAR, dtype=np.uint8)
        self._users: Int32Array = np.zeros(1, dtype=np.int32)
        self._spare: Int32Array = np.zeros(0, dtype=np.int32)
        """Tiles that no particle uses, the next to be taken last."""
        self._plan = empty_map(GridGeometry(origin_m=np.zeros(2), resolution_m=1.0, shape=(1, 1)), settings)
        self._empty = True
        self._peak = 0
        self._recount()

    def observe(self, particles: FloatArray, weights: FloatArray, points: FloatArray, sensor: FloatArray) -> FloatArray:
        """Weigh each particle by a scan's fit to its own map, and let each draw it there; see `Maps`."""
        if len(points) == 0:
            return weights
        settings = self._settings
        scan = weighed_scan(points, sensor, self._plan.reach, settings)
        kind = (WEIGHTINGS.index(settings.weighting), settings.window_cells // 2)
        scores, state = np.zeros(len(particles)), np.array([0, len(self._spare)])
        while state[0] < len(particles):
            observe_all(
                particles, points, sensor, (scan.few, scan.returns, scan.outline, scan.table), kind,
                self._geometry.cells_from_map, self._plan.steps, self._plan.reach, self.table,
                (self._evidence, self._near, self._users), self._spare, state, scores,
            )  # fmt: skip
            if state[0] < len(particles):
                self._spare = self._spare[: state[1]]
                self._grow()
                state[1] = len(self._spare)
        self._spare = self._spare[: state[1]]
        self._peak = max(self._peak, self.bytes_used)
        if self._empty:
            self._empty = False
            return weights
        weights = weights + from_scores(scores, settings)
        return np.asarray(weights - weights.max())

    def resample(self, ancestors: IntArray) -> None:
        """Give particle k the tiles of particle `ancestors[k]`; nothing is copied but the table."""
        self.table = np.ascontiguousarray(self.table[ancestors])
        self._recount()

    def occupancy(self, particle: int) -> OccupancyGrid:
        """Put the map of a particle together."""
        rows, columns = self._geometry.shape
        evidence = self._evidence[self.table[particle]].swapaxes(1, 2).reshape(rows, columns)
        near = self._near[self.table[particle]].swapaxes(1, 2).reshape(rows, columns)
        return SlamMap(
            geometry=self._geometry, evidence=evidence, near=near, stamps=near, mark=0, reach=self._plan.reach,
            steps=self._plan.steps, unit=self._plan.unit,
        ).occupancy()  # fmt: skip

    @property
    def tiles_used(self) -> int:
        """Tiles that at least one particle uses."""
        return len(self._users) - 1 - len(self._spare)

    @property
    def bytes_used(self) -> int:
        """Memory of the tiles in use and of the table."""
        return self.tiles_used * TILE * TILE * 5 + int(self.table.nbytes)

    @property
    def peak_bytes(self) -> int:
        """Most memory that tiles and table took at any time."""
        return self._peak

    def _recount(self) -> None:
        users = np.bincount(self.table.reshape(-1), minlength=len(self._users))
        self._users = users.astype(np.int32)
        unused = np.flatnonzero(users == 0)
        self._spare = unused[unused != BLANK][::-1].astype(np.int32)

    def _grow(self) -> None:
        """Add half as many tiles again, and at least as many as one particle can draw on."""
        old = len(self._users)
        added = max(old // 2, self.table.shape[1] * self.table.shape[2])
        self._evidence = np.concatenate([self._evidence, np.empty((added, TILE, TILE), dtype=np.int32)])
        self._near = np.concatenate([self._near, np.empty((added, TILE, TILE), dtype=np.uint8)])
        self._users = np.concatenate([self._users, np.zeros(added, dtype=np.int32)])
        self._spare = np.concatenate([np.arange(old, old + added, dtype=np.int32)[::-1], self._spare])


@kernel
def observe_all(particles, points, sensor, scan, kind, M, steps, reach, table, tiles, spare, state, scores):  # type: ignore[no-untyped-def]
    """Score and draw a scan for the particles from `state[0]` on, until all are done or spare tiles might run out.

    `state` holds the next particle and the number of spare tiles, `scores` (N,) the result. Each particle's tiles
    around the scan are laid out as one window, drawn on, and put back where they changed.
    """
    few, returns, outline, likelihood = scan
    weighting, half = kind
    evidence, near, users = tiles
    margin = 2 * reach + 1
    cells = TILE * TILE
    size = 0
    flat_evidence, flat_near = np.empty(0, dtype=np.int32), np.empty(0, dtype=np.uint8)
    flat_stamps = np.empty(0, dtype=np.uint8)
    mark = 0
    shape = (table.shape[1] * TILE, table.shape[2] * TILE)
    for k in range(state[0], len(particles)):
        T = cells_from_base(M, particles[k])
        low_row, end_row, low_column, end_column = touched_box(points, sensor, T, shape[0], shape[1])
        top, left = max(low_row - margin, 0) // TILE, max(low_column - margin, 0) // TILE
        bottom = min((end_row + margin + TILE - 1) // TILE, table.shape[1])
        right = min((end_column + margin + TILE - 1) // TILE, table.shape[2])
        tall, wide = max(bottom - top, 1), max(right - left, 1)
        top, left = min(top, table.shape[1] - 1), min(left, table.shape[2] - 1)
        if tall * wide > state[1]:
            return
        if tall * wide * cells > size:
            size = tall * wide * cells
            flat_evidence, flat_near = np.empty(size, dtype=np.int32), np.empty(size, dtype=np.uint8)
            flat_stamps = np.zeros(size, dtype=np.uint8)
            mark = 0
        window = flat_evidence[: tall * wide * cells].reshape((tall * TILE, wide * TILE))
        window_near = flat_near[: tall * wide * cells].reshape((tall * TILE, wide * TILE))
        stamps = flat_stamps[: tall * wide * cells].reshape((tall * TILE, wide * TILE))
        lay_out(table[k], evidence, near, top, left, window, window_near)
        shifted = M.copy()
        shifted[0, 2] -= left * TILE
        shifted[1, 2] -= top * TILE
        one = particles[k : k + 1]
        if weighting == 0:
            scores[k] = field_scores(one, few, shifted, window, window_near, likelihood)[0]
        elif weighting == 1:
            scores[k] = window_scores(one, few, shifted, window_near, half)[0]
        else:
            counts = np.zeros((window.shape[0], window.shape[1] + 1), dtype=np.int32)
            refresh_free_before(window, counts, 0, window.shape[0], 0, window.shape[1])
            scores[k] = count_scores(one, outline, returns, shifted, window_near, counts)[0]
        mark += 1
        if mark > 255:
            flat_stamps[:] = 0
            mark = 1
        T = cells_from_base(shifted, particles[k])
        trace_scan(points, T, sensor, steps, window, window_near, stamps, np.uint8(mark), reach)
        state[1] = put_back(table[k], evidence, near, users, spare, state[1], top, left, window, window_near)
        state[0] = k + 1


@kernel
def lay_out(table, evidence, near, top, left, window, window_near):  # type: ignore[no-untyped-def]
    """Copy the tiles from row `top` and column `left` of a particle's `table` (R, C) on into a window."""
    for r in range(window.shape[0]):
        for c in range(window.shape[1] // TILE):
            tile = table[top + r // TILE, left + c]
            copy_row(evidence[tile, r % TILE], window[r, c * TILE : (c + 1) * TILE])
            copy_row(near[tile, r % TILE], window_near[r, c * TILE : (c + 1) * TILE])


@kernel
def put_back(table, evidence, near, users, spare, spares, top, left, window, window_near):  # type: ignore[no-untyped-def]
    """Write the tiles of a window that changed, into tiles of their own where others use them; return `spares` left."""
    for r in range(window.shape[0] // TILE):
        for c in range(window.shape[1] // TILE):
            tile = table[top + r, left + c]
            changed = False
            for y in range(TILE):
                row, columns = r * TILE + y, slice(c * TILE, (c + 1) * TILE)
                changed = (
                    changed
                    or differs(window[row, columns], evidence[tile, y])
                    or differs(window_near[row, columns], near[tile, y])
                )
            if not changed:
                continue
            if tile == BLANK or users[tile] > 1:
                users[tile] -= 1
                spares -= 1
                tile = spare[spares]
                users[tile] = 1
                table[top + r, left + c] = tile
            for y in range(TILE):
                row, columns = r * TILE + y, slice(c * TILE, (c + 1) * TILE)
                copy_row(window[row, columns], evidence[tile, y])
                copy_row(window_near[row, columns], near[tile, y])
    return spares


@kernel
def copy_row(source, target):  # type: ignore[no-untyped-def]
    """Copy a row of a tile: plain loops over rows run on vectors, assigned slices of two dimensions do not."""
    for x in range(TILE):
        target[x] = source[x]


@kernel
def differs(one, other):  # type: ignore[no-untyped-def]
    """Tell whether two rows of a tile differ, without a branch."""
    found = False
    for x in range(TILE):
        found |= one[x] != other[x]
    return found
