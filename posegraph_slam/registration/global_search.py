"""Registration in space without a guess: thousands of starts over all rotations, thinned round by round."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pydantic import Field, PositiveInt

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import inverse_pose, transform_points
from posegraph_slam.registration.cloud import Cloud, prepare_cloud
from posegraph_slam.registration.downsampling import thin_scan_lines
from posegraph_slam.registration.fit import trimmed_rmse
from posegraph_slam.registration.icp import failed, icp
from posegraph_slam.registration.many_starts import descend_all
from posegraph_slam.registration.nearest_field import NearestField, build_nearest_field
from posegraph_slam.registration.result import RegistrationResult, RegistrationStatus
from posegraph_slam.registration.rotation_grid import principal_frame, spread_rotations, yaw_rotations
from posegraph_slam.registration.settings import IcpSettings, Loss, ResidualKind
from posegraph_slam.settings import Settings


class StartKind(StrEnum):
    """Which rotations are tried."""

    ROTATIONS = "rotations"
    """All orientations, evenly, each from the mean and from six places around it."""
    YAW = "yaw"
    """Turns about the z axis alone, from the mean alone."""


class GlobalSearchSettings(Settings):
    """How a pose is searched without a guess; shares of the clouds' sizes, so that any unit of length fits."""

    starts: StartKind = StartKind.ROTATIONS
    """Which rotations are tried: rotations (all) or yaw (turns about z)."""
    rotations: int = Field(default=1000, ge=1, le=1_000_000)
    """Orientations tried; with yaw, the turns about z."""
    offset_share: float = Field(default=0.7, ge=0, le=10)
    """Shift of the six starts around the mean, in the source's largest standard deviation: one side is seen only."""
    keep_fraction: float = Field(default=0.9, gt=0, le=1)
    """Share of the source points that is expected on the target; the farthest others are left out."""
    coarse_points: int = Field(default=150, ge=10, le=100_000)
    """Source points with which all starts are tried."""
    fine_points: int = Field(default=2000, ge=10, le=1_000_000)
    """Source points with which the last candidates are compared."""
    field_voxels: int = Field(default=64, ge=8, le=400)
    """Voxels along the target's longest side in the table of nearest points."""
    survivors: tuple[PositiveInt, PositiveInt, PositiveInt] = (1000, 150, 40)
    """Starts left after each thinning."""
    candidates: int = Field(default=8, ge=1, le=1000)
    """Distinct poses that are refined on the target's own points before the best is chosen."""
    rmse_limit_share: float = Field(default=0.05, gt=0)
    """A best pose whose trimmed RMSE exceeds this share of the source's radius fits nothing: a failure."""
    rotation_tolerance_rad: float = Field(default=1e-5, gt=0, lt=0.1)
    """A refining step that turns less, and moves less than the same share of the radius, ends the refinement."""


ROUGHLY = 3.0
"""Times the limit of the RMSE that the table of nearest points, coarse as it is, may show of a pose that will fit."""

REFINING_ROUNDS = 300
"""A trimmed loop may wander among pairings, by a thirtieth of the noise, for 200 rounds before it closes a circle."""

DEFAULT_SEARCH = GlobalSearchSettings()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GlobalRegistration:
    """The best pose with where it came from: `start` its row among `starts` tried, and its first T_target_source.

    `trimmed_rmse_m` is the one-way distance from source to target over the nearest `keep_fraction` of the points.
    """

    result: RegistrationResult
    start: int
    starts: int
    T_start: FloatArray
    trimmed_rmse_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_start", read_only(self.T_start))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreparedTarget:
    """A target ready for searches: its cloud, the part that is matched (`thin_scan_lines`) and its nearest points."""

    cloud: Cloud
    matched: Cloud
    field: NearestField


def prepare_target(points: FloatArray, settings: GlobalSearchSettings = DEFAULT_SEARCH) -> PreparedTarget:
    """Prepare target points (m, 3) once for several searches. Raises `InputError` for other shapes."""
    cloud = prepare_cloud(points)
    if cloud.dimension != 3 or len(cloud) < 4:
        raise InputError("global registration", f"the target has shape {cloud.points.shape}", "give (points, 3)")
    matched = thin_scan_lines(cloud)
    return PreparedTarget(
        cloud=cloud, matched=matched, field=build_nearest_field(matched.points, settings.field_voxels)
    )


