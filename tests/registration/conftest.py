"""Rays cast into rooms of straight walls, for the tests of matching."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from posegraph_slam.arrays import FloatArray


def box(x0: float, y0: float, x1: float, y1: float) -> FloatArray:
    """Four walls (4, 2, 2) from corner to corner."""
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


ROOM = np.concatenate([box(-4, -3, 5, 2.5), box(1, 1, 2, 1.6), box(-2, -2, -1.2, -1.5), box(3, -2, 3.4, -1.2)])
"""A room of 9 by 5.5 m with three boxes in it."""

CORRIDOR = np.array([[[-100.0, -1.0], [100.0, -1.0]], [[-100.0, 1.2], [100.0, 1.2]]])
"""Two walls along x that end out of sight."""


def scan(
    pose: FloatArray, walls: FloatArray, beams: int, sigma_m: float, rng: np.random.Generator, reach_m: float = 30.0
) -> FloatArray:
    """Points (n, 2) that a scanner of 270 degrees at `pose` (3, 3) sees of `walls` (w, 2, 2), in its own frame."""
    angles = np.radians(np.linspace(-135, 135, beams))
    heading = angles + np.arctan2(pose[1, 0], pose[0, 0])
    ray = np.stack([np.cos(heading), np.sin(heading)], axis=1)[:, None]
    start, along = walls[None, :, 0] - pose[:2, 2], walls[None, :, 1] - walls[None, :, 0]

    def cross(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])

    slant = cross(ray, along)
    slant = np.where(np.abs(slant) < 1e-12, 1e-12, slant)
    distance, share = cross(start, along) / slant, cross(start, ray) / slant
    hit = (share >= 0) & (share <= 1) & (distance > 1e-6)
    ranges = np.where(hit, distance, np.inf).min(axis=1)
    seen = ranges < reach_m
    ranges = ranges[seen] + rng.normal(0, sigma_m, int(seen.sum()))
    return np.stack([ranges * np.cos(angles[seen]), ranges * np.sin(angles[seen])], axis=1)


@pytest.fixture(scope="session")
def simulated() -> SimpleNamespace:
    """Return the walls `room` and `corridor` and the function `scan`."""
    return SimpleNamespace(room=ROOM, corridor=CORRIDOR, scan=scan)
