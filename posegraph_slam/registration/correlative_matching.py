"""Correlative search of a window of planar poses with the interface of every matcher: points in, one result out."""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import ByteArray, FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import pose_from_xyt
from posegraph_slam.registration.cloud import Cloud, prepare_cloud
from posegraph_slam.registration.correlative import (
    FIELD_MAX,
    NO_DISC,
    branch_and_bound,
    exhaustive_search,
    likelihood_field,
    max_pooled,
    rotated_cells,
)
from posegraph_slam.registration.icp import checked_pose, failed, icp
from posegraph_slam.registration.result import RegistrationResult, RegistrationStatus
from posegraph_slam.registration.settings import IcpSettings
from posegraph_slam.settings import Settings

LEVELS_MAX = 6
"""Coarsest block: 64 cells a side; larger ones bound nothing."""


class SearchKind(StrEnum):
    """How the window is searched; both find the same best score."""

    EXHAUSTIVE = "exhaustive"
    """Every cell and angle (Olson 2009)."""
    BRANCH_AND_BOUND = "branch_and_bound"
    """Blocks of cells by falling bounds, most of which are never opened (Hess et al. 2016)."""


class CorrelativeSettings(Settings):
    """Window, grid and refinement of a correlative search in the plane."""

    search: SearchKind = SearchKind.BRANCH_AND_BOUND
    """How the window is searched: exhaustive or branch_and_bound."""
    reach_m: float = Field(default=1.0, gt=0, le=1000)
    """The window goes this far from the guess along both axes."""
    reach_rad: float = Field(default=0.6, gt=0, le=3.2)
    """The window turns this far from the guess either way."""
    resolution_m: float = Field(default=0.05, gt=0)
    """Cell of the likelihood field and step of the search; the farthest point moves by as much in a step of angle."""
    sigma_m: float = Field(default=0.05, gt=0)
    """Standard deviation of the Gaussian that each target point leaves in the field."""
    points_max: int = Field(default=200, ge=10)
    """The source is represented by at most this many points, evenly."""
    score_min: float = Field(default=0.3, ge=0, le=1)
    """Mean of the field under the points below which nothing was found."""
    refinement: IcpSettings = IcpSettings(max_distance_m=0.3)
    """How the best cell is refined; it also measures the information."""


DEFAULT_CORRELATIVE = CorrelativeSettings()


def match_correlatively(
    source: FloatArray | Cloud,
    target: FloatArray | Cloud,
    T_target_source: FloatArray,
    settings: CorrelativeSettings = DEFAULT_CORRELATIVE,
) -> RegistrationResult:
    """Register source points (n, 2) onto target points (m, 2) by searching a window about the guess T_target_source.

    The best pose of the grid is refined by the closest point loop, from which status, information and free directions
    come. A window in which no pose scores `score_min` ends in TOO_FEW_INLIERS; poor clouds end as they do in `icp`.
    Raises `InputError` for points that are not in the plane and for a guess that is no finite pose.
    """
    source, target = (c if isinstance(c, Cloud) else prepare_cloud(c) for c in (source, target))
    if source.dimension != 2 or target.dimension != 2:
        problem = f"{source.dimension}D and {target.dimension}D points"
        raise InputError("correlative matching", problem, "give planar points")
    guess = checked_pose(T_target_source, source, target)
    if min(len(source), len(target)) < settings.refinement.min_inliers:
        return failed(RegistrationStatus.TOO_FEW_POINTS, 2)
    if not (source.spans_plane and target.spans_plane):
        return failed(RegistrationStatus.DEGENERATE, 2)
    found = search_window(source.points, target.points, guess, settings)
    if found is None:
        return failed(RegistrationStatus.TOO_FEW_INLIERS, 2)
    return icp(source, target, found, settings.refinement)


def search_window(
    source: FloatArray, target: FloatArray, guess: FloatArray, settings: CorrelativeSettings
) -> FloatArray | None:
    """Best pose (3, 3) of the grid about the guess, or none that scores enough.

    The grid lies along the axes of the target and its origin in the middle of the source, so that the window turns
    about the points, wherever the source's own origin is.
    """
    middle = np.eye(3)
    middle[:2, 2] = source.mean(axis=0)
    points = np.ascontiguousarray((source - middle[:2, 2])[:: max(1, -(-len(source) // settings.points_max))])
    at = guess @ middle
    start = np.array([at[0, 2], at[1, 2], np.arctan2(at[1, 0], at[0, 0])])
    resolution, reach = settings.resolution_m, max(int(np.ceil(settings.reach_m / settings.resolution_m)), 1)
    farthest = max(float(np.sqrt(np.sum(points**2, axis=1).max())), resolution)
    half = int(np.ceil(settings.reach_rad / (resolution / farthest)))
    angles = np.linspace(-settings.reach_rad, settings.reach_rad, 2 * half + 1)
    # only targets that the window can reach matter: the field stays small
    near = np.abs(target - start[:2]).max(axis=1) <= farthest + settings.reach_m + 4 * settings.sigma_m
    if np.count_nonzero(near) < 3:
        return None
    field, origin, pad, levels = make_field(target[near], settings, reach)
    cells = rotated_cells(points, start, angles, origin, resolution, pad)
    least = int(settings.score_min * FIELD_MAX * len(points))
    if settings.search is SearchKind.EXHAUSTIVE:
        a, dx, dy, score = exhaustive_search(field, cells, reach)
    else:
        a, dx, dy, score = branch_and_bound(max_pooled(field, levels), cells, reach, least, NO_DISC)
    if score <= least:
        return None
    best = pose_from_xyt(np.array([start[0] + dx * resolution, start[1] + dy * resolution, start[2] + angles[a]]))
    shift = np.eye(3)
    shift[:2, 2] = -middle[:2, 2]
    return np.asarray(best @ shift)


def make_field(target: FloatArray, settings: CorrelativeSettings, reach: int) -> tuple[ByteArray, FloatArray, int, int]:
    """Likelihood field of target points (m, 2), its origin (2,), its padding in cells, and the levels of a pyramid."""
    levels = 0
    while levels < LEVELS_MAX and (2 << levels) <= reach:
        levels += 1
    rim = 3 * settings.sigma_m + settings.resolution_m
    origin = target.min(axis=0) - rim
    size = ((target.max(axis=0) + rim - origin) / settings.resolution_m).astype(np.int64) + 1
    if int(size[0]) * int(size[1]) > 1 << 28:
        raise InputError("correlative matching", f"needs a field of {size[0]} x {size[1]} cells", "take larger cells")
    pad = 1 << levels
    field = likelihood_field(np.ascontiguousarray(target), origin, settings.resolution_m, int(size[1]), int(size[0]),
                             pad, settings.sigma_m)  # fmt: skip
    return field, origin, pad, levels
