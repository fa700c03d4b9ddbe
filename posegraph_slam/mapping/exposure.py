"""Evening out the exposure of colour frames: a gain for each frame and channel, solved over the cells they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, cg

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError

SIGMA_SAMPLE, SIGMA_GAIN = 0.05, 0.3
"""Standard deviations of the logarithms of a sample's colour and of a frame's gain. A pixel at the border of a tile is
far off, but the robust loss takes care of these."""
HUBER = 1.345
"""Residuals beyond so many standard deviations count linearly: 95 % efficient for Gaussian noise."""
ROUNDS = 12
"""Rounds of reweighting; they end sooner once no gain moves by a thousandth."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExposureSamples:
    """Mean colours (S, 3) on a scale from 0 to 255, each of one cell (S,) in one frame (S,): whole identifiers."""

    frame: IntArray
    cell: IntArray
    colour: FloatArray

    def __post_init__(self) -> None:
        for name, dtype in (("frame", np.int64), ("cell", np.int64), ("colour", np.float32)):
            object.__setattr__(self, name, read_only(getattr(self, name), dtype))
        if self.frame.shape != self.cell.shape or self.colour.shape != (*self.frame.shape, 3):
            raise InputError("exposure samples", f"{self.colour.shape} colours do not fit {self.frame.shape} frames")

    @classmethod
    def joined(cls, parts: Sequence[ExposureSamples]) -> ExposureSamples:
        """Return the samples of all parts, in order."""
        empty = np.empty(0)
        return cls(
            frame=np.concatenate([empty, *(part.frame for part in parts)]),
            cell=np.concatenate([empty, *(part.cell for part in parts)]),
            colour=np.concatenate([np.empty((0, 3)), *(part.colour for part in parts)]),
        )


def exposure_gains(samples: ExposureSamples, frames: int) -> FloatArray:
    """Return the gain (F, 3) of each of `frames` frames and channel: how much brighter it is than the mean of all.

    Model: log colour = log gain of the frame + log colour of the cell + noise; least squares over frames and cells
    together, with Huber's loss on the largest residual of the three channels and a weak prior gain of 1. The mean gain
    of frames that are tied together is 1, as if their images were averaged: the gauge. A frame alone keeps 1.
    Source: Brown and Lowe 2007, section 6 (gain compensation), with logarithms and cells in place of image overlaps.
    """
    logs = np.log(np.maximum(samples.colour.astype(np.float64), 1.0))
    cells, cell = np.unique(samples.cell, return_inverse=True)
    weight, gains = np.ones(len(cell)), np.zeros((frames, 3))
    if len(cell) == 0:
        return np.ones((frames, 3))
    for _ in range(ROUNDS):
        before = gains
        gains, means = _solve(samples.frame, cell, logs, weight, (frames, len(cells)), before)
        residual = np.abs(logs - gains[samples.frame] - means[cell]).max(axis=1) / SIGMA_SAMPLE
        weight = HUBER / np.maximum(residual, HUBER)
        if np.abs(gains - before).max() < 1e-3:
            break
    return _with_mean_one(np.exp(gains), samples.frame, cell)


def _with_mean_one(gains: FloatArray, frame: IntArray, cell: IntArray) -> FloatArray:
    """Scale the gains (F, 3) so that the mean is 1 over all frames tied together by samples: frame and cell (S,)."""
    frames = len(gains)
    nodes = frames + int(cell.max()) + 1
    tied = csr_array((np.ones(len(cell)), (frame, frames + cell)), shape=(nodes, nodes))
    group = connected_components(tied, directed=False)[1][:frames]
    sums = np.stack([np.bincount(group, channel) for channel in gains.T], axis=1)
    return np.asarray(gains / (sums / np.maximum(np.bincount(group), 1)[:, None])[group])


def _solve(
    frame: IntArray, cell: IntArray, logs: FloatArray, weight: FloatArray, shape: tuple[int, int], start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Log gains (F, 3) and log colours (M, 3) of weighted least squares; the cells are eliminated, never formed."""
    tied = csr_array((weight, (frame, cell)), shape=shape)
    across = tied.T.tocsr()
    per_frame = np.bincount(frame, weight, shape[0])
    per_cell = np.bincount(cell, weight, shape[1])
    prior = (SIGMA_SAMPLE / SIGMA_GAIN) ** 2
    frame_sums = np.stack([np.bincount(frame, weight * column, shape[0]) for column in logs.T], axis=1)
    cell_sums = np.stack([np.bincount(cell, weight * column, shape[1]) for column in logs.T], axis=1)
    cell_means = cell_sums / per_cell[:, None]
    right = frame_sums - tied @ cell_means
    diagonal = per_frame + prior

    def without_cells(g: FloatArray) -> FloatArray:
        return np.asarray(diagonal * g - tied @ (np.asarray(across @ g) / per_cell))

    system = LinearOperator((shape[0], shape[0]), matvec=without_cells, dtype=float)
    scale = LinearOperator((shape[0], shape[0]), matvec=lambda g: g / diagonal, dtype=float)
    columns = [cg(system, right[:, k], x0=start[:, k], rtol=1e-8, maxiter=2000, M=scale)[0] for k in range(3)]
    gains = np.stack(columns, axis=1)
    return gains, cell_means - np.asarray(across @ gains) / per_cell[:, None]