def register_globally(
    source: FloatArray, target: FloatArray | PreparedTarget, settings: GlobalSearchSettings = DEFAULT_SEARCH
) -> GlobalRegistration:
    """Register source points (n, 3) onto target points (m, 3) without a guess; the source may be seen in part only.

    The source is put into its principal frame, so that its pose does not matter. All starts go a few rounds of trimmed
    ICP on a table of nearest points with few points; the best go on with more (successive halving); the last few
    distinct ones are refined to the tangent planes, and the one of least trimmed distance wins, the first of equals.
    Nothing is random: the same input gives the same bytes. Clouds that are too poor, or fit nowhere, end in a status.
    Of clouds of dense scan lines an even part is matched (`thin_scan_lines`), whose inliers the result counts.
    """
    prepared = target if isinstance(target, PreparedTarget) else prepare_target(target, settings)
    whole = prepare_cloud(source)
    cloud = thin_scan_lines(whole)
    if cloud.dimension != 3:
        raise InputError("global registration", f"the source has shape {cloud.points.shape}", "give (points, 3)")
    if len(cloud) < 10:
        return _nothing(RegistrationStatus.TOO_FEW_POINTS)
    if not (cloud.spans_plane and prepared.matched.spans_plane):
        return _nothing(RegistrationStatus.DEGENERATE)
    T_source_frame = source_frame(cloud.points, settings)
    points = transform_points(inverse_pose(T_source_frame), cloud.points)
    starts = make_starts(points, prepared.matched.points.mean(axis=0), settings)
    poses, origin, roughly = thin_out(starts, points, prepared.field, settings)
    radius = float(np.sqrt(np.sum(points**2, axis=1).mean()))
    if roughly > ROUGHLY * settings.rmse_limit_share * radius:
        return _nothing(RegistrationStatus.TOO_FEW_INLIERS, len(starts))
    T, start, rmse = choose(points, poses, origin, prepared.matched, settings)
    result = refine(cloud, prepared.matched, T @ inverse_pose(T_source_frame), rmse, settings)
    final = trimmed_rmse(whole.points, prepared.cloud, result.T_target_source, settings.keep_fraction)
    if not result.usable or final > settings.rmse_limit_share * radius:
        return _nothing(result.status if not result.usable else RegistrationStatus.TOO_FEW_INLIERS, len(starts))
    return GlobalRegistration(result=result, start=start, starts=len(starts), trimmed_rmse_m=final,
                              T_start=starts[start] @ inverse_pose(T_source_frame))  # fmt: skip


def source_frame(points: FloatArray, settings: GlobalSearchSettings) -> FloatArray:
    """Frame (4, 4) in which the source is searched: principal axes, or, for yaw, the axes of its own frame."""
    T = principal_frame(points)
    if settings.starts is StartKind.YAW:
        T[:3, :3] = np.eye(3)
    return T


def make_starts(points: FloatArray, target_mean: FloatArray, settings: GlobalSearchSettings) -> FloatArray:
    """First poses (s, 4, 4) of the centred points (n, 3): every rotation at the mean and shifted along each axis."""
    if settings.starts is StartKind.YAW:
        rotations, offsets = yaw_rotations(settings.rotations), np.zeros((1, 3))
    else:
        rotations = spread_rotations(settings.rotations)
        shift = settings.offset_share * float(points.std(axis=0).max())
        offsets = shift * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    starts = np.tile(np.eye(4), (len(rotations) * len(offsets), 1, 1))
    starts[:, :3, :3] = np.repeat(rotations, len(offsets), axis=0)
    starts[:, :3, 3] = target_mean + np.einsum("rij,oj->roi", rotations, offsets).reshape(-1, 3)
    return starts


