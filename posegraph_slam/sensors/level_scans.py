"""Scans of a laser that tilts and pans, as scans of a level one that does neither."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray
from posegraph_slam.jit import kernel

GAP_M = 0.3
"""Neighbouring returns nearer than this, or than a tenth of their range, are on one surface."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelFan:
    """Beams of the level scan: beam k of `count` points at `angle_min_rad` + k `increment_rad`."""

    angle_min_rad: float
    increment_rad: float
    count: int

    @staticmethod
    def all_around(increment_rad: float) -> LevelFan:
        """Beams from -pi on, once round, about as far apart as given."""
        count = round(2 * np.pi / increment_rad)
        return LevelFan(angle_min_rad=-np.pi, increment_rad=2 * np.pi / count, count=count)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelRanges:
    """Ranges (N, M) of the level scan, zero where there is none, and how many returns were too low and too high."""

    ranges_m: Float32Array
    too_low: int
    too_high: int


def level_ranges(
    ranges_m: Float32Array,
    angles_rad: FloatArray,
    T_level_lidar: FloatArray,
    *,
    heights_m: tuple[float, float],
    limits_m: FloatArray,
    fan: LevelFan | None = None,
) -> LevelRanges:
    """Project scans (N, B) onto the ground plane and see them again from the origin of a level frame.

    `T_level_lidar` (N, 4, 4) places the laser at each scan. Returns within `limits_m` (2,) whose height in the level
    frame is outside `heights_m` hit ground or ceiling and are dropped. `fan` is by default all around with the laser's
    own increment; the range of a beam is that of the surface between neighbouring returns.
    """
    fan = fan or LevelFan.all_around(float(angles_rad[1] - angles_rad[0]))
    directions = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=1)
    level = np.full((len(ranges_m), fan.count), np.inf, dtype=np.float32)
    band = np.array([*heights_m, *limits_m])
    low, high = _project(ranges_m, directions, T_level_lidar, band, fan.angle_min_rad, fan.increment_rad, level)
    level[np.isinf(level)] = 0.0
    return LevelRanges(ranges_m=level, too_low=int(low), too_high=int(high))


@kernel
def _project(ranges, directions, T, band, start, step, level):  # type: ignore[no-untyped-def]
    beams = ranges.shape[1]
    bins, turn = level.shape[1], int(np.round(2 * np.pi / step))
    low, high = 0, 0
    for n in range(len(ranges)):
        known = False
        px, py, last = 0.0, 0.0, -2
        for b in range(beams):
            r = ranges[n, b]
            if not (band[2] <= r < band[3]):
                continue
            lx, ly = r * directions[b, 0], r * directions[b, 1]
            z = T[n, 2, 0] * lx + T[n, 2, 1] * ly + T[n, 2, 3]
            if z < band[0]:
                low += 1
                continue
            if z > band[1]:
                high += 1
                continue
            x = T[n, 0, 0] * lx + T[n, 0, 1] * ly + T[n, 0, 3]
            y = T[n, 1, 0] * lx + T[n, 1, 1] * ly + T[n, 1, 3]
            # On the nearest beam the point counts by itself; a surface through it replaces that below.
            k = int(np.round((np.arctan2(y, x) - start) / step)) % turn
            if k < bins:
                level[n, k] = min(level[n, k], np.hypot(x, y))
            if known and last == b - 1 and np.hypot(x - px, y - py) < max(GAP_M, 0.1 * r):
                _fill(level[n], px, py, x, y, start, step)
            px, py, last, known = x, y, b, True
    return low, high


@kernel
def _fill(level, ax, ay, bx, by, start, step):  # type: ignore[no-untyped-def]
    """Put the segment from a to b on all beams between their bearings."""
    cross = ax * by - ay * bx
    if abs(cross) < 1e-12:
        return
    if cross < 0:  # seen clockwise: swap
        ax, ay, bx, by = bx, by, ax, ay
        cross = -cross
    first = (np.arctan2(ay, ax) - start) / step
    turn = np.arctan2(cross, ax * bx + ay * by) / step
    bins, turns = len(level), int(np.round(2 * np.pi / step))
    for k in range(int(np.ceil(first)), int(np.floor(first + turn)) + 1):
        bearing = k * step + start
        c, s = np.cos(bearing), np.sin(bearing)
        across = c * (by - ay) - s * (bx - ax)
        if across <= 0:
            continue
        at = k % turns
        if at >= bins:
            continue
        r = cross / across
        # The nearest-beam value of the two end points is off by up to half a beam: the surface itself is exact.
        own = abs(level[at] - r) < 0.1 * r
        level[at] = r if own else min(level[at], r)
