"""The pose that particles stand for: the mean of the best hypothesis, refined against the lines of the map."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.localization.beam_model import refine
from posegraph_slam.localization.filter_state import Estimate, FilterState, PreparedMap
from posegraph_slam.localization.health import Health
from posegraph_slam.localization.particles import hypothesis_weights, moments
from posegraph_slam.localization.scan_points import ScanPoints
from posegraph_slam.localization.settings import LocalizationSettings
from posegraph_slam.registration.beam_matching import between

MATCHED_MIN = 8
"""Fewer returns on lines of the map refine nothing."""


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
        spread = spread_about(pose, *moments(particles.poses, weights, np.ones(len(particles), dtype=np.bool_))[:2])
    return Estimate(
        pose=pose, covariance=spread + floor, hypothesis=int(numbers[best]), share=float(share), sigma_m=sigma_m
    )


def spread_about(pose: FloatArray, mean: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the second moment (3, 3) about `pose`, in its own frame, of particles with this mean and covariance."""
    offset = between(pose, mean)
    turn = np.eye(3)
    c, s = np.cos(offset[2]), np.sin(offset[2])
    turn[:2, :2] = [[c, -s], [s, c]]
    return np.asarray(turn @ covariance @ turn.T + np.outer(offset, offset))