def thin_out(
    starts: FloatArray, points: FloatArray, field: NearestField, settings: GlobalSearchSettings
) -> tuple[FloatArray, IntArray, float]:
    """Return the poses that survive all rounds, best first, the rows of `starts` they came from, and the best RMSE."""
    coarse, fine = evenly(points, settings.coarse_points), evenly(points, settings.fine_points)
    table = (field.row, field.points, field.normals, field.origin, field.voxel_m)
    poses, origin = starts, np.arange(len(starts))
    loose = min(settings.keep_fraction, 0.8)  # far from the goal more pairs are wrong
    plan = ((coarse, loose, 8, False), (coarse, loose, 12, True), (coarse, settings.keep_fraction, 20, True))
    for (some, keep, rounds, to_planes), left in zip(plan, settings.survivors, strict=True):
        poses, scores = descend_all(poses, some, *table, keep, rounds, to_planes)
        best = np.argsort(scores, kind="stable")[:left]
        poses, origin = poses[best], origin[best]
    poses, scores = descend_all(poses, fine, *table, settings.keep_fraction, 30, True)
    best = np.argsort(scores, kind="stable")
    return poses[best], origin[best], float(np.sqrt(scores[best[0]]))


def choose(
    points: FloatArray, poses: FloatArray, origin: IntArray, target: Cloud, settings: GlobalSearchSettings
) -> tuple[FloatArray, int, float]:
    """Refine the first distinct poses on a part of the points; return the best pose, its start and trimmed RMSE."""
    fine = evenly(points, settings.fine_points)
    radius = float(np.sqrt(np.sum(points**2, axis=1).mean()))
    cloud = prepare_cloud(fine)
    best: tuple[FloatArray, int, float] = (poses[0], int(origin[0]), np.inf)
    for row in distinct(poses, radius, settings.candidates):
        rmse = trimmed_rmse(fine, target, poses[row], settings.keep_fraction)
        quick = refining(rmse, radius, 40, settings).model_copy(update={"uncertainty": False})
        result = icp(cloud, target, poses[row], quick)
        if not result.usable:
            continue
        rmse = trimmed_rmse(fine, target, result.T_target_source, settings.keep_fraction)
        if rmse < best[2]:
            best = (result.T_target_source, int(origin[row]), rmse)
    return best


def distinct(poses: FloatArray, radius: float, most: int) -> list[int]:
    """Rows of poses that differ from all rows before by a fiftieth of the radius somewhere, at most `most`."""
    rows: list[int] = []
    for row in range(len(poses)):
        apart = poses[rows] - poses[row]
        moved = np.linalg.norm(apart[:, :3, 3], axis=1) + radius * np.linalg.norm(apart[:, :3, :3], axis=(1, 2))
        if (moved > radius / 50).all():
            rows.append(row)
        if len(rows) == most:
            break
    return rows


def refining(rmse: float, radius: float, rounds: int, settings: GlobalSearchSettings) -> IcpSettings:
    """Trimmed point-to-plane from a pose of this trimmed RMSE."""
    return IcpSettings(
        residual=ResidualKind.POINT_TO_PLANE,
        loss=Loss.NONE,
        keep_fraction=settings.keep_fraction,
        max_distance_m=max(20 * rmse, 1e-9),
        max_iterations=rounds,
        min_inlier_fraction=0.3,
        rotation_tolerance_rad=settings.rotation_tolerance_rad,
        translation_tolerance_m=min(settings.rotation_tolerance_rad * radius, 0.09),
    )


def refine(
    source: Cloud, target: Cloud, T: FloatArray, rmse: float, settings: GlobalSearchSettings
) -> RegistrationResult:
    """Refine the chosen pose with all points."""
    centred = source.points - source.points.mean(axis=0)
    radius = float(np.sqrt(np.sum(centred**2, axis=1).mean()))
    if not np.isfinite(rmse):
        return failed(RegistrationStatus.TOO_FEW_INLIERS, 3)
    return icp(source, target, T, refining(rmse, radius, REFINING_ROUNDS, settings))


def evenly(points: FloatArray, count: int) -> FloatArray:
    """At most `count` rows of points (n, d), evenly along their order."""
    if len(points) <= count:
        return np.ascontiguousarray(points)
    return np.ascontiguousarray(points[np.linspace(0, len(points) - 1, count).astype(np.int64)])


def _nothing(status: RegistrationStatus, starts: int = 0) -> GlobalRegistration:
    return GlobalRegistration(result=failed(status, 3), start=-1, starts=starts, T_start=np.full((4, 4), np.nan),
                              trimmed_rmse_m=float("inf"))  # fmt: skip
