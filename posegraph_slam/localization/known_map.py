"""Localisation in a known map: a particle filter that tracks, finds itself, and knows when it is lost."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.geometry import SE2, Trajectory, pose_from_xyt, xyt_from_pose
from posegraph_slam.localization.beam_model import add_log_likelihoods, agreement
from posegraph_slam.localization.estimation import estimate
from posegraph_slam.localization.filter_state import Estimate, FilterState, PreparedMap, prepare_map
from posegraph_slam.localization.health import Evidence, Health, HealthState, assess
from posegraph_slam.localization.motion import propagate
from posegraph_slam.localization.particles import Particles, around, joined, merged
from posegraph_slam.localization.recovery import compare, moved_on, recover
from posegraph_slam.localization.resampling import effective_number, needed_number, occupied_bins, resample
from posegraph_slam.localization.scan_points import ScanPoints, scan_points
from posegraph_slam.localization.settings import LocalizationSettings
from posegraph_slam.registration.beam_matching import between
from posegraph_slam.registration.beam_scans import BeamScans

__all__ = ["LocalizationResult", "PreparedMap", "initial_state", "localize", "predict", "prepare_map", "update"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalizationResult:
    """T_map_base at every scan (N, 3, 3), covariance (N, 3, 3) in the tangent of its right update, and health (N,).

    `agreement` (N,) is the mean share of returns that agree with the map, `particles` (N,) their number, `share` (N,)
    the weight of the best hypothesis.
    """

    trajectory: Trajectory
    covariance: FloatArray
    health: IntArray
    agreement: FloatArray
    particles: IntArray
    share: FloatArray

    def __post_init__(self) -> None:
        for name in ("covariance", "agreement", "share"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        for name in ("health", "particles"):
            object.__setattr__(self, name, read_only(getattr(self, name), np.int64))


def localize(
    known: PreparedMap,
    scans: BeamScans,
    odometry: Trajectory,
    settings: LocalizationSettings,
    *,
    rng: np.random.Generator,
    start: FloatArray | None = None,
    progress: Progress = silent_progress,
) -> LocalizationResult:
    """Localise every scan (N) in a known map, from odometry poses (N, 3, 3) and a start (3,) [x, y, theta] or none.

    With a start, its pose of the first scan in the map, the robot is tracked from there; without one the whole map is
    searched. The result depends on the inputs and the generator alone.
    """
    if len(scans) != len(odometry) or len(scans) == 0:
        raise InputError("odometry", f"{len(odometry)} poses do not fit {len(scans)} scans", "give one pose a scan")
    path = xyt_from_pose(odometry.poses)
    state = initial_state(known, path[0], settings, rng=rng, start=start)
    count = len(scans)
    poses, covariance = np.zeros((count, 3)), np.zeros((count, 3, 3))
    health, particles = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    agreed, share = np.zeros(count), np.zeros(count)
    for k in range(count):
        points = scan_points(scans, k, settings.beam_model.points_max)
        state = predict(state, path[k], settings, rng)
        state, found = update(state, known, points, settings, rng)
        poses[k], covariance[k] = found.pose, found.covariance
        health[k], agreed[k] = state.health.health, state.health.agreement
        particles[k], share[k] = len(state.particles), found.share
        if k % 200 == 0:
            progress("localisation", k, count)
    progress("localisation", count, count)
    trajectory = Trajectory(
        stamps_s=odometry.stamps_s, poses=pose_from_xyt(known.field.from_grid(poses)), parent="map", child="base"
    )
    return LocalizationResult(
        trajectory=trajectory,
        covariance=covariance,
        health=health,
        agreement=agreed,
        particles=particles,
        share=share,
    )


def initial_state(
    known: PreparedMap,
    odometry: FloatArray,
    settings: LocalizationSettings,
    *,
    rng: np.random.Generator,
    start: FloatArray | None,
) -> FilterState:
    """Return particles about `start` (map frame), or none yet: the first scan then searches the map."""
    sigmas = np.array([settings.start_sigma_m, settings.start_sigma_m, settings.start_sigma_rad])
    health = HealthState(health=Health.LOST if start is None else Health.OK)
    pose = np.zeros(3) if start is None else known.field.to_grid(start)
    number = settings.number.minimum if start is None else settings.number.maximum
    return FilterState(
        particles=around(pose, sigmas, number, 0, rng),
        health=health,
        odometry=np.asarray(odometry),
        updated_at=None,
        updates_since_search=settings.search.every if start is None else 0,
        next_hypothesis=1,
        anchor=None if start is None else (pose, np.diag(sigmas**2)),
        recent=(),
    )


def predict(
    state: FilterState, odometry: FloatArray, settings: LocalizationSettings, rng: np.random.Generator
) -> FilterState:
    """Move the particles by the robot's motion to the odometry pose (3,)."""
    increment = between(state.odometry, odometry)
    if not increment.any():
        return state
    poses = propagate(state.particles.poses, increment, settings.noise, rng)
    anchor = None if state.anchor is None else moved_on(state.anchor, increment, settings)
    return replace(state, particles=state.particles.with_poses(poses), odometry=np.asarray(odometry), anchor=anchor)


