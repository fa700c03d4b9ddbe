"""Localisation in a known map: a particle filter that tracks, finds itself, and knows when it is lost."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.geometry import SE2, Trajectory, pose_from_xyt, wrap_angle, xyt_from_pose
from posegraph_slam.localization.beam_model import add_log_likelihoods, agreement, refine
from posegraph_slam.localization.global_search import SearchStack, build_search_stack, find_places
from posegraph_slam.localization.health import Evidence, Health, HealthState, assess
from posegraph_slam.localization.map_field import MapField, build_map_field
from posegraph_slam.localization.motion import propagate, step_sigmas
from posegraph_slam.localization.particles import Particles, around, hypothesis_weights, joined, merged, moments
from posegraph_slam.localization.resampling import effective_number, needed_number, occupied_bins, resample
from posegraph_slam.localization.scan_points import ScanPoints, scan_points
from posegraph_slam.localization.settings import LocalizationSettings
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.registration.beam_scans import BeamScans

MATCHED_MIN = 8
"""Fewer returns on lines of the map refine nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreparedMap:
    """A map with what the filter looks up in it."""

    field: MapField
    stack: SearchStack


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterState:
    """Everything the filter carries from scan to scan; poses are in the grid frame of the map.

    `anchor` is the last pose that was known, moved on by odometry since, and its covariance; it is what a lost robot
    falls back to. `recent` are the last scans that weighed the particles, each with its odometry pose (3,).
    """

    particles: Particles
    health: HealthState
    odometry: FloatArray
    updated_at: FloatArray | None
    updates_since_search: int
    next_hypothesis: int
    anchor: tuple[FloatArray, FloatArray] | None
    recent: tuple[tuple[FloatArray, ScanPoints], ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Best pose (3,) in the grid frame and its covariance (3, 3) in the tangent [x, y, theta] at the pose."""

    pose: FloatArray
    covariance: FloatArray
    hypothesis: int
    share: float
    sigma_m: float


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


def prepare_map(grid: OccupancyGrid, settings: LocalizationSettings) -> PreparedMap:
    """Compute what the filter looks up in a map."""
    field = build_map_field(grid, settings.beam_model, line_radius_m=settings.line_radius_m)
    return PreparedMap(field=field, stack=build_search_stack(field, settings.search))


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
        state, estimate = update(state, known, points, settings, rng)
        poses[k], covariance[k] = estimate.pose, estimate.covariance
        health[k], agreed[k] = state.health.health, state.health.agreement
        particles[k], share[k] = len(state.particles), estimate.share
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
    increment = _between(state.odometry, odometry)
    if not increment.any():
        return state
    poses = propagate(state.particles.poses, increment, settings.noise, rng)
    anchor = None if state.anchor is None else _moved_on(state.anchor, increment, settings)
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
    if state.health.health is not Health.OK and state.updates_since_search >= settings.search.every:
        state = recover(state, known, settings, rng)
    found = estimate(state, known, scan, settings)
    field = known.field
    agree, conflict = agreement(
        scan.points, scan.sensor, found.pose, settings.health.agreement_m, field.kind, field.distance_m,
        field.geometry.resolution_m,
    )  # fmt: skip
    evidence = Evidence(
        hypothesis=found.hypothesis, share=found.share, sigma_m=found.sigma_m, returns=len(scan.points), agree=agree,
        conflict=conflict,
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


def estimate(state: FilterState, known: PreparedMap, scan: ScanPoints, settings: LocalizationSettings) -> Estimate:
    """Return the refined mean of the heaviest hypothesis; where the pose is not known, with the spread of all."""
    particles, weights = state.particles, state.particles.weights
    numbers, shares = hypothesis_weights(particles, weights)
    best = int(shares.argmax())
    mean, covariance, share = moments(particles.poses, weights, particles.hypothesis == numbers[best])
    sigma_m = float(np.sqrt(covariance[0, 0] + covariance[1, 1]))
    floor = np.diag([settings.covariance_floor_m**2, settings.covariance_floor_m**2, settings.covariance_floor_rad**2])
    prior = np.linalg.inv(covariance + floor)
    field = known.field
    pose, information, matched = refine(
        scan.points, scan.normals, mean, prior, settings.match.vector(), field.nearest, field.lines, field.distance_m,
        field.geometry.resolution_m,
    )  # fmt: skip
    if matched < MATCHED_MIN:
        pose, information = mean, prior
    if state.health.health is Health.OK:
        spread = np.linalg.inv(information)
    else:
        _, everything, _ = moments(particles.poses, weights, np.ones(len(particles), dtype=np.bool_))
        turn = np.eye(3)
        everywhere = moments(particles.poses, weights, np.ones(len(particles), dtype=np.bool_))[0]
        c, s = np.cos(everywhere[2] - pose[2]), np.sin(everywhere[2] - pose[2])
        turn[:2, :2] = [[c, -s], [s, c]]
        offset = _between(pose, everywhere)
        spread = turn @ everything @ turn.T + np.outer(offset, offset)
    return Estimate(
        pose=pose, covariance=spread + floor, hypothesis=int(numbers[best]), share=float(share), sigma_m=sigma_m
    )


def recover(
    state: FilterState, known: PreparedMap, settings: LocalizationSettings, rng: np.random.Generator
) -> FilterState:
    """Search the map for the last scans together, and put a share of the particles on the places found."""
    points = _recent_points(state, settings)
    places, _ = find_places(known.stack, points, settings.search)
    if state.anchor is not None:
        places = np.concatenate([state.anchor[0][None], places])
    state = replace(state, updates_since_search=0)
    if len(places) == 0:
        return state
    field = known.field
    log_weights = np.zeros(len(places))
    kept = np.ascontiguousarray(points[:: -(-len(points) // settings.beam_model.points_max)])
    add_log_likelihoods(
        places, kept, field.log_likelihood, field.outside, field.geometry.resolution_m,
        settings.beam_model.beam_weight, log_weights,
    )  # fmt: skip
    each = max(int(settings.search.share * settings.number.maximum / settings.search.peaks_max), 10)
    step = known.stack.resolution_m
    sigmas = np.array([step, step, settings.search.angle_step_rad * 2])
    weights = np.exp(log_weights - log_weights.max())
    share = settings.search.share if state.next_hypothesis > 1 else 1.0 - 1e-9
    parts = [
        around(place, sigmas, each, state.next_hypothesis + k, rng).with_log_weights(
            np.full(each, np.log(share * weights[k] / weights.sum() / each + 1e-300))
        )
        for k, place in enumerate(places)
    ]
    old = state.particles.drawn(
        resample(state.particles.weights, min(len(state.particles), settings.number.maximum), "systematic", rng)
    )
    old = old.with_log_weights(np.full(len(old), np.log((1 - share) / len(old))))
    particles = merged(joined([old, *parts]), settings.search.separation_m, settings.search.separation_rad)
    return replace(state, particles=particles, next_hypothesis=state.next_hypothesis + len(places))


def _moved_on(
    anchor: tuple[FloatArray, FloatArray], increment: FloatArray, settings: LocalizationSettings
) -> tuple[FloatArray, FloatArray]:
    """Move a pose and its covariance on by an odometry step."""
    sigma = step_sigmas(increment, settings.noise)
    step = pose_from_xyt(increment)
    back = SE2.adjoint(SE2.inverse(step))
    pose = xyt_from_pose(pose_from_xyt(anchor[0]) @ step)
    return pose, back @ anchor[1] @ back.T + np.diag([sigma[0] ** 2, sigma[0] ** 2, sigma[1] ** 2])


def _due(state: FilterState, settings: LocalizationSettings) -> bool:
    if state.updated_at is None:
        return True
    moved = _between(state.updated_at, state.odometry)
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
    return replace(state, recent=(*state.recent, (state.odometry, scan))[-settings.search.scans :])


def _recent_points(state: FilterState, settings: LocalizationSettings) -> FloatArray:
    """Returns of the remembered scans in the robot's present frame, within the search range."""
    parts = []
    for odometry, scan in state.recent:
        x, y, theta = _between(state.odometry, odometry)
        c, s = np.cos(theta), np.sin(theta)
        parts.append(scan.sparse @ np.array([[c, s], [-s, c]]) + [x, y])
    points = np.concatenate(parts)
    return np.asarray(points[np.hypot(points[:, 0], points[:, 1]) <= settings.search.range_max_m])


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


def _between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the motion a^-1 b (3,) of planar poses."""
    c, s = np.cos(a[2]), np.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return np.array([c * dx + s * dy, -s * dx + c * dy, float(wrap_angle(b[2] - a[2]))])
