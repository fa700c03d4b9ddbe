"""Ray casting in the plan view: the nearest obstacle on every beam of a fan."""

from __future__ import annotations

import math

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel


@kernel
def _visit(low: float, high: float, start: float, increment: float, count: int, turn: int) -> tuple[int, int]:
    """First and one past the last beam whose bearing, `turn` times round, lies in [low, high]; a beam of slack."""
    first = math.floor((low + turn * 2.0 * math.pi - start) / increment)
    last = math.ceil((high + turn * 2.0 * math.pi - start) / increment)
    return max(first, 0), min(last + 1, count)


@kernel
def cast_fan(
    x: float,
    y: float,
    start: float,
    increment: float,
    segments: FloatArray,
    circles: FloatArray,
    ranges: FloatArray,
    hits: IntArray,
) -> None:
    """Fill `ranges` (B,) and `hits` (B,) of the fan at (x, y) whose beam k has world bearing start + k increment.

    A hit is the number of the nearest obstacle, segments first, then circles; -1 and infinity where there is none.
    The fan spans at most one turn. Each obstacle is tested only against the beams within its own angle, as a depth
    buffer does.
    """
    count = ranges.shape[0]
    start -= 2.0 * math.pi * math.floor((start + math.pi) / (2.0 * math.pi))
    bearings = start + increment * np.arange(count)
    directions_x, directions_y = np.cos(bearings), np.sin(bearings)
    ranges[:] = np.inf
    hits[:] = -1
    for s in range(segments.shape[0]):
        ax, ay = segments[s, 0] - x, segments[s, 1] - y
        bx, by = segments[s, 2] - x, segments[s, 3] - y
        cross = ax * by - ay * bx
        a, sweep = math.atan2(ay, ax), math.atan2(cross, ax * bx + ay * by)
        ex, ey = bx - ax, by - ay
        for turn in range(-1, 3):
            first, last = _visit(min(a, a + sweep), max(a, a + sweep), start, increment, count, turn)
            for k in range(first, last):
                dx, dy = directions_x[k], directions_y[k]
                slope = dx * ey - dy * ex
                if slope == 0.0:
                    continue
                distance, along = cross / slope, (ax * dy - ay * dx) / slope
                if 0.0 <= distance < ranges[k] and -1e-12 <= along <= 1.0 + 1e-12:
                    ranges[k], hits[k] = distance, s
    for c in range(circles.shape[0]):
        cx, cy, radius = circles[c, 0] - x, circles[c, 1] - y, circles[c, 2]
        gap = cx * cx + cy * cy - radius * radius
        a = math.atan2(cy, cx)
        half = math.asin(radius / math.sqrt(cx * cx + cy * cy)) if gap > 0.0 else math.pi
        for turn in range(-1, 3):
            first, last = _visit(a - half, a + half, start, increment, count, turn)
            for k in range(first, last):
                nearest = cx * directions_x[k] + cy * directions_y[k]
                root = nearest * nearest - gap
                if root >= 0.0 and nearest - math.sqrt(root) >= 0.0 and nearest - math.sqrt(root) < ranges[k]:
                    ranges[k], hits[k] = nearest - math.sqrt(root), segments.shape[0] + c


@kernel
def cast_scans(poses: FloatArray, fan: FloatArray, beams: int, segments: FloatArray, circles: FloatArray) -> FloatArray:
    """Cast scans from `poses` (N, K, 3) [x, y, heading] of the sensor; return exact ranges (N, beams), inf if none.

    `fan` is [first bearing, increment] in the sensor frame. A scan is cut into K sectors of equal beams, each seen
    from its own pose (K = 1: the sensor stands still during the scan).
    """
    scans, sectors = poses.shape[0], poses.shape[1]
    ranges = np.empty((scans, beams))
    hits = np.empty(beams, dtype=np.int64)
    for n in range(scans):
        for k in range(sectors):
            first, last = k * beams // sectors, (k + 1) * beams // sectors
            start = poses[n, k, 2] + fan[0] + first * fan[1]
            cast_fan(
                poses[n, k, 0],
                poses[n, k, 1],
                start,
                fan[1],
                segments,
                circles,
                ranges[n, first:last],
                hits[first:last],
            )
    return ranges
