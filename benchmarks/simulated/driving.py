"""Where the robot is when: a route on a net of corridors, followed by a robot that turns on the spot at corners."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel

STEP_S = 0.02
STEP_M = 0.1
CARROT_M = 0.7
"""The robot heads for the point of the route this far away."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """Poses (T, 3) [x, y, heading], heading unwrapped, every `STEP_S` seconds from 0."""

    xyt: FloatArray

    @property
    def end_s(self) -> float:
        """Time of the last pose."""
        return (len(self.xyt) - 1) * STEP_S

    def at(self, times_s: FloatArray) -> FloatArray:
        """Poses (..., 3) at times within the drive; it stands still before and after."""
        clock = np.arange(len(self.xyt)) * STEP_S
        return np.stack([np.interp(times_s, clock, column) for column in self.xyt.T], axis=-1)


@kernel
def _follow(route: FloatArray, heading: float, speed: float, yaw_rate: float, limit: int) -> FloatArray:
    """Drive to the carrot on `route` (R, 2): slower the more it lies aside, on the spot when it lies behind."""
    poses = np.zeros((limit, 3))
    x, y, v, w, carrot = route[0, 0], route[0, 1], 0.0, 0.0, 0
    for k in range(limit):
        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, heading
        while carrot < len(route) - 1 and np.hypot(route[carrot, 0] - x, route[carrot, 1] - y) < CARROT_M:
            carrot += 1
        dx, dy = route[carrot, 0] - x, route[carrot, 1] - y
        if carrot == len(route) - 1 and np.hypot(dx, dy) < CARROT_M:
            return poses[: k + 1]
        aside = (np.arctan2(dy, dx) - heading + np.pi) % (2 * np.pi) - np.pi
        turn = min(max(2.0 * aside, -yaw_rate), yaw_rate)
        go = speed * max(np.cos(aside), 0.0) ** 4
        v += min(max(go - v, -1.0 * STEP_S), 0.5 * STEP_S)
        w += min(max(turn - w, -3.0 * STEP_S), 3.0 * STEP_S)
        x += v * STEP_S * np.cos(heading + 0.5 * w * STEP_S)
        y += v * STEP_S * np.sin(heading + 0.5 * w * STEP_S)
        heading += w * STEP_S
    return poses


def drive_route(
    corners: FloatArray, rng: np.random.Generator, *, speed_m_s: float = 0.5, yaw_rate_rad_s: float = 0.7,
    wander_m: float = 0.12,
) -> Drive:  # fmt: skip
    """Drive along a polyline (n, 2), wandering about it; two seconds of standing still come first."""
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(0.0, travelled[-1], STEP_M)
    route = np.stack([np.interp(at, travelled, corners[:, k]) for k in range(2)], axis=1)
    noise = gaussian_filter1d(rng.normal(size=route.shape), 1.5 / STEP_M, axis=0, mode="nearest")
    route = route + np.clip(noise * wander_m / max(float(noise.std()), 1e-9), -3 * wander_m, 3 * wander_m)
    first = route[5] - route[0]
    limit = int(travelled[-1] / speed_m_s / STEP_S * 4 + 60 * len(corners) / STEP_S)
    poses = _follow(route, float(np.arctan2(first[1], first[0])), speed_m_s, yaw_rate_rad_s, limit)
    return Drive(xyt=np.concatenate([np.repeat(poses[:1], round(2 / STEP_S), axis=0), poses]))


def with_spins(drive: Drive, times_s: FloatArray, *, yaw_rate_rad_s: float = 1.2) -> Drive:
    """Let the robot turn once round on the spot at each of `times_s` before it drives on."""
    around = np.append(np.arange(0.0, 2 * np.pi, yaw_rate_rad_s * STEP_S), 2 * np.pi)
    pieces, start, turns = [], 0, 0.0
    for stop in np.sort(np.round(times_s / STEP_S).astype(np.int64)).tolist():
        pieces.append(drive.xyt[start:stop] + np.array([0.0, 0.0, turns]))
        pieces.append(drive.xyt[stop] + np.stack([0 * around, 0 * around, turns + around], axis=1))
        start, turns = stop, turns + 2 * np.pi
    pieces.append(drive.xyt[start:] + np.array([0.0, 0.0, turns]))
    return Drive(xyt=np.concatenate(pieces))


def round_and_about(
    x: tuple[float, ...], y: tuple[float, ...], length_m: float, rng: np.random.Generator
) -> FloatArray:
    """Return corners (n, 2) of a route on the net of lines x and y: once around it, then where it was least, then home.

    The outer loop comes first, so that the drift of its whole length has come together when it closes. The robot
    turns back nowhere.
    """
    across, up = len(x) - 1, len(y) - 1
    ring = [(i, 0) for i in range(across)] + [(across, j) for j in range(up)]
    ring += [(i, up) for i in range(across, 0, -1)] + [(0, j) for j in range(up, 0, -1)]
    nodes, used = [*ring, (0, 0)], dict[frozenset[tuple[int, int]], float]()

    def length(a: tuple[int, int], b: tuple[int, int]) -> float:
        return abs(x[a[0]] - x[b[0]]) + abs(y[a[1]] - y[b[1]])

    travelled = sum(length(a, b) for a, b in pairwise(nodes))
    for a, b in pairwise(nodes):
        used[frozenset((a, b))] = 1.0
    while travelled < length_m:
        i, j = nodes[-1]
        onward = [n for n in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1))
                  if 0 <= n[0] <= across and 0 <= n[1] <= up and n != nodes[-2]]  # fmt: skip
        cost = [used.get(frozenset(((i, j), n)), 0.0) + 0.1 * rng.random() for n in onward]
        chosen = onward[int(np.argmin(cost))]
        used[frozenset(((i, j), chosen))] = used.get(frozenset(((i, j), chosen)), 0.0) + 1.0
        travelled += length((i, j), chosen)
        nodes.append(chosen)
    return np.array([(x[i], y[j]) for i, j in nodes])
