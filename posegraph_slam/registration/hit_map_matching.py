"""Two-stage correlative matching of a scan against a growing map of hit counts, as early course reports do it.

A cell counts the returns that fell into it, up to a bound. The score of a pose is the mean count under the scan's
points plus a Gaussian prior about the odometry pose, scaled to the counts; a coarse window of poses is searched, then
a fine one about its best. The steps of a window are whole fractions or multiples of a cell, so that the points are
turned once for each angle and every shift reads whole cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from posegraph_slam.arrays import ByteArray, FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.jit import kernel
from posegraph_slam.settings import Settings

DEGREE = float(np.pi / 180)
STEP_TOLERANCE = 1e-6


class WindowSettings(Settings):
    """A window of poses about a guess: every step within reach, in x and y alike and in heading."""

    reach_m: float = Field(gt=0, le=10)
    """Furthest shift along either axis."""
    step_m: float = Field(gt=0)
    """Distance of neighbouring shifts: a whole multiple of the map's cell, or a cell over a whole number."""
    reach_rad: float = Field(ge=0, le=3.2)
    """Furthest turn."""
    step_rad: float = Field(gt=0)
    """Distance of neighbouring turns."""

    @property
    def shifts(self) -> int:
        """Shifts to either side."""
        return int(np.floor(self.reach_m / self.step_m + STEP_TOLERANCE))

    @property
    def turns(self) -> int:
        """Turns to either side."""
        return int(np.floor(self.reach_rad / self.step_rad + STEP_TOLERANCE))


class HitMapSettings(Settings):
    """The map of hit counts and the two windows."""

    resolution_m: float = Field(default=0.05, gt=0, le=1)
    """Side of a cell."""
    hits_max: int = Field(default=100, ge=1, le=255)
    """Counts stop here."""
    coarse: WindowSettings = WindowSettings(reach_m=0.1, step_m=0.05, reach_rad=3 * DEGREE, step_rad=DEGREE)
    """First window, about the odometry pose."""
    fine: WindowSettings = WindowSettings(reach_m=0.05, step_m=0.025, reach_rad=DEGREE, step_rad=0.25 * DEGREE)
    """Second window, about the best pose of the first."""
    prior_weight: float = Field(default=0.2, ge=0)
    """Height of the Gaussian prior about the odometry pose, as a share of the best count in the window."""

    @model_validator(mode="after")
    def _check_steps(self) -> Self:
        for name, window in (("coarse", self.coarse), ("fine", self.fine)):
            ratio = window.step_m / self.resolution_m
            ratio = ratio if ratio >= 1 else 1 / ratio
            if abs(ratio - round(ratio)) > STEP_TOLERANCE:
                raise ValueError(f"{name}.step_m {window.step_m:g} is no whole multiple or fraction of a cell")
        return self

    def window(self, window: WindowSettings) -> FloatArray:
        """What the kernel needs of a window: shifts, turns, step in cells, step of a turn, and the prior's sigmas.

        The prior has the variance of the window: its reach is one sigma.
        """
        sigma = max(window.reach_rad, window.step_rad)
        step = window.step_m / self.resolution_m
        return np.array([window.shifts, window.turns, step, window.step_rad, window.reach_m, sigma])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HitMap:
    """Counts (R, C) uint8 of returns; cell (0, 0) has its lower-left corner at `origin_m` (2,), row = +y."""

    hits: ByteArray
    origin_m: FloatArray
    settings: HitMapSettings

    def __post_init__(self) -> None:
        object.__setattr__(self, "hits", read_only(self.hits, np.uint8))
        object.__setattr__(self, "origin_m", read_only(self.origin_m))

    @staticmethod
    def empty(origin_m: FloatArray, shape: tuple[int, int], settings: HitMapSettings) -> HitMap:
        """Return a map of `shape` (rows, columns) without any hit."""
        return HitMap(hits=np.zeros(shape, dtype=np.uint8), origin_m=origin_m, settings=settings)

    @property
    def frame(self) -> FloatArray:
        """Origin and resolution (3,) for kernels."""
        return np.array([*self.origin_m, self.settings.resolution_m])

    def with_points(self, points: FloatArray, xyt: FloatArray) -> HitMap:
        """Return the map with the returns `points` (n, 2) of a scan at pose `xyt` (3,) counted."""
        hits = self.hits.copy()
        add_hits(hits, self.frame, np.ascontiguousarray(points, dtype=np.float64), xyt, self.settings.hits_max)
        return HitMap(hits=hits, origin_m=self.origin_m, settings=self.settings)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HitMatch:
    """Best pose [x, y, theta] (3,), its score, and the share of the points on cells that were hit before."""

    xyt: FloatArray
    score: float
    matched_fraction: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyt", read_only(self.xyt))


