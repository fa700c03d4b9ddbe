"""Ray casting in space: walls of finite height, the ground's rectangles and the ceiling, seen by a tilted scanner."""

from __future__ import annotations

import math

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel


@kernel
def _beams_between(bearings: FloatArray, low: float, high: float, turn: int) -> tuple[int, int]:
    """First and one past the last of the rising `bearings` in [low, high], `turn` times round, with one of slack."""
    first = int(np.searchsorted(bearings, low + turn * 2.0 * math.pi)) - 1
    last = int(np.searchsorted(bearings, high + turn * 2.0 * math.pi)) + 1
    return max(first, 0), min(last, len(bearings))


@kernel
def _beam_directions(T: FloatArray, angles: FloatArray, directions: FloatArray, bearings: FloatArray) -> None:
    """Fill `directions` (B, 3) of the beams at `angles` (B,) in the world, and their rising `bearings` (B,)."""
    for k in range(len(angles)):
        c, s = math.cos(angles[k]), math.sin(angles[k])
        for axis in range(3):
            directions[k, axis] = c * T[axis, 0] + s * T[axis, 1]
        bearings[k] = math.atan2(directions[k, 1], directions[k, 0])
        if k > 0:  # bearings rise with the beams as long as the scanner is not upside down
            bearings[k] -= 2.0 * math.pi * math.floor((bearings[k] - bearings[k - 1]) / (2.0 * math.pi) + 1e-9)


@kernel
def _cast_to_ground(
    T: FloatArray, directions: FloatArray, patches: FloatArray, ceiling: float, ranges: FloatArray
) -> None:
    """Set `ranges` (B,) to the ceiling or the nearest of the ground's rectangles `patches` (P, 6)."""
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    for k in range(len(directions)):
        nearest = (ceiling - z) / directions[k, 2] if directions[k, 2] > 0.0 else np.inf
        for p in range(len(patches)):
            rise = patches[p, 5]
            falling = rise * directions[k, 1] - directions[k, 2]
            if falling <= 0.0:
                continue
            t = (z - patches[p, 4] - rise * (y - patches[p, 2])) / falling
            if not 0.0 <= t < nearest:
                continue
            px, py = x + t * directions[k, 0], y + t * directions[k, 1]
            if patches[p, 0] <= px <= patches[p, 1] and patches[p, 2] <= py <= patches[p, 3]:
                nearest = t
        ranges[k] = nearest


@kernel
def _cast_to_segments(
    T: FloatArray,
    directions: FloatArray,
    bearings: FloatArray,
    segments: FloatArray,
    spans: FloatArray,
    ranges: FloatArray,
) -> None:
    """Shorten `ranges` (B,) to straight walls `segments` (S, 4) that reach from `spans` (S, 2) low to high."""
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s, 0] - x, segments[s, 1] - y, segments[s, 2] - x, segments[s, 3] - y
        cross, ex, ey = ax * by - ay * bx, bx - ax, by - ay
        a, sweep = math.atan2(ay, ax), math.atan2(cross, ax * bx + ay * by)
        for turn in range(-1, 3):
            first, last = _beams_between(bearings, min(a, a + sweep), max(a, a + sweep), turn)
            for k in range(first, last):
                dx, dy = directions[k, 0], directions[k, 1]
                slope = dx * ey - dy * ex
                if slope == 0.0:
                    continue
                t, along = cross / slope, (ax * dy - ay * dx) / slope
                if 0.0 <= t < ranges[k] and -1e-12 <= along <= 1.0 + 1e-12:
                    height = z + t * directions[k, 2]
                    if spans[s, 0] <= height <= spans[s, 1]:
                        ranges[k] = t


@kernel
def _cast_to_circles(
    T: FloatArray,
    directions: FloatArray,
    bearings: FloatArray,
    circles: FloatArray,
    spans: FloatArray,
    ranges: FloatArray,
) -> None:
    """Shorten `ranges` (B,) to round walls `circles` (C, 3) that reach from `spans` (C, 2) low to high."""
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    for n in range(len(circles)):
        cx, cy, radius = circles[n, 0] - x, circles[n, 1] - y, circles[n, 2]
        gap, a = cx * cx + cy * cy - radius * radius, math.atan2(cy, cx)
        half = math.asin(radius / math.sqrt(cx * cx + cy * cy)) if gap > 0.0 else math.pi
        low, high = spans[n, 0], spans[n, 1]
        for turn in range(-1, 3):
            first, last = _beams_between(bearings, a - half, a + half, turn)
            for k in range(first, last):
                dx, dy = directions[k, 0], directions[k, 1]
                square, middle = dx * dx + dy * dy, cx * dx + cy * dy
                root = middle * middle - square * gap
                if root < 0.0:
                    continue
                t = (middle - math.sqrt(root)) / square
                if 0.0 <= t < ranges[k] and low <= z + t * directions[k, 2] <= high:
                    ranges[k] = t


@kernel
def cast_tilted(
    T: FloatArray,
    angles: FloatArray,
    segments: FloatArray,
    circles: FloatArray,
    spans: FloatArray,
    patches: FloatArray,
    ceiling: float,
    ranges: FloatArray,
) -> None:
    """Fill `ranges` (B,) along the beams at `angles` (B,) of a scanner at T_world_lidar (4, 4); infinity for none.

    A wall is hit only at a height within its span (S + C, 2), segments first; a wall that is overlooked hides nothing.
    """
    directions, bearings = np.empty((len(angles), 3)), np.empty(len(angles))
    _beam_directions(T, angles, directions, bearings)
    _cast_to_ground(T, directions, patches, ceiling, ranges)
    _cast_to_segments(T, directions, bearings, segments, spans[: len(segments)], ranges)
    _cast_to_circles(T, directions, bearings, circles, spans[len(segments) :], ranges)


@kernel
def cast_tilted_scans(  # type: ignore[no-untyped-def]
    poses, angles, segments, circles, spans, patches, ceiling
):
    """Cast scans from T_world_lidar (N, K, 4, 4), K poses for equal sectors of a sweep; exact ranges (N, B)."""
    scans, sectors, beams = poses.shape[0], poses.shape[1], len(angles)
    ranges = np.empty((scans, beams))
    for n in range(scans):
        for k in range(sectors):
            first, last = k * beams // sectors, (k + 1) * beams // sectors
            cast_tilted(
                poses[n, k], angles[first:last], segments, circles, spans, patches, ceiling, ranges[n, first:last]
            )
    return ranges


def ranges_to_posts(angles: FloatArray, posts: FloatArray) -> FloatArray:
    """Range (B,) of the nearest of round posts (P, 3) [x, y, radius] in the scanner's own plane, inf where none is."""
    ranges = np.full(len(angles), np.inf)
    for x, y, radius in posts:
        middle = x * np.cos(angles) + y * np.sin(angles)
        root = middle**2 - (x**2 + y**2 - radius**2)
        hit = (root >= 0) & (middle > 0)
        ranges[hit] = np.minimum(ranges[hit], middle[hit] - np.sqrt(root[hit]))
    return ranges
