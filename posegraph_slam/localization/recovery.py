"""Finding the pose again: places where the last scans fit, and dead reckoning until one of them is believed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE2, pose_from_xyt, wrap_angle, xyt_from_pose
from posegraph_slam.localization.beam_model import agreement, refine
from posegraph_slam.localization.filter_state import Estimate, FilterState, PreparedMap
from posegraph_slam.localization.global_search import find_places
from posegraph_slam.localization.motion import step_sigmas
from posegraph_slam.localization.particles import around, joined, merged
from posegraph_slam.localization.resampling import normalised, resample
from posegraph_slam.localization.scan_points import ScanPoints
from posegraph_slam.localization.settings import LocalizationSettings
from posegraph_slam.registration.beam_matching import between, compose

SCANS_LOOKED_AT, SCANS_COMPARED = 6, 12
"""Of the last scans, these weigh places; of all that are remembered, these tell the best place from its rivals."""
RIVALS = 12
"""Best places of a search that are compared with the estimate."""
AGREE_LOG_ODDS, CONFLICT_LOG_ODDS = math.log(0.9 / 0.25), math.log(0.1 / 0.75)
"""At right places 90 % of the telling returns agree, at wrong ones a quarter (measured on intel and fr079)."""

RememberedScans = tuple[tuple[FloatArray, ScanPoints], ...]


def recover(
    state: FilterState, known: PreparedMap, settings: LocalizationSettings, rng: np.random.Generator
) -> tuple[FilterState, FloatArray]:
    """Search the map for the last scans together, and put a share of the particles on the places found.

    Each place gets weight by how far the last scans agree with the map there; the places (P, 3) are returned too, best
    first. The last known pose, moved on, is one of them.
    """
    places, _ = find_places(known.stack, recent_points(state, settings), settings.search)
    if state.anchor is not None:
        places = np.concatenate([state.anchor[0][None], places])
    state = replace(state, updates_since_search=0)
    if len(places) == 0:
        return state, places
    looked_at = evenly(state.recent[-settings.search.scans :], SCANS_LOOKED_AT)
    _, fits, _ = fits_at(state, known, places, looked_at, settings)
    log_weights = settings.beam_model.beam_weight * fits
    best = np.argsort(-log_weights, kind="stable")[: settings.search.peaks_max]
    places, weights = places[best], normalised(log_weights[best])
    each = max(int(settings.search.share * settings.number.maximum / settings.search.peaks_max), 10)
    step = known.stack.resolution_m
    sigmas = np.array([step, step, settings.search.angle_step_rad * 2])
    share = settings.search.share if state.next_hypothesis > 1 else 1.0 - 1e-9
    parts = [
        around(place, sigmas, each, state.next_hypothesis + k, rng).with_log_weights(
            np.full(each, np.log(share * weights[k] / each + 1e-300))
        )
        for k, place in enumerate(places)
    ]
    old = state.particles.drawn(
        resample(state.particles.weights, min(len(state.particles), settings.number.maximum), "systematic", rng)
    )
    old = old.with_log_weights(np.full(len(old), np.log((1 - share) / len(old))))
    particles = merged(joined([old, *parts]), settings.search.separation_m, settings.search.separation_rad)
    return replace(state, particles=particles, next_hypothesis=state.next_hypothesis + len(places)), places


def compare(
    state: FilterState, known: PreparedMap, found: Estimate, places: FloatArray, settings: LocalizationSettings
) -> FilterState:
    """Remember how well the best of the places fits all remembered scans, and how much worse than the estimate.

    Scans that follow each other see the same things: a lead over n of them counts by the square root of n, and in full
    over all that can be remembered. Places that a match to the map brings to the estimate are not rivals. Where a plan
    repeats itself the weights of particles say little: they differ by how the map happens to be drawn, and the lighter
    places soon have none.
    """
    compared = evenly(state.recent, SCANS_COMPARED)
    poses, fits, returns = fits_at(
        state, known, np.concatenate([found.pose[None], places[:RIVALS]]), compared, settings
    )
    apart = np.hypot(*(poses[1:, :2] - poses[0, :2]).T) > settings.search.separation_m
    apart |= np.abs(wrap_angle(poses[1:, 2] - poses[0, 2])) > settings.search.separation_rad
    fits = fits / max(returns, 1)
    rival = float(fits[1:][apart].max(initial=-np.inf))
    agreeing = (rival - CONFLICT_LOG_ODDS) / (AGREE_LOG_ODDS - CONFLICT_LOG_ODDS)
    weight = math.sqrt(min(len(state.recent) / settings.health.remembered_scans, 1.0))
    margin = weight * (float(fits[0]) - rival)
    return replace(state, favourite=found.hypothesis, margin=margin, rival_agreement=agreeing)


def evenly(scans: RememberedScans, count: int) -> RememberedScans:
    """Return about `count` of the scans, newest first."""
    return scans[::-1][:: max(len(scans) // count, 1)]


def fits_at(
    state: FilterState, known: PreparedMap, places: FloatArray, scans: RememberedScans, settings: LocalizationSettings
) -> tuple[FloatArray, FloatArray, int]:
    """Match places (P, 3) to the map, and return their poses, their fit in log-odds, and the returns that were used.

    Conflicts tell more than the score of the search: walls seen through, and returns in free space. A place that
    reaches into unknown space scores little, yet does not conflict.
    """
    field, newest = known.field, state.recent[-1][1]
    poses, fits = np.empty_like(places), np.zeros(len(places))
    for k, place in enumerate(places):
        poses[k] = refine(
            newest.points, newest.normals, place, np.eye(3), settings.match.vector(), field.nearest, field.lines,
            field.distance_m, field.geometry.resolution_m,
        )[0]  # fmt: skip
        for odometry, scan in scans:
            agree, conflict = agreement(
                scan.sparse, scan.sensor, compose(poses[k], between(state.odometry, odometry)),
                settings.health.agreement_m, field.kind, field.distance_m, field.geometry.resolution_m,
            )  # fmt: skip
            fits[k] += AGREE_LOG_ODDS * agree + CONFLICT_LOG_ODDS * conflict
    return poses, fits, sum(len(scan.sparse) for _, scan in scans)


def recent_points(state: FilterState, settings: LocalizationSettings) -> FloatArray:
    """Returns of the remembered scans in the robot's present frame, within the search range."""
    parts = []
    for odometry, scan in state.recent[-settings.search.scans :]:
        x, y, theta = between(state.odometry, odometry)
        c, s = np.cos(theta), np.sin(theta)
        parts.append(scan.sparse @ np.array([[c, s], [-s, c]]) + [x, y])
    points = np.concatenate(parts)
    return np.asarray(points[np.hypot(points[:, 0], points[:, 1]) <= settings.search.range_max_m])


def moved_on(
    anchor: tuple[FloatArray, FloatArray], increment: FloatArray, settings: LocalizationSettings
) -> tuple[FloatArray, FloatArray]:
    """Move a pose and its covariance on by an odometry step."""
    sigma = step_sigmas(increment, settings.noise)
    step = pose_from_xyt(increment)
    back = SE2.adjoint(SE2.inverse(step))
    pose = xyt_from_pose(pose_from_xyt(anchor[0]) @ step)
    return pose, back @ anchor[1] @ back.T + np.diag([sigma[0] ** 2, sigma[0] ** 2, sigma[1] ** 2])