def match_on_hits(points: FloatArray, hit_map: HitMap, odometry: FloatArray) -> HitMatch:
    """Match the points (n, 2) of a scan in the robot's frame to the map, from the odometry pose [x, y, theta] (3,).

    Score: mean count under the points over the largest, plus the prior. Of equal scores the one nearest to the
    odometry wins. Points whose window leaves the map do not count. Raises `InputError` for input that is not finite.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    odometry = np.asarray(odometry, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or odometry.shape != (3,):
        raise InputError("correlative matching", f"points {points.shape} and pose {odometry.shape} are not planar")
    if not (np.isfinite(points).all() and np.isfinite(odometry).all()):
        raise InputError("correlative matching", "points or pose are not finite")
    s = hit_map.settings
    xyt, score = match_scan_on_hits(
        points, hit_map.hits, hit_map.frame, odometry, s.window(s.coarse), s.window(s.fine), prior_of(s)
    )
    share = share_on_hits(points, hit_map.hits, hit_map.frame, xyt)
    return HitMatch(xyt=xyt, score=float(score), matched_fraction=float(share))


def prior_of(settings: HitMapSettings) -> FloatArray:
    """Weight of the prior and the largest count (2,) for kernels."""
    return np.array([settings.prior_weight, float(settings.hits_max)])


@kernel
def add_hits(hits, frame, points, xyt, hits_max):  # type: ignore[no-untyped-def]
    """Count the points (n, 2) of a scan at `xyt` (3,) in `hits` (R, C), in place, up to `hits_max`."""
    rows, columns = hits.shape
    c, s = np.cos(xyt[2]), np.sin(xyt[2])
    for k in range(len(points)):
        x = (c * points[k, 0] - s * points[k, 1] + xyt[0] - frame[0]) / frame[2]
        y = (s * points[k, 0] + c * points[k, 1] + xyt[1] - frame[1]) / frame[2]
        column, row = int(np.floor(x)), int(np.floor(y))
        if 0 <= row < rows and 0 <= column < columns and hits[row, column] < hits_max:
            hits[row, column] += 1


@kernel
def share_on_hits(points, hits, frame, xyt):  # type: ignore[no-untyped-def]
    """Share of the points (n, 2) of a scan at `xyt` (3,) that lie on cells hit before."""
    rows, columns = hits.shape
    c, s = np.cos(xyt[2]), np.sin(xyt[2])
    known = 0
    for k in range(len(points)):
        column = int(np.floor((c * points[k, 0] - s * points[k, 1] + xyt[0] - frame[0]) / frame[2]))
        row = int(np.floor((s * points[k, 0] + c * points[k, 1] + xyt[1] - frame[1]) / frame[2]))
        if 0 <= row < rows and 0 <= column < columns and hits[row, column] > 0:
            known += 1
    return known / max(len(points), 1)


@kernel
def count_under(points, hits, frame, xyt, shifts, stride, sub, sums, totals):  # type: ignore[no-untyped-def]
    """Fill `totals` (2 shifts + 1, 2 shifts + 1) with the counts under the points at `xyt`, for every shift [y, x].

    A shift is `stride` cells, or a cell over `sub`. Points are sorted by the part of the cell they lie in, sub^2 of
    them: those of one part move into the next cell together, so that a point reads each cell of its window once.
    Neighbouring points in one part of one cell are read once and weighted. `sums` (sub, sub, W, W) is workspace, W
    the width of a point's window of cells.
    """
    rows, columns = hits.shape
    flat, width = hits.reshape(rows * columns), sums.shape[2]
    low, reach = (-shifts) // sub * stride, (width - 1) * stride
    sums[:] = 0
    c, s, scale = np.cos(xyt[2]), np.sin(xyt[2]), sub / frame[2]
    left, bottom = (xyt[0] - frame[0]) * scale, (xyt[1] - frame[1]) * scale
    c, s = c * scale, s * scale
    last_x, last_y, weight, count = 0, 0, 0, len(points)
    for k in range(count + 1):
        fx, fy = last_x, last_y
        if k < count:
            fx = int(np.floor(c * points[k, 0] - s * points[k, 1] + left))
            fy = int(np.floor(s * points[k, 0] + c * points[k, 1] + bottom))
            if weight > 0 and fx == last_x and fy == last_y:
                weight += 1
                continue
        if weight > 0:
            x, y = last_x // sub + low, last_y // sub + low
            if x >= 0 and y >= 0 and x + reach < columns and y + reach < rows:
                px, py = last_x - (last_x // sub) * sub, last_y - (last_y // sub) * sub
                part = sums[py, px]
                for i in range(width):
                    at = (y + i * stride) * columns + x
                    for j in range(width):
                        # unsigned, or numba checks every index for being negative
                        part[i, j] += weight * flat[np.uint64(at + j * stride)]
        last_x, last_y, weight = fx, fy, 1
    side = 2 * shifts + 1
    first = (-shifts) // sub
    for i in range(side):
        for j in range(side):
            total = 0
            for py in range(sub):
                for px in range(sub):
                    total += sums[py, px, (py + i - shifts) // sub - first, (px + j - shifts) // sub - first]
            totals[i, j] = total


@kernel
def search_window(points, hits, frame, centre, odometry, window, prior):  # type: ignore[no-untyped-def]
    """Best pose (3,) of a window about `centre` (3,) with the prior about `odometry` (3,), and its score.

    `window`: shifts, turns, step in cells, step of a turn, sigmas of the prior; `prior`: its weight, largest count.
    """
    shifts, turns = int(window[0]), int(window[1])
    stride = max(int(np.round(window[2])), 1)
    sub = 1 if window[2] >= 1.0 else int(np.round(1.0 / window[2]))
    step = window[2] * frame[2]
    width = (shifts + sub - 1) // sub - (-shifts) // sub + 1
    sums = np.zeros((sub, sub, width, width), np.int64)
    totals = np.zeros((2 * turns + 1, 2 * shifts + 1, 2 * shifts + 1), np.int64)
    unit = 1.0 / (max(len(points), 1) * prior[1])
    best, score = centre.copy(), -1.0
    at = np.empty(3)
    for t in range(-turns, turns + 1):
        at[:] = centre
        at[2] += t * window[3]
        count_under(points, hits, frame, at, shifts, stride, sub, sums, totals[t + turns])
    # on an empty map the prior decides alone
    height = prior[0] * max(totals.max() * unit, 1e-9)
    for t in range(-turns, turns + 1):
        turned = (centre[2] + t * window[3] - odometry[2]) / window[5]
        for i in range(-shifts, shifts + 1):
            for j in range(-shifts, shifts + 1):
                x, y = centre[0] + j * step, centre[1] + i * step
                away = ((x - odometry[0]) ** 2 + (y - odometry[1]) ** 2) / window[4] ** 2 + turned * turned
                value = totals[t + turns, i + shifts, j + shifts] * unit + height * np.exp(-0.5 * away)
                if value > score:
                    score = value
                    best[0], best[1], best[2] = x, y, centre[2] + t * window[3]
    return best, score


@kernel
def match_scan_on_hits(points, hits, frame, odometry, coarse, fine, prior):  # type: ignore[no-untyped-def]
    """Search the coarse window about the odometry pose (3,), then the fine one about its best; pose and score."""
    best, _ = search_window(points, hits, frame, odometry, odometry, coarse, prior)
    return search_window(points, hits, frame, best, odometry, fine, prior)
