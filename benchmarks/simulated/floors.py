"""Floor plans in plan view: walls around free rectangles, corridors with door niches, and an exhibition hall."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from posegraph_slam.arrays import FloatArray

Rectangle = tuple[float, float, float, float]
"""x and y of the lower left, x and y of the upper right corner, metres."""
NICHE_WIDTH_M, NICHE_DEPTH_M = 1.0, 0.15


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Floor:
    """Walls (S, 4) [xa, ya, xb, yb], pillars (C, 3) [x, y, radius] and panes of glass (G, 4), metres."""

    walls: FloatArray
    pillars: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    glass: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))


@dataclass(frozen=True, slots=True, kw_only=True)
class CorridorNet:
    """Centre lines of corridors that cross each other, their width, and the spacing of the door niches along them."""

    x: tuple[float, ...]
    y: tuple[float, ...]
    width_m: float = 2.2
    niche_every_m: float = 3.0

    def rectangles(self) -> list[Rectangle]:
        """Return the free space: a rectangle a corridor, and one through both walls of it a pair of niches."""
        half, deep = self.width_m / 2, self.width_m / 2 + NICHE_DEPTH_M
        across = [(self.x[0] - half, y - half, self.x[-1] + half, y + half) for y in self.y]
        upward = [(x - half, self.y[0] - half, x + half, self.y[-1] + half) for x in self.x]
        for start, stop in zip(self.x[:-1], self.x[1:], strict=True):
            for at in self._niches(start, stop):
                across += [(at, y - deep, at + NICHE_WIDTH_M, y + deep) for y in self.y]
        for start, stop in zip(self.y[:-1], self.y[1:], strict=True):
            for at in self._niches(start, stop):
                upward += [(x - deep, at, x + deep, at + NICHE_WIDTH_M) for x in self.x]
        return across + upward

    def _niches(self, start: float, stop: float) -> list[float]:
        first, last = start + self.width_m / 2 + 1.0, stop - self.width_m / 2 - 1.0 - NICHE_WIDTH_M
        return [] if last <= first else [float(at) for at in np.arange(first, last, self.niche_every_m)]


def walls_around(rectangles: list[Rectangle]) -> FloatArray:
    """Return the boundary (S, 4) of the union of axis-parallel free rectangles.

    The plane is cut along all their sides; an edge between a free cell and one that is not is a piece of wall, and
    pieces in a row are joined.
    """
    corners = np.array(rectangles)
    x, y = np.unique(corners[:, [0, 2]]), np.unique(corners[:, [1, 3]])
    free = np.zeros((len(y) + 1, len(x) + 1), dtype=np.bool_)
    columns, rows = np.searchsorted(x, corners[:, [0, 2]]), np.searchsorted(y, corners[:, [1, 3]])
    for (left, right), (bottom, top) in zip(columns.tolist(), rows.tolist(), strict=True):
        free[bottom + 1 : top + 1, left + 1 : right + 1] = True
    lying = [(x[a], y[k], x[b], y[k]) for k, a, b in _runs(free[:-1] != free[1:])]
    standing = [(x[k], y[a], x[k], y[b]) for k, a, b in _runs((free[:, :-1] != free[:, 1:]).T)]
    return np.array(lying + standing)


def _runs(edges: np.ndarray) -> list[tuple[int, int, int]]:
    """Return row, first and last line of every run of edges; column c of `edges` lies between lines c-1 and c."""
    found = []
    for k in range(len(edges)):
        change = np.diff(np.concatenate([[0], edges[k].astype(np.int8), [0]]))
        starts, stops = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
        found += [(k, int(a) - 1, int(b) - 1) for a, b in zip(starts, stops, strict=True)]
    return found


def corridor_floor(*nets: CorridorNet, joined: tuple[Rectangle, ...] = ()) -> Floor:
    """Return the floor of one or more nets of corridors and the rectangles that join them."""
    return Floor(walls=walls_around([piece for net in nets for piece in net.rectangles()] + list(joined)))


def exhibition_hall(width_m: float, depth_m: float, rng: np.random.Generator) -> Floor:
    """Return a hall with pillars every 10 m, booths of three walls between them, and glass on its two long sides.

    Behind the glass lies a wall 4 m away. The lanes x, y = 5, 15, 25, ... m stay free.
    """
    pillars, booths = [], []
    for x in np.arange(10.0, width_m - 4, 10.0):
        for y in np.arange(10.0, depth_m - 4, 10.0):
            pillars.append((x, y, 0.3))
            for dx, dy in ((-2.4, 0.0), (2.4, 0.0)):
                if rng.random() < 0.75:
                    booths.append(_booth(x + dx, y + dy, rng))
    sides = np.array([(0, 0, 0, depth_m), (width_m, 0, width_m, depth_m)], dtype=np.float64)
    outside = np.array([(0, -4, width_m, -4), (0, depth_m + 4, width_m, depth_m + 4)], dtype=np.float64)
    posts = np.array([(x, y, 0.06) for y in (0.0, depth_m) for x in np.arange(0.0, width_m + 0.1, 4.0)])
    panes = np.array([(0, 0, width_m, 0), (0, depth_m, width_m, depth_m)], dtype=np.float64)
    return Floor(
        walls=np.concatenate([sides, outside, *booths]),
        pillars=np.concatenate([np.array(pillars), posts]),
        glass=panes,
    )


def _booth(x: float, y: float, rng: np.random.Generator) -> FloatArray:
    """Three walls (3, 4) of a booth about (x, y), open to a drawn side."""
    a, b = rng.uniform(1.2, 1.9), rng.uniform(1.2, 3.0)
    corner = np.array([(x - a, y - b), (x + a, y - b), (x + a, y + b), (x - a, y + b)])
    sides = np.concatenate([corner, np.roll(corner, -1, axis=0)], axis=1)
    return np.delete(sides, int(rng.integers(4)), axis=0)
