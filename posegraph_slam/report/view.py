"""The part of a grid that a figure shows, at no more pixels than a page can."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import BoolArray, FloatArray
from posegraph_slam.mapping.grid import GridGeometry

MAXIMUM_PIXELS = 1600
"""Longer side of a picture: what 7.5 inches print at 200 dots an inch, and a little more."""

MARGIN_CELLS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A window of `rows` and `columns` of a grid, shown one pixel a block of `block` x `block` cells."""

    rows: slice
    columns: slice
    block: int
    extent_m: tuple[float, float, float, float]
    """Left, right, bottom and top edge of the picture."""

    @classmethod
    def of(cls, geometry: GridGeometry, seen: BoolArray) -> View:
        """Return the smallest window with all cells `seen` and a margin; the whole grid where nothing was seen."""
        rows, columns = (_span(np.asarray(seen.any(axis=axis))) for axis in (1, 0))
        longest = max(rows.stop - rows.start, columns.stop - columns.start)
        block = -(-longest // MAXIMUM_PIXELS)
        x, y = (float(value) for value in geometry.origin_m)
        size = geometry.resolution_m
        wide, high = (-(-(span.stop - span.start) // block) * block for span in (columns, rows))
        left, bottom = x + columns.start * size, y + rows.start * size
        extent = (left, left + wide * size, bottom, bottom + high * size)
        return cls(rows=rows, columns=columns, block=block, extent_m=extent)

    def peaks(self, values: FloatArray) -> FloatArray:
        """Return the largest value of each block, so that a wall of one cell does not vanish."""
        window = values[self.rows, self.columns]
        pad = [(0, -size % self.block) for size in window.shape]
        padded = np.pad(window, pad, constant_values=-np.inf)
        high, wide = (size // self.block for size in padded.shape)
        return np.asarray(padded.reshape(high, self.block, wide, self.block).max(axis=(1, 3)))

    def samples(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the first value of each block."""
        return values[self.rows, self.columns][:: self.block, :: self.block]


def _span(used: BoolArray) -> slice:
    index = np.flatnonzero(used)
    if len(index) == 0:
        return slice(0, len(used))
    return slice(max(int(index[0]) - MARGIN_CELLS, 0), min(int(index[-1]) + 1 + MARGIN_CELLS, len(used)))


def bounds_around(points_m: FloatArray, *, margin: float = 0.05) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top around points (n, 2), with a margin in parts of the larger side."""
    finite = points_m[np.isfinite(points_m).all(axis=1)]
    low, high = (finite.min(axis=0), finite.max(axis=0)) if len(finite) else (np.zeros(2), np.zeros(2))
    space = margin * max(float((high - low).max()), 1.0)
    return float(low[0] - space), float(high[0] + space), float(low[1] - space), float(high[1] + space)