def update(
    state: FilterState,
    known: PreparedMap,
    scan: ScanPoints,
    settings: LocalizationSettings,
    rng: np.random.Generator,
) -> tuple[FilterState, Estimate]:
    """Weigh the particles by a scan once the robot has moved enough, draw anew where due, and estimate the pose.

    The estimate is made at every scan: the mean of the best hypothesis, refined against the lines of the map.
    """
    if not _due(state, settings) or len(scan.points) == 0:
        return _reported(state, estimate(state, known, scan, settings))
    state = _weighed(state, known, scan, settings)
    state = _remember(state, scan, settings)
    searched = state.health.health is not Health.OK and state.updates_since_search >= settings.search.every
    if searched:
        state, places = recover(state, known, settings, rng)
    found = estimate(state, known, scan, settings)
    if searched:
        state = compare(state, known, found, places, settings)
    field = known.field
    agree, conflict = agreement(
        scan.points, scan.sensor, found.pose, settings.health.agreement_m, field.kind, field.distance_m,
        field.geometry.resolution_m,
    )  # fmt: skip
    evidence = Evidence(
        hypothesis=found.hypothesis, share=found.share, sigma_m=found.sigma_m, returns=len(scan.points), agree=agree,
        conflict=conflict, margin=state.margin if found.hypothesis == state.favourite else -math.inf,
        rival_agreement=state.rival_agreement,
    )  # fmt: skip
    health = assess(state.health, evidence, settings.health)
    newly_lost = state.health.health is Health.OK and health.health is not Health.OK
    state = replace(
        state,
        health=health,
        # After a kidnapping only the last scans are from the new place.
        recent=state.recent[-3:] if newly_lost else state.recent,
        updates_since_search=settings.search.every if newly_lost else state.updates_since_search + 1,
    )
    return _reported(_resampled(state, found, settings, rng), found)


def _reported(state: FilterState, found: Estimate) -> tuple[FilterState, Estimate]:
    """Keep a known pose as the anchor; while none is known, report the anchor if there ever was one."""
    if state.health.health is Health.OK:
        return replace(state, anchor=(found.pose, found.covariance)), found
    if state.anchor is None:
        return state, found
    return state, replace(found, pose=state.anchor[0], covariance=state.anchor[1])


def _due(state: FilterState, settings: LocalizationSettings) -> bool:
    if state.updated_at is None:
        return True
    moved = between(state.updated_at, state.odometry)
    return bool(np.hypot(moved[0], moved[1]) >= settings.update_distance_m or abs(moved[2]) >= settings.update_turn_rad)


def _weighed(state: FilterState, known: PreparedMap, scan: ScanPoints, settings: LocalizationSettings) -> FilterState:
    log_weights = state.particles.log_weights.copy()
    add_log_likelihoods(
        state.particles.poses, scan.sparse, known.field.log_likelihood, known.field.outside,
        known.field.geometry.resolution_m, settings.beam_model.beam_weight, log_weights,
    )  # fmt: skip
    log_weights -= log_weights.max()
    particles = merged(
        state.particles.with_log_weights(log_weights), settings.search.separation_m / 2, settings.search.separation_rad
    )
    return replace(state, particles=particles, updated_at=state.odometry)


def _remember(state: FilterState, scan: ScanPoints, settings: LocalizationSettings) -> FilterState:
    kept = max(settings.health.remembered_scans, settings.search.scans)
    return replace(state, recent=(*state.recent, (state.odometry, scan))[-kept:])


def _resampled(
    state: FilterState, found: Estimate, settings: LocalizationSettings, rng: np.random.Generator
) -> FilterState:
    """Draw anew when the effective number is low; a share comes from the refined mean where the pose is known."""
    weights = state.particles.weights
    if effective_number(weights) >= settings.resampling.effective_share * len(weights):
        return state
    scheme, limits = settings.resampling.scheme, settings.number
    trial = state.particles.poses[resample(weights, limits.maximum, "systematic", rng)]
    number = needed_number(occupied_bins(trial, limits.bin_m, limits.bin_rad), limits)
    fresh = int(settings.refined_share * number) if state.health.health is Health.OK else 0
    particles = state.particles.drawn(resample(weights, number - fresh, scheme, rng))
    if fresh:
        body = rng.standard_normal((fresh, 3)) @ np.linalg.cholesky(found.covariance).T
        poses = xyt_from_pose(pose_from_xyt(found.pose) @ SE2.exp(body))
        particles = joined(
            [
                particles,
                Particles(poses=poses, log_weights=np.zeros(fresh), hypothesis=np.full(fresh, found.hypothesis)),
            ]
        )
    return replace(state, particles=particles)
