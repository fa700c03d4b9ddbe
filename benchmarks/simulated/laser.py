"""What a SICK-like scanner on the robot measures: glass, people, the sweep of the mirror, noise and centimetres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray, IntArray
from posegraph_slam.datasets.simulation.raycast import cast_fan
from posegraph_slam.jit import kernel

from simulated.driving import Drive
from simulated.floors import Floor

SCANS_A_CHUNK = 512
SECTORS = 18
"""Pieces of a scan with a pose of their own when the mirror takes time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scanner:
    """Beams over half a turn, their errors, and the mounting [x, y, turn] on the robot.

    `half_step` puts B beams at steps of 180/B degrees from -90 (180, 360); else of 180/(B-1) (181, 361).
    `sweep_s` is the time from the first beam to the last one.
    """

    beams: int = 180
    range_max_m: float = 80.0
    no_return_m: float = 81.83
    sigma_m: float = 0.015
    resolution_m: float = 0.01
    lost: float = 0.002
    mixed: float = 0.15
    sweep_s: float = 0.0
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def increment_rad(self) -> float:
        """Angle between two beams."""
        return float(np.pi / (self.beams - self.beams % 2))


@kernel
def _cast(
    poses: FloatArray, fan: FloatArray, reach: float, beams: int, segments: FloatArray, circles: FloatArray,
    movers: FloatArray,
) -> tuple[FloatArray, IntArray]:  # fmt: skip
    """Cast scans from `poses` (N, K, 3) among walls, pillars and the movers (N, M, 3) of each scan; K sectors a scan.

    Returns ranges (N, beams), infinite beyond `reach`, and the segment that was hit, -1 for anything else.
    """
    scans, sectors = poses.shape[0], poses.shape[1]
    ranges = np.empty((scans, beams))
    hits = np.empty((scans, beams), dtype=np.int64)
    near = np.empty(len(segments), dtype=np.int64)
    middle_x, middle_y = (segments[:, 0] + segments[:, 2]) / 2, (segments[:, 1] + segments[:, 3]) / 2
    half = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]) / 2
    for n in range(scans):
        count = 0
        for s in range(len(segments)):
            if np.hypot(middle_x[s] - poses[n, 0, 0], middle_y[s] - poses[n, 0, 1]) < reach + half[s] + 1.0:
                near[count] = s
                count += 1
        obstacles = segments[near[:count]]
        rounds = np.concatenate((circles, movers[n]))
        for k in range(sectors):
            first, last = k * beams // sectors, (k + 1) * beams // sectors
            start = poses[n, k, 2] + fan[0] + first * fan[1]
            cast_fan(
                poses[n, k, 0], poses[n, k, 1], start, fan[1], obstacles, rounds, ranges[n, first:last],
                hits[n, first:last],
            )  # fmt: skip
        for b in range(beams):
            if ranges[n, b] > reach:
                ranges[n, b], hits[n, b] = np.inf, -1
            hits[n, b] = near[hits[n, b]] if 0 <= hits[n, b] < count else -1
    return ranges, hits


def scan(
    drive: Drive, times_s: FloatArray, floor: Floor, people: FloatArray, scanner: Scanner, rng: np.random.Generator
) -> Float32Array:
    """Measure the scans (N, beams) at `times_s` with the people (N, P, 3) [x, y, radius] of each of them."""
    ranges = np.empty((len(times_s), scanner.beams), dtype=np.float32)
    segments = np.concatenate([floor.glass, floor.walls])
    fan = np.array([-np.pi / 2, scanner.increment_rad])
    sectors = SECTORS if scanner.sweep_s > 0 else 1
    offsets = scanner.sweep_s * (np.arange(sectors) + 0.5) / sectors
    for start in range(0, len(times_s), SCANS_A_CHUNK):
        part = slice(start, start + SCANS_A_CHUNK)
        poses = mounted(drive.at(times_s[part, None] + offsets), scanner.mounting)
        world = (floor.pillars, people[part])
        exact, hit = _cast(poses, fan, scanner.range_max_m, scanner.beams, segments, *world)
        if len(floor.glass):
            behind, _ = _cast(poses, fan, scanner.range_max_m, scanner.beams, floor.walls, *world)
            exact = np.where(_passes(poses, fan, hit, floor.glass, rng), behind, exact)
        ranges[part] = _measure(exact, scanner, rng)
    return ranges


def mounted(base: FloatArray, mounting: tuple[float, float, float]) -> FloatArray:
    """Return poses (..., 3) of the scanner from those of the base."""
    x, y, turn = mounting
    c, s = np.cos(base[..., 2]), np.sin(base[..., 2])
    return np.stack([base[..., 0] + c * x - s * y, base[..., 1] + s * x + c * y, base[..., 2] + turn], axis=-1)


def _passes(
    poses: FloatArray, fan: FloatArray, hit: IntArray, glass: FloatArray, rng: np.random.Generator
) -> np.ndarray:
    """Draw which beams (N, B) go through the pane that they meet: few at right angles, most at a slant."""
    bearing = poses[:, 0, 2][:, None] + fan[0] + fan[1] * np.arange(hit.shape[1])
    along = np.arctan2(glass[:, 3] - glass[:, 1], glass[:, 2] - glass[:, 0])
    pane = (hit >= 0) & (hit < len(glass))
    straight = np.abs(np.sin(bearing - along[np.where(pane, hit, 0)]))
    reflected = np.where(straight > np.cos(np.deg2rad(12)), 0.9, 0.12)
    return np.asarray(pane & (rng.random(hit.shape) > reflected))


def _measure(exact: FloatArray, scanner: Scanner, rng: np.random.Generator) -> FloatArray:
    """Disturb exact ranges (N, B): mixed pixels at edges, noise, whole centimetres, lost beams."""
    values = exact.copy()
    # one neighbour or the other, or edges on one side of the robot would be smeared more than those on the other
    beam = np.arange(exact.shape[1])
    other = np.clip(beam + rng.choice(np.array([-1, 1]), size=exact.shape), 0, len(beam) - 1)
    beside = np.take_along_axis(exact, other, axis=1)
    both = np.isfinite(exact) & np.isfinite(beside)
    step = np.abs(np.where(both, exact, 0.0) - np.where(both, beside, 0.0))
    edge = (step > 0.3) & (rng.random(exact.shape) < scanner.mixed)
    blend = rng.random(exact.shape)
    values[edge] = (blend * exact + (1 - blend) * beside)[edge]
    values += scanner.sigma_m * rng.standard_normal(exact.shape)
    values = np.round(values / scanner.resolution_m) * scanner.resolution_m
    values[~(values < scanner.range_max_m) | (rng.random(exact.shape) < scanner.lost)] = scanner.no_return_m
    return np.maximum(values, 0.0)


def people_walking(
    count: int, times_s: FloatArray, bounds: tuple[float, float, float, float], rng: np.random.Generator
) -> FloatArray:
    """Return the legs (N, 2 count, 3) of people who walk straight through `bounds`, turn at its border, and pause."""
    lower, upper = np.array(bounds[:2]), np.array(bounds[2:])
    start, speed = rng.uniform(lower, upper, size=(count, 2)), rng.normal(scale=0.7, size=(count, 2))
    speed[rng.random(count) < 0.3] = 0.0
    way = start + times_s[:, None, None] * speed
    span = upper - lower
    folded = lower + np.abs((way - lower + span) % (2 * span) - span)
    aside = np.array([0.12, 0.05])
    legs = np.concatenate([folded - aside, folded + aside], axis=1)
    return np.concatenate([legs, np.full((*legs.shape[:2], 1), 0.08)], axis=2)
