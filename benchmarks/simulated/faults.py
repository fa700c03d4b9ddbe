"""What is wrong with a log: drifting, lagging, stalling odometry, and stamps in bursts and out of order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray

from simulated.driving import Drive


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryErrors:
    """Systematic and random errors of dead reckoning, and how it is reported.

    `scale` and `turn_scale` are relative; `turn_rad_per_m` is a constant pull aside (0.0044 is 2.5 degrees in 10 m).
    `lag_s` reports an old pose. `stall_turn_rad` is the turn during which the report stands still before it leaps;
    stalls begin about every `stall_every_s`, where the robot turns. `absent` reports zeros.
    """

    scale: float = 0.04
    turn_scale: float = 0.03
    turn_rad_per_m: float = 0.0044
    sigma_m_per_sqrt_m: float = 0.02
    sigma_rad_per_sqrt_m: float = 0.01
    sigma_rad_per_sqrt_rad: float = 0.02
    lag_s: float = 0.0
    stall_every_s: float = 0.0
    stall_turn_rad: float = 1.25
    absent: bool = False


def odometry(drive: Drive, times_s: FloatArray, errors: OdometryErrors, rng: np.random.Generator) -> FloatArray:
    """Return the poses (N, 3) that the robot's odometry reports at `times_s`; the first is near the origin."""
    if errors.absent:
        return np.zeros((len(times_s), 3))
    reckoned = _dead_reckoning(drive, errors, rng)
    reported = reckoned.at(times_s - errors.lag_s)
    if errors.stall_every_s:
        reported = _stalled(reported, times_s, errors)
    return reported


def _dead_reckoning(drive: Drive, errors: OdometryErrors, rng: np.random.Generator) -> Drive:
    """Integrate the drive's own steps with their errors."""
    step, turn = np.diff(drive.xyt[:, :2], axis=0), np.diff(drive.xyt[:, 2])
    heading = drive.xyt[:-1, 2] + turn / 2
    ahead = np.cos(heading) * step[:, 0] + np.sin(heading) * step[:, 1]
    noise = rng.normal(size=(3, len(turn)))
    distance = np.abs(ahead)
    ahead = ahead * (1 + errors.scale) + errors.sigma_m_per_sqrt_m * np.sqrt(distance) * noise[0]
    turn = turn * (1 + errors.turn_scale) + errors.turn_rad_per_m * distance
    turn = turn + errors.sigma_rad_per_sqrt_m * np.sqrt(distance) * noise[1]
    turn = turn + errors.sigma_rad_per_sqrt_rad * np.sqrt(np.abs(turn)) * noise[2]
    bearing = np.concatenate([[0.0], np.cumsum(turn)])
    middle = bearing[:-1] + turn / 2
    xy = np.cumsum(np.stack([ahead * np.cos(middle), ahead * np.sin(middle)], axis=1), axis=0)
    return Drive(xyt=np.concatenate([np.zeros((1, 3)), np.concatenate([xy, bearing[1:, None]], axis=1)]))


def _stalled(reported: FloatArray, times_s: FloatArray, errors: OdometryErrors) -> FloatArray:
    """Hold the report from where the robot begins to turn until it has turned by `stall_turn_rad`, then let it leap."""
    held = reported.copy()
    rate = np.abs(np.diff(reported[:, 2], append=reported[-1, 2]))
    k, free_from = 0, 0.0
    while k < len(held):
        if times_s[k] >= free_from and rate[k] > 0.05:
            turned = np.abs(reported[k:, 2] - reported[k, 2])
            after = np.flatnonzero(turned >= errors.stall_turn_rad)
            if len(after) and times_s[k + int(after[0])] - times_s[k] < 6.0:
                held[k : k + int(after[0])] = reported[k]
                free_from = times_s[k] + errors.stall_every_s
                k += int(after[0])
        k += 1
    return held


def burst_stamps(times_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return stamps (N,) in bursts of two to six, 1 ms apart; one in twenty comes before its predecessor."""
    stamps, k = times_s.copy(), 0
    while k < len(stamps):
        size = int(rng.integers(2, 7))
        burst = stamps[k : k + size]
        burst[:] = burst[-1] + 0.001 * np.arange(len(burst))
        k += size
    for k in np.flatnonzero(rng.random(len(stamps) - 1) < 0.05):
        stamps[[k, k + 1]] = stamps[[k + 1, k]]
    return stamps


def scans_with_gaps(times_s: FloatArray, drive: Drive, gap_turn_rad: float, every_s: float) -> FloatArray:
    """Leave out the scans while the robot turns by `gap_turn_rad`, about every `every_s` seconds."""
    heading = drive.at(times_s)[:, 2]
    kept, k, free_from = np.ones(len(times_s), dtype=np.bool_), 1, 0.0
    while k < len(times_s):
        if times_s[k] >= free_from and abs(heading[k] - heading[k - 1]) > 0.05:
            after = np.flatnonzero(np.abs(heading[k:] - heading[k - 1]) >= gap_turn_rad)
            if len(after) and times_s[k + int(after[0])] - times_s[k] < 6.0:
                kept[k : k + int(after[0])] = False
                free_from = times_s[k] + every_s
                k += int(after[0])
        k += 1
    return times_s[kept]
