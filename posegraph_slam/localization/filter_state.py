"""What the filter in a known map carries from scan to scan, and what it looks up."""

from __future__ import annotations

import math
from dataclasses import dataclass

from posegraph_slam.arrays import FloatArray
from posegraph_slam.localization.global_search import SearchStack, build_search_stack
from posegraph_slam.localization.health import HealthState
from posegraph_slam.localization.map_field import MapField, build_map_field
from posegraph_slam.localization.particles import Particles
from posegraph_slam.localization.scan_points import ScanPoints
from posegraph_slam.localization.settings import LocalizationSettings
from posegraph_slam.mapping.occupancy import OccupancyGrid


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreparedMap:
    """A map with what the filter looks up in it."""

    field: MapField
    stack: SearchStack


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterState:
    """Everything the filter carries from scan to scan; poses are in the grid frame of the map.

    `anchor` is the last pose that was known, moved on by odometry since, and its covariance; it is what a lost robot
    falls back to. `recent` are the last scans that weighed the particles, each with its odometry pose (3,). At the
    last search every other place fitted worse than hypothesis `favourite`, by `margin` in log-odds a return, and the
    best of them like one where the share `rival_agreement` of all returns agrees and the others conflict.
    """

    particles: Particles
    health: HealthState
    odometry: FloatArray
    updated_at: FloatArray | None
    updates_since_search: int
    next_hypothesis: int
    anchor: tuple[FloatArray, FloatArray] | None
    recent: tuple[tuple[FloatArray, ScanPoints], ...]
    favourite: int = -1
    margin: float = -math.inf
    rival_agreement: float = -math.inf


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Best pose (3,) in the grid frame and its covariance (3, 3) in the tangent [x, y, theta] at the pose."""

    pose: FloatArray
    covariance: FloatArray
    hypothesis: int
    share: float
    sigma_m: float


def prepare_map(grid: OccupancyGrid, settings: LocalizationSettings) -> PreparedMap:
    """Compute what the filter looks up in a map."""
    field = build_map_field(grid, settings.beam_model, line_radius_m=settings.line_radius_m)
    return PreparedMap(field=field, stack=build_search_stack(field, settings.search))
