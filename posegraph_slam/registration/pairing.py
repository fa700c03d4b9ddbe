"""Association of source points with target points, and the tests that drop pairs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.geometry import transform_points
from posegraph_slam.registration.cloud import Cloud
from posegraph_slam.registration.kd_tree import build_kd_tree
from posegraph_slam.registration.settings import AssociationKind, IcpSettings, ResidualKind
from posegraph_slam.registration.voxel_hash import build_voxel_hash, search_voxel_hash


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


Association = Callable[[FloatArray], Pairs]
"""Pairs moved source points (n, d) with target points."""

Rejection = Callable[[Scene, Pairs], BoolArray]
"""Tells which pairs (m,) stay."""


def pair_points(scene: Scene, associate: Association, rejections: tuple[Rejection, ...]) -> Pairs:
    """Pair source points with their nearest target points, then apply the rejections in order."""
    pairs = associate(scene.moved)
    for rejection in rejections:
        pairs = pairs.select(rejection(scene, pairs))
    return pairs


def association_for(target: Cloud, settings: IcpSettings) -> Association:
    """Return the search for target points no farther than the gate that `settings` names."""
    kind = settings.association
    if kind is None:
        kind = AssociationKind.VOXEL_HASH if target.dimension == 2 else AssociationKind.KD_TREE
    by_kind = {AssociationKind.VOXEL_HASH: by_voxel_hash, AssociationKind.KD_TREE: by_tree}
    return by_kind[kind](target, settings.max_distance_m)


def by_tree(target: Cloud, max_distance_m: float) -> Association:
    """Search by the cloud's KD-tree."""

    def associate(moved: FloatArray) -> Pairs:
        row, distance = target.tree.nearest(moved, max_distance_m)
        source = np.flatnonzero(row >= 0)
        return Pairs(source=source, target=row[source], distance_m=distance[source])

    return associate


def by_voxel_hash(target: Cloud, max_distance_m: float) -> Association:
    """Search by voxels hashed for this gate."""
    voxels = build_voxel_hash(target.points, max_distance_m)

    def associate(moved: FloatArray) -> Pairs:
        row, distance = search_voxel_hash(voxels, moved)
        source = np.flatnonzero(row >= 0)
        return Pairs(source=source, target=row[source], distance_m=distance[source])

    return associate


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
    _, nearest = build_kd_tree(scene.moved).nearest(scene.target.points[touched])
    return np.asarray(pairs.distance_m <= nearest[row] * (1 + 1e-12))


def place(source: Cloud, target: Cloud, T_target_source: FloatArray) -> Scene:
    """Put the source at T_target_source."""
    return Scene(source=source, target=target, T_target_source=T_target_source,
                 moved=transform_points(T_target_source, source.points))  # fmt: skip
