"""Ground of different heights: corridors on levels of their own, joined by ramps, under one ceiling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.datasets.simulation.settings import LANDING_M, WorldSettings

WHEELBASE_SIGMA_M = 0.1
"""A robot with two axles crosses the edge of a ramp as if it were rounded by about this much."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Terrain:
    """Level of each corridor along x, and one ramp along y in each corridor between two of them.

    `levels_m` (up + 1,); `foot_m` and `head_m` (across + 1, up) are the y at which the ramp of corridor a between the
    levels b and b + 1 begins and ends. `corridor_x` (across + 1,) are the centre lines of the ramps' corridors.
    `patches` (P, 6) [x from, x to, y from, y to, z at y from, rise per y] are the ground as rectangles. `spans_m`
    (S + C, 2) is the height at which each obstacle begins and ends, in the order of the world's colours.
    """

    levels_m: FloatArray
    foot_m: FloatArray
    head_m: FloatArray
    corridor_x: FloatArray
    patches: FloatArray
    ceiling_m: float
    spans_m: FloatArray

    def __post_init__(self) -> None:
        for name in ("levels_m", "foot_m", "head_m", "corridor_x", "patches", "spans_m"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def ground(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Height (n,) and gradient (n, 2) under a robot at points (n, 2) of its drive.

        The edges of the ramps are rounded by a Gaussian, exactly: a bend of slope s at y_0 gives s (u P + sigma p) with
        u = y - y_0, and P, p the normal distribution function and density of u / sigma.
        """
        corridor = np.argmin(np.abs(points_m[:, :1] - self.corridor_x), axis=1)
        slope = np.diff(self.levels_m) / (self.head_m - self.foot_m)
        at_foot, at_head = (_bend(points_m[:, 1:] - edge[corridor]) for edge in (self.foot_m, self.head_m))
        height = self.levels_m[0] + np.sum(slope[corridor] * (at_foot[0] - at_head[0]), axis=1)
        along = np.sum(slope[corridor] * (at_foot[1] - at_head[1]), axis=1)
        return height, np.stack([np.zeros_like(along), along], axis=1)


def _bend(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Height and slope of a rounded bend from 0 to 1 at distance u from it."""
    normal = u / WHEELBASE_SIGMA_M
    density = np.exp(-0.5 * normal**2) / np.sqrt(2 * np.pi)
    share = np.asarray(ndtr(normal), dtype=np.float64)
    return u * share + WHEELBASE_SIGMA_M * density, share


def build_terrain(
    settings: WorldSettings,
    *,
    corridor_x: FloatArray,
    corridor_y: FloatArray,
    obstacles: FloatArray,
    standing: FloatArray,
    rng: np.random.Generator,
) -> Terrain:
    """Draw levels and ramps for the corridors of a plan; raises nothing, since the settings are checked already.

    `obstacles` (n, 2) are the places of the obstacles and `standing` (n,) their heights above the ground there, inf for
    those that reach the ceiling.
    """
    ramps, half = settings.ramps, settings.corridor_width_m / 2
    across, up = len(corridor_x), len(corridor_y) - 1
    rise = rng.uniform(ramps.rise_min_m, ramps.rise_max_m, size=up) * rng.choice([-1.0, 1.0], size=up)
    levels = np.concatenate([[0.0], np.cumsum(rise)])
    slope = np.tan(np.radians(rng.uniform(ramps.slope_min_deg, ramps.slope_max_deg, size=(across, up))))
    length = np.abs(rise) / slope
    low, high = corridor_y[:-1] + half + LANDING_M, corridor_y[1:] - half - LANDING_M - length
    foot = low + rng.random((across, up)) * (high - low)
    terrain = Terrain(
        levels_m=levels,
        foot_m=foot,
        head_m=foot + length,
        corridor_x=corridor_x,
        patches=_patches(levels, foot, foot + length, corridor_x, corridor_y, half),
        ceiling_m=float(levels.max()) + ramps.ceiling_m,
        spans_m=np.zeros((0, 2)),
    )
    bottom = patch_height(terrain.patches, obstacles)
    spans = np.stack([np.full(len(bottom), -np.inf), np.minimum(bottom + standing, terrain.ceiling_m)], axis=1)
    names = ("levels_m", "foot_m", "head_m", "corridor_x", "patches", "ceiling_m")
    return Terrain(**{name: getattr(terrain, name) for name in names}, spans_m=spans)


def _patches(
    levels: FloatArray, foot: FloatArray, head: FloatArray, corridor_x: FloatArray, corridor_y: FloatArray, half: float
) -> FloatArray:
    """Ground as rectangles (P, 6): corridors along x, ramps with what is level before and after them, and rooms."""
    left, right = float(corridor_x[0]) - half, float(corridor_x[-1]) + half
    rows = [[left, right, y - half, y + half, z, 0.0] for y, z in zip(corridor_y, levels, strict=True)]
    for b in range(len(levels) - 1):
        bottom, top = float(corridor_y[b]) + half, float(corridor_y[b + 1]) - half
        below, above = float(levels[b]), float(levels[b + 1])
        for a, x in enumerate(corridor_x.tolist()):
            begin, end = float(foot[a, b]), float(head[a, b])
            rows.append([x - half, x + half, bottom, begin, below, 0.0])
            rows.append([x - half, x + half, begin, end, below, (above - below) / (end - begin)])
            rows.append([x - half, x + half, end, top, above, 0.0])
            if a + 1 < len(corridor_x):
                inner = (x + half, float(corridor_x[a + 1]) - half)
                rows.append([*inner, bottom, 0.5 * (bottom + top), below, 0.0])
                rows.append([*inner, 0.5 * (bottom + top), top, above, 0.0])
    return np.asarray(rows, dtype=np.float64)


def patch_height(patches: FloatArray, points_m: FloatArray) -> FloatArray:
    """Height (n,) of the ground under points (n, 2), sharp edges included; of the nearest patch outside of all."""
    x, y = points_m[:, :1], points_m[:, 1:]
    outside = np.maximum(np.maximum(patches[:, 0] - x, x - patches[:, 1]), 0.0)
    outside += np.maximum(np.maximum(patches[:, 2] - y, y - patches[:, 3]), 0.0)
    best = patches[np.argmin(outside, axis=1)]
    along = np.clip(points_m[:, 1], best[:, 2], best[:, 3]) - best[:, 2]
    return np.asarray(best[:, 4] + best[:, 5] * along)
