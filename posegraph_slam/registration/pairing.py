"""Association of source points with target points, and the tests that drop pairs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.geometry import transform_points
from posegraph_slam.registration.cloud import Cloud
from posegraph_slam.registration.settings import IcpSettings, ResidualKind


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pairs:
    """Rows (m,) of the source and target points that belong together, and their distances (m,) at the present pose."""

    source: IntArray
    target: IntArray
    distance_m: FloatArray

    def __len__(self) -> int:
        return int(self.source.shape[0])

    def select(self, index: BoolArray | IntArray) -> Pairs:
        """Return the pairs at `index`."""
        return Pairs(source=self.source[index], target=self.target[index], distance_m=self.distance_m[index])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """Both clouds and the present T_target_source; `moved` (n, d) are the source points in the target frame."""

    source: Cloud
    target: Cloud
    T_target_source: FloatArray
    moved: FloatArray


Rejection = Callable[[Scene, Pairs], BoolArray]
"""Tells which pairs (m,) stay."""


def pair_points(scene: Scene, settings: IcpSettings, rejections: tuple[Rejection, ...]) -> Pairs:
    """Pair every source point with its nearest target point within the gate, then apply the rejections in order."""
    pairs = nearest_pairs(scene, settings.max_distance_m)
    for rejection in rejections:
        pairs = pairs.select(rejection(scene, pairs))
    return pairs


def nearest_pairs(scene: Scene, max_distance_m: float) -> Pairs:
    """Pair source points with their nearest target points no farther than `max_distance_m` by the KD-tree."""
    # the search excludes its own bound; one float up lets a pair at exactly the gate in
    distance, target = scene.target.tree.query(
        scene.moved, distance_upper_bound=np.nextafter(max_distance_m, np.inf), workers=1
    )
    source = np.flatnonzero(np.isfinite(distance))
    return Pairs(source=source, target=np.asarray(target)[source], distance_m=np.asarray(distance)[source])


def rejections_for(settings: IcpSettings) -> tuple[Rejection, ...]:
    """Return the tests that `settings` asks for: normals, reciprocity, and trimming last, over what is left."""
    tests: list[Rejection] = []
    if settings.residual is not ResidualKind.POINT_TO_POINT:
        tests.append(has_target_normal)
    if settings.max_normal_angle_rad is not None:
        tests.append(normal_angle_test(settings.max_normal_angle_rad))
    if settings.reciprocal:
        tests.append(is_reciprocal)
    if settings.keep_fraction < 1:
        tests.append(trimming_test(settings.keep_fraction))
    return tuple(tests)


def has_target_normal(scene: Scene, pairs: Pairs) -> BoolArray:
    """Keep pairs whose target point has a normal."""
    return scene.target.surface.oriented[pairs.target]


def trimming_test(keep_fraction: float) -> Rejection:
    """Keep the share `keep_fraction` of the pairs that is nearest, at least one (Chetverikov et al. 2002)."""

    def is_near(scene: Scene, pairs: Pairs) -> BoolArray:
        keep = np.zeros(len(pairs), dtype=np.bool_)
        count = min(max(round(keep_fraction * len(pairs)), 1), len(pairs))
        keep[np.argsort(pairs.distance_m, kind="stable")[:count]] = True
        return keep

    return is_near


def normal_angle_test(max_angle_rad: float) -> Rejection:
    """Keep pairs whose surface normals, signs aside, differ by at most `max_angle_rad`."""
    least_cosine = np.cos(max_angle_rad)

    def has_like_normals(scene: Scene, pairs: Pairs) -> BoolArray:
        d = scene.source.dimension
        turned = scene.source.surface.normals[pairs.source] @ scene.T_target_source[:d, :d].T
        cosine = np.abs(np.einsum("md,md->m", turned, scene.target.surface.normals[pairs.target]))
        # a point without a normal has a zero one and fails, unless every angle is allowed
        return np.asarray(cosine >= least_cosine - 1e-12)

    return has_like_normals


def is_reciprocal(scene: Scene, pairs: Pairs) -> BoolArray:
    """Keep pairs whose source point is the nearest one to their target point, or as near as it."""
    touched, row = np.unique(pairs.target, return_inverse=True)
    nearest, _ = cKDTree(scene.moved).query(scene.target.points[touched])
    return np.asarray(pairs.distance_m <= np.asarray(nearest)[row] * (1 + 1e-12))


def place(source: Cloud, target: Cloud, T_target_source: FloatArray) -> Scene:
    """Put the source at T_target_source."""
    return Scene(source=source, target=target, T_target_source=T_target_source,
                 moved=transform_points(T_target_source, source.points))  # fmt: skip
