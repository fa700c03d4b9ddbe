"""How well a placed source lies on its target, one way: the target may hold more than the source saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import transform_points
from posegraph_slam.registration.cloud import Cloud

INLIER_RMSES = 3.0
"""Distance, in trimmed root mean squares, within which a point counts as an inlier."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """Distances from every source point to its nearest target point, summed up.

    `trimmed_rmse_m` is over the nearest share of the points; `inlier_fraction` the share within three times of it.
    """

    rmse_m: float
    trimmed_rmse_m: float
    inlier_fraction: float
    sum_of_squares_m2: float
    sum_of_distances_m: float


def measure_fit(points: FloatArray, target: Cloud, T_target_source: FloatArray, keep_fraction: float) -> Fit:
    """Measure the distances from source points (n, d), n > 0, at a finite T_target_source to their nearest targets."""
    distance = nearest_distances(points, target, T_target_source)
    trimmed = trimmed_mean_root(distance, keep_fraction)
    return Fit(
        rmse_m=float(np.sqrt(np.mean(distance**2))),
        trimmed_rmse_m=trimmed,
        inlier_fraction=float(np.mean(distance <= INLIER_RMSES * trimmed)),
        sum_of_squares_m2=float(np.sum(distance**2)),
        sum_of_distances_m=float(np.sum(distance)),
    )


def trimmed_rmse(points: FloatArray, target: Cloud, T_target_source: FloatArray, keep_fraction: float) -> float:
    """Root mean square distance over the nearest share of points (n, d); infinite where the pose is not finite."""
    if not np.isfinite(T_target_source).all():
        return float("inf")
    return trimmed_mean_root(nearest_distances(points, target, T_target_source), keep_fraction)


def nearest_distances(points: FloatArray, target: Cloud, T_target_source: FloatArray) -> FloatArray:
    """Distance (n,) of each placed source point (n, d) to its nearest target point."""
    return target.tree.nearest(transform_points(T_target_source, points))[1]


def trimmed_mean_root(distance: FloatArray, keep_fraction: float) -> float:
    """Root of the mean square of the smallest share of distances (n,), at least one of them."""
    kept = max(int(np.floor(keep_fraction * len(distance))), 1)
    return float(np.sqrt(np.mean(np.partition(distance, kept - 1)[:kept] ** 2)))
