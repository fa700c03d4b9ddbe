"""When things were measured: the lag of the odometry behind the laser, and the time that a scan's sweep takes.

Both are counted in scan intervals, not seconds: loggers stamp in bursts, but the motion from scan to scan is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.geometry import SE2, xyt_from_pose
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.scan_matching import ScanMatchingSettings, match_scans
from posegraph_slam.odometry.sweep import sweep_terms
from posegraph_slam.registration.beam_scans import BeamScans
from posegraph_slam.settings import Settings

BLOCK = 25
"""Neighbouring terms that are taken as one when the spread of an estimate is computed: they share scans."""
NEIGHBOURS = 12
"""A turning scan is compared with one this many scans before or after it, at most."""


class TimingSettings(Settings):
    """How the clocks of laser and odometry are compared."""

    estimate: bool = True
    """Estimate both from the log and correct what is significant."""
    scans: int = Field(default=1000, ge=50)
    """Scans that the estimate looks at: the stretch of this length in which the robot turns most."""
    sigmas_min: float = Field(default=4.0, gt=0)
    """A lag or sweep is corrected when it is this many of its own sigmas from nothing,"""
    share_min: float = Field(default=0.01, ge=0)
    """and at least this share of the scan interval."""
    turn_max_rad: float = Field(default=0.5, gt=0)
    """Steps that turn further are taken for leaps of the odometry, and their scans are left as they are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A share of the scan interval and its standard deviation; NaN where the log does not show it."""

    share: float
    sigma: float

    def significant(self, settings: TimingSettings) -> bool:
        """Whether it is to be corrected."""
        return bool(abs(self.share) >= max(settings.share_min, settings.sigmas_min * self.sigma))


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """`lag` of the odometry behind the scans and duration of a `sweep`, in scan intervals (negative: clockwise)."""

    lag: Estimate
    sweep: Estimate


def estimate_timing(
    scans: BeamScans, odometry: OdometryEstimate, matching: ScanMatchingSettings, settings: TimingSettings
) -> Timing:
    """Compare scans (N), matched one to the next, with their odometry (N), and turning scans with still ones.

    `turning_stretch` says which part of a log serves best.
    """
    poses = match_scans(scans, odometry, matching).trajectory.poses
    lag = Estimate(share=np.nan, sigma=np.nan)
    if odometry.source != "none":
        lag = estimate_lag(poses, odometry.trajectory.poses, settings)
    return Timing(lag=lag, sweep=estimate_sweep(scans, poses, matching, settings))


def estimate_lag(matched: FloatArray, odometry: FloatArray, settings: TimingSettings) -> Estimate:
    """Return by how many scans odometry poses (N, 3, 3) are older than matched poses (N, 3, 3).

    The turn of a step differs from that of the odometry by the lag times the change of the turn, taken as a central
    difference, whose noise is independent of that of the step itself. Robust regression, Gauss-Newton in the lag.
    """
    wanted = _steps(matched)[:, 2]
    lag, sigma = 0.0, np.nan
    for _ in range(4):
        turn = _steps(shifted(odometry, lag))[:, 2]
        change = np.zeros_like(turn)
        change[1:-1] = (turn[2:] - turn[:-2]) / 2
        error = wanted - turn
        usable = (np.abs(turn) < settings.turn_max_rad) & (np.abs(error) < settings.turn_max_rad)
        scale = 1.5 * np.median(np.abs(error[usable])) + 1e-4 if usable.any() else 1.0
        weight = usable / (1 + (error / (3 * scale)) ** 2) ** 2
        information = float(np.sum(weight * change**2))
        if information <= 0:
            return Estimate(share=np.nan, sigma=np.nan)
        step = float(np.sum(weight * change * error)) / information
        sigma = _block_sigma(weight * change * (error - step * change)) / information
        lag = float(np.clip(lag + step, -1.0, 1.0))
    return Estimate(share=lag, sigma=sigma)


def estimate_sweep(
    scans: BeamScans, poses: FloatArray, matching: ScanMatchingSettings, settings: TimingSettings
) -> Estimate:
    """Return the duration of a sweep, in scan intervals, that makes turning scans (N) fit the others best.

    `poses` (N, 3, 3) are those of the base. Each pair of scans is matched point to line; with the duration as a
    fourth unknown beside the pose, the pose is eliminated, and the sum over all pairs is solved for the duration.
    """
    lidar = poses @ scans.T_base_lidar
    motion = sweep_motion(lidar, 1.0, settings)
    source, target = _unlike_pairs(lidar, motion)
    if len(source) == 0:
        return Estimate(share=np.nan, sigma=np.nan)
    terms = sweep_terms(
        source, target, xyt_from_pose(lidar), motion, matching.match.vector(),
        scans.points, scans.lines, scans.kind, scans.thinned, scans.geometry,
    )  # fmt: skip
    information = float(terms[:, 0].sum())
    if information <= 0:
        return Estimate(share=np.nan, sigma=np.nan)
    share = -float(terms[:, 1].sum()) / information
    return Estimate(share=share, sigma=_block_sigma(terms[:, 1] + share * terms[:, 0]) / information)


def sweep_motion(lidar: FloatArray, share: float, settings: TimingSettings) -> FloatArray:
    """Return the motion (N, 3) of the lidar during each sweep: `share` of the mean step to and from its scan.

    `lidar` (N, 3, 3) are its poses at the scans; steps that leap do not count.
    """
    step = _steps(lidar)
    step[np.abs(step[:, 2]) > settings.turn_max_rad] = 0.0
    motion = np.zeros((len(lidar), 3))
    motion[:-1] += 0.5 * step
    motion[1:] += 0.5 * step
    return share * motion


def shifted(poses: FloatArray, share: float) -> FloatArray:
    """Return poses (N, 3, 3) as they were `share` of a step later (earlier where negative); the ends go on."""
    step = _steps(poses)
    if share >= 0:
        return SE2.retract(poses, share * np.concatenate([step, step[-1:]]))
    return SE2.retract(poses, share * np.concatenate([step[:1], step]))


def without_lag(odometry: OdometryEstimate, lag: float) -> OdometryEstimate:
    """Return the odometry at the time of the scans, when it lags behind them by `lag` scan intervals.

    A step then consists of parts of two, and takes the covariance of the less certain one: a leap is in both.
    """
    if lag == 0.0:
        return odometry
    covariance = odometry.covariance
    beside = np.roll(covariance, -1 if lag > 0 else 1, axis=0)
    unsure = np.trace(beside, axis1=1, axis2=2) > np.trace(covariance, axis1=1, axis2=2)
    return replace(
        odometry,
        trajectory=odometry.trajectory.with_poses(shifted(odometry.trajectory.poses, lag)),
        covariance=np.where(unsure[:, None, None], beside, covariance),
    )


def _steps(poses: FloatArray) -> FloatArray:
    return SE2.log(SE2.between(poses[:-1], poses[1:]))


def turning_stretch(odometry: OdometryEstimate, settings: TimingSettings) -> slice:
    """Return the `settings.scans` consecutive scans among which the odometry turns most, leaps not counted."""
    turn = np.abs(_steps(odometry.trajectory.poses)[:, 2])
    turned = np.concatenate([[0.0], np.cumsum(np.where(turn < settings.turn_max_rad, turn, 0.0))])
    count = min(settings.scans, len(turned))
    start = int(np.argmax(turned[count - 1 :] - turned[: len(turned) - count + 1]))
    return slice(start, start + count)


def _unlike_pairs(lidar: FloatArray, motion: FloatArray) -> tuple[IntArray, IntArray]:
    """Pair every scan with the near one whose turn differs most: their sweeps distort them differently."""
    count = len(lidar)
    xyt = xyt_from_pose(lidar)
    at = np.arange(count)
    best, gain = at.copy(), np.zeros(count)
    for offset in (k for k in range(-NEIGHBOURS, NEIGHBOURS + 1) if k):
        other = np.clip(at + offset, 0, count - 1)
        away = np.hypot(*(xyt[other, :2] - xyt[at, :2]).T)
        turned = np.abs((xyt[other, 2] - xyt[at, 2] + np.pi) % (2 * np.pi) - np.pi)
        difference = np.where((away < 0.5) & (turned < 0.7), np.abs(motion[other, 2] - motion[at, 2]), 0.0)
        better = difference > gain
        best[better], gain[better] = other[better], difference[better]
    rows = np.flatnonzero(gain > 0.01)
    return rows, best[rows]


def _block_sigma(terms: FloatArray) -> float:
    """Return the standard deviation of the sum of correlated terms (M,), from the sums over blocks."""
    starts = np.arange(0, len(terms), BLOCK)
    return float(np.sqrt(np.sum(np.add.reduceat(terms, starts) ** 2)))
