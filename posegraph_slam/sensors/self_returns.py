"""Returns from the robot itself: what moves with the scanner while everything else goes by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import BoolArray, Float32Array, FloatArray, read_only
from posegraph_slam.settings import Settings

BIN_M = 0.01
SCANS_A_CHUNK = 2000


class SelfReturnSettings(Settings):
    """How parts of the robot that its own scanner sees are found."""

    enabled: bool = True
    """Find them in the log and leave them out."""
    reach_m: float = Field(default=0.8, gt=0, le=5)
    """Nothing farther away than this belongs to the robot."""
    share_min: float = Field(default=0.3, gt=0, le=1)
    """A beam sees the robot where at least this share of its ranges, while the robot moves, is one and the same,"""
    spread_m: float = Field(default=0.05, gt=0)
    """to within this."""
    margin_beams: int = Field(default=3, ge=0, le=100)
    """Beams beside one that sees the robot lose their returns at the same range, too: edges are seen now and then."""
    travel_min_m: float = Field(default=5.0, gt=0)
    """Without this much travel nothing is said: a robot that stands sees everything at one range."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SelfReturns:
    """For each beam (B,) the range at which it sees the robot, NaN for none, and the largest difference from it."""

    range_m: FloatArray
    spread_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "range_m", read_only(self.range_m))

    @property
    def beams(self) -> int:
        """How many beams see the robot."""
        return int(np.isfinite(self.range_m).sum())

    def mask(self, ranges_m: Float32Array) -> BoolArray:
        """Which of the ranges (N, B) are of the robot."""
        if not self.beams:
            return np.zeros(ranges_m.shape, dtype=np.bool_)
        return np.asarray(np.abs(ranges_m - self.range_m) <= self.spread_m)


def find_self_returns(ranges_m: Float32Array, travel_m: FloatArray, settings: SelfReturnSettings) -> SelfReturns:
    """Find the beams of scans (N, B) that see the robot; `travel_m` (N,) is the way driven up to each scan.

    Scans count where the robot moved since the last one that counts, so that a long stop before a wall is one scan.
    A beam sees the robot at the range around which most of its near ranges gather, if enough of all do.
    """
    beams = ranges_m.shape[1]
    nothing = SelfReturns(range_m=np.full(beams, np.nan), spread_m=settings.spread_m)
    far = float(travel_m[-1] - travel_m[0]) if len(travel_m) else 0.0
    if not settings.enabled or far < settings.travel_min_m:
        return nothing
    step = np.floor(travel_m / (0.02 * settings.travel_min_m))
    moving = np.flatnonzero(np.concatenate([[True], np.diff(step) > 0]))
    bins = int(np.ceil(settings.reach_m / BIN_M)) + 1
    counts = np.zeros((beams, bins), dtype=np.int64)
    for start in range(0, len(moving), SCANS_A_CHUNK):
        near = ranges_m[moving[start : start + SCANS_A_CHUNK]]
        rows, columns = np.nonzero((near >= BIN_M) & (near < settings.reach_m))
        np.add.at(counts, (columns, (near[rows, columns] / BIN_M).astype(np.int64)), 1)
    half = max(round(settings.spread_m / BIN_M), 1)
    running = np.pad(np.cumsum(np.pad(counts, ((0, 0), (half, half))), axis=1), ((0, 0), (1, 0)))
    gathered = running[:, 2 * half + 1 :] - running[:, : -(2 * half + 1)]
    best = np.argmax(gathered, axis=1)
    seen = gathered[np.arange(beams), best] >= settings.share_min * len(moving)
    weights = np.where(np.abs(np.arange(bins) - best[:, None]) <= half, counts, 0)
    middle = (weights @ (np.arange(bins) + 0.5) * BIN_M) / np.maximum(weights.sum(axis=1), 1)
    return SelfReturns(
        range_m=_widened(np.where(seen, middle, np.nan), settings.margin_beams), spread_m=settings.spread_m
    )


def _widened(ranges: FloatArray, beams: int) -> FloatArray:
    """Give beams without a value that of the nearest one within `beams`."""
    result = ranges.copy()
    for shift in (sign * step for step in range(1, beams + 1) for sign in (-1, 1)):
        moved = np.full_like(ranges, np.nan)
        source = slice(max(-shift, 0), len(ranges) - max(shift, 0))
        moved[max(shift, 0) : len(ranges) - max(-shift, 0)] = ranges[source]
        result = np.where(np.isfinite(result), result, moved)
    return result
