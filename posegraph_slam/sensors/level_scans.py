"""Scans of a laser that tilts and pans, as scans of a level one that does neither."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray
from posegraph_slam.jit import kernel

GAP_M = 0.3
"""Neighbouring returns nearer than this, or than a tenth of their range, are on one surface."""


def level_ranges(
    ranges_m: Float32Array, angles_rad: FloatArray, T_base_lidar: FloatArray, ground_m: float, limits_m: FloatArray
) -> tuple[Float32Array, int]:
    """Project scans (N, B) onto the ground plane and see them again from the base, all around.

    `T_base_lidar` (N, 4, 4) places the laser at each scan. Returns within `limits_m` (2,) that lie below `ground_m`
    hit the ground and are dropped. Result (N, M): beam k points at -pi + k * increment with the laser's own
    increment, its range is that of the surface between neighbouring returns (zero: none), and how many were dropped.
    """
    increment = float(angles_rad[1] - angles_rad[0])
    count = round(2 * np.pi / increment)
    directions = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=1)
    level = np.full((len(ranges_m), count), np.inf, dtype=np.float32)
    dropped = int(_project(ranges_m, directions, T_base_lidar, ground_m, limits_m, level))
    level[np.isinf(level)] = 0.0
    return level, dropped


@kernel
def _project(ranges, directions, T, ground, limits, level):  # type: ignore[no-untyped-def]
    beams = ranges.shape[1]
    bins = level.shape[1]
    step = 2 * np.pi / bins
    dropped = 0
    for n in range(len(ranges)):
        known = False
        px, py, last = 0.0, 0.0, -2
        for b in range(beams):
            r = ranges[n, b]
            if not (limits[0] <= r < limits[1]):
                continue
            lx, ly = r * directions[b, 0], r * directions[b, 1]
            z = T[n, 2, 0] * lx + T[n, 2, 1] * ly + T[n, 2, 3]
            if z < ground:
                dropped += 1
                continue
            x = T[n, 0, 0] * lx + T[n, 0, 1] * ly + T[n, 0, 3]
            y = T[n, 1, 0] * lx + T[n, 1, 1] * ly + T[n, 1, 3]
            # On the nearest beam the point counts by itself; a surface through it replaces that below.
            k = int(np.round((np.arctan2(y, x) + np.pi) / step)) % bins
            level[n, k] = min(level[n, k], np.hypot(x, y))
            if known and last == b - 1 and np.hypot(x - px, y - py) < max(GAP_M, 0.1 * r):
                _fill(level[n], px, py, x, y, step)
            px, py, last, known = x, y, b, True
    return dropped


@kernel
def _fill(level, ax, ay, bx, by, step):  # type: ignore[no-untyped-def]
    """Put the segment from a to b on all beams between their bearings."""
    cross = ax * by - ay * bx
    if abs(cross) < 1e-12:
        return
    if cross < 0:  # seen clockwise: swap
        ax, ay, bx, by = bx, by, ax, ay
        cross = -cross
    first = (np.arctan2(ay, ax) + np.pi) / step
    turn = np.arctan2(cross, ax * bx + ay * by) / step
    bins = len(level)
    for k in range(int(np.ceil(first)), int(np.floor(first + turn)) + 1):
        bearing = k * step - np.pi
        c, s = np.cos(bearing), np.sin(bearing)
        across = c * (by - ay) - s * (bx - ax)
        if across <= 0:
            continue
        at = k % bins
        r = cross / across
        # The nearest-beam value of the two end points is off by up to half a beam: the surface itself is exact.
        own = abs(level[at] - r) < 0.1 * r
        level[at] = r if own else min(level[at], r)
