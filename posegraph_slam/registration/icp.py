"""The iterative closest point loop (Besl and McKay 1992; Chen and Medioni 1992) over swappable parts."""

from __future__ import annotations

import math

import numpy as np

from posegraph_slam.arrays import FloatArray, frozen, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, SE3
from posegraph_slam.jit import kernel
from posegraph_slam.registration.cloud import Cloud, prepare_cloud
from posegraph_slam.registration.compiled_loop import (
    CONVERGED,
    DEGENERATE,
    MAX_ITERATIONS,
    TOO_FEW_INLIERS,
    describe_end,
    register,
)
from posegraph_slam.registration.pair_search import nothing_known
from posegraph_slam.registration.pairing import Pairs, Scene, association_for, pair_points, place, rejections_for
from posegraph_slam.registration.residuals import Residual, residual_for
from posegraph_slam.registration.result import RegistrationResult, RegistrationStatus
from posegraph_slam.registration.robust import residual_scale, robust_weights
from posegraph_slam.registration.settings import IcpSettings, Loss, ResidualKind
from posegraph_slam.registration.surface import Surface
from posegraph_slam.registration.uncertainty import rmse_of_pairs

DEFAULT_SETTINGS = IcpSettings()

STATUSES = {
    CONVERGED: RegistrationStatus.CONVERGED,
    MAX_ITERATIONS: RegistrationStatus.MAX_ITERATIONS,
    TOO_FEW_INLIERS: RegistrationStatus.TOO_FEW_INLIERS,
    DEGENERATE: RegistrationStatus.DEGENERATE,
}
FAILURES = (RegistrationStatus.TOO_FEW_INLIERS, RegistrationStatus.DEGENERATE)

RIGID_TOLERANCE, RIGID_ROUNDING = 2e-3, 1e-12
"""How far the axes of a guess may be from unit length and right angles, and how far without being corrected."""

NO_NORMALS, NO_ROWS = read_only(np.zeros((1, 3))), frozen(np.zeros((1, 1), dtype=np.int64))
NO_SURFACE = Surface(
    anchors=NO_NORMALS, normals=NO_NORMALS, normals_in_space=NO_NORMALS, oriented=frozen(np.zeros(1, dtype=np.bool_)),
    thickness_m=frozen(np.zeros(1)), trust=frozen(np.zeros(1)), neighbours=NO_ROWS, nearest=NO_ROWS,
)  # fmt: skip
"""Stand for what does not count: it need not be fitted then."""


def icp(
    source: FloatArray | Cloud,
    target: FloatArray | Cloud,
    T_target_source: FloatArray,
    settings: IcpSettings = DEFAULT_SETTINGS,
) -> RegistrationResult:
    """Register source points (n, d) onto target points (m, d), d = 2 or 3, from the guess T_target_source (d+1, d+1).

    Either set may be an array or a `Cloud` prepared once for several matches. Each round pairs the points, drops
    pairs, weighs the rest and takes one step; it ends when a step turns and moves less than the tolerances. Points
    too few, on one spot or one line, or without overlap end in a status; then the transform is NaN and the
    information zero. Raises `InputError` on shapes that do not fit, values that are not finite, and a guess that is
    no rigid motion.
    """
    source = _prepared(source, settings)
    target = _prepared(target, settings)
    T = checked_pose(T_target_source, source, target)
    if min(len(source), len(target)) < settings.min_inliers:
        return failed(RegistrationStatus.TOO_FEW_POINTS, source.dimension)
    if not (source.spans_plane and target.spans_plane):
        return failed(RegistrationStatus.DEGENERATE, source.dimension)
    if runs_compiled(settings):
        return _run_compiled(source, target, T, settings)
    return _run_parts(source, target, T, settings)


def runs_compiled(settings: IcpSettings) -> bool:
    """Whether the compiled loop has every part that the settings name."""
    return settings.association is None and settings.max_normal_angle_rad is None and not settings.reciprocal


def _run_compiled(source: Cloud, target: Cloud, T: FloatArray, settings: IcpSettings) -> RegistrationResult:
    """Run the loop as one kernel."""
    d, tree, surface = source.dimension, target.tree, NO_SURFACE
    residual, loss, options = settings.for_kernels
    if settings.uncertainty or settings.residual is not ResidualKind.POINT_TO_POINT:
        surface = target.surface
    pose, code, iterations, pairs, information, free, rmse = register(
        d, source.in_space, target.in_space, tree.rows, tree.sorted_points, tree.axis, tree.value, surface.anchors,
        surface.normals_in_space, surface.trust, surface.thickness_m, surface.neighbours, surface.nearest,
        _source_normals(source, settings), T, residual, loss, options)  # fmt: skip
    status = STATUSES[code]
    if status in FAILURES:
        return failed(status, d, pairs=pairs, iterations=iterations)
    return RegistrationResult(T_target_source=frozen(pose), status=status, inliers=pairs,
                              inlier_fraction=pairs / len(source), rmse_m=rmse, information=frozen(information),
                              degenerate_directions=frozen(free), iterations=iterations)  # fmt: skip


def _run_parts(source: Cloud, target: Cloud, T: FloatArray, settings: IcpSettings) -> RegistrationResult:
    """Run the loop part by part; the compiled loop does the same, and this one is its oracle."""
    residual, associate = residual_for(settings), association_for(target, settings)
    rejections = rejections_for(settings)
    status, iteration, remembered, power, lap = RegistrationStatus.MAX_ITERATIONS, 0, T, 1, 0
    for iteration in range(1, settings.max_iterations + 1):
        scene = place(source, target, T)
        pairs = pair_points(scene, associate, rejections)
        if len(pairs) < max(settings.min_inliers, settings.min_inlier_fraction * len(source)):
            return failed(RegistrationStatus.TOO_FEW_INLIERS, source.dimension, pairs=len(pairs), iterations=iteration)
        better = residual.improve(scene, pairs, _weights(residual, scene, pairs, settings))
        if better is None:
            return failed(RegistrationStatus.DEGENERATE, source.dimension, pairs=len(pairs), iterations=iteration)
        # a pose that comes back to an earlier one runs in a circle of pairings (Brent 1980): it settles no further
        settled = has_settled(T, better, settings) or (iteration > 2 and has_settled(remembered, better, settings))
        T = better
        if settled:
            status = RegistrationStatus.CONVERGED
            break
        lap += 1
        if lap == power:
            remembered, power, lap = T, 2 * power, 0
    # the last step is below the tolerances, or the loop gave up: either way the last pairs describe the end
    return _described(source, target, T, pairs, settings, status, iteration)


def _described(
    source: Cloud, target: Cloud, T: FloatArray, pairs: Pairs, settings: IcpSettings, status: RegistrationStatus,
    iterations: int,
) -> RegistrationResult:  # fmt: skip
    """Measure the last pairs at the final pose."""
    d, tree, surface = source.dimension, target.tree, target.surface
    normals = surface.normals_in_space
    residual, loss, options = settings.for_kernels
    in_space, s, t = pose_in_space(T, d), pairs.source, pairs.target
    rmse = rmse_of_pairs(d, in_space, source.in_space, target.in_space, normals, surface.trust, surface.anchors,
                         _source_normals(source, settings), s, t, residual, settings.plane_share)  # fmt: skip
    p = 3 * (d - 1)
    information, free = (np.zeros((p, p)), np.eye(p)) if not settings.uncertainty else describe_end(
        d, source.in_space, target.in_space, tree.rows, tree.sorted_points, tree.axis, tree.value, surface.anchors,
        normals, surface.trust, surface.thickness_m, surface.neighbours, surface.nearest, in_space, s, t, residual,
        loss, options, *nothing_known(len(source)))  # fmt: skip
    return RegistrationResult(T_target_source=T, status=status, inliers=len(pairs),
                              inlier_fraction=len(pairs) / len(source), rmse_m=rmse, information=information,
                              degenerate_directions=free, iterations=iterations)  # fmt: skip


def pose_in_space(T: FloatArray, d: int) -> FloatArray:
    """Pose (4, 4) of points (n, 3) that does to the first d coordinates what T (d+1, d+1) does."""
    result = np.eye(4)
    result[:d, :d], result[:d, 3] = T[:d, :d], T[:d, d]
    return result


def has_settled(T_before: FloatArray, T_after: FloatArray, settings: IcpSettings) -> bool:
    """Whether a step turned and moved less than the tolerances."""
    d = T_before.shape[0] - 1
    # a turn by w takes the rotation 2 sqrt(2) sin(w / 2) away in the Frobenius norm, in the plane and in space
    apart = float(np.linalg.norm(T_after[:d, :d] - T_before[:d, :d]))
    turned = 2.0 * math.asin(min(apart / math.sqrt(8.0), 1.0))
    moved = float(np.linalg.norm(T_after[:d, d] - T_before[:d, d]))
    return turned < settings.rotation_tolerance_rad and moved < settings.translation_tolerance_m


def failed(status: RegistrationStatus, dimension: int, *, pairs: int = 0, iterations: int = 0) -> RegistrationResult:
    """Return a result without a transform: NaN pose, zero information, every direction free."""
    group = SE2 if dimension == 2 else SE3
    return RegistrationResult(
        T_target_source=np.full((dimension + 1, dimension + 1), np.nan),
        status=status,
        inliers=pairs,
        inlier_fraction=0.0,
        rmse_m=float("nan"),
        information=np.zeros((group.dof, group.dof)),
        degenerate_directions=np.eye(group.dof),
        iterations=iterations,
    )


def _prepared(cloud: FloatArray | Cloud, settings: IcpSettings) -> Cloud:
    return cloud if isinstance(cloud, Cloud) else prepare_cloud(cloud, neighbours=settings.normal_neighbours)


def checked_pose(T_target_source: FloatArray, source: Cloud, target: Cloud) -> FloatArray:
    """Return the guess (d+1, d+1) if it fits both clouds and is a rigid motion to three digits, as files may hold it.

    A Gauss-Newton loop that starts at a reflection or a scaling would end at one, which is why digits that were cut
    off are made up for: the rotation becomes the nearest one.
    """
    if source.dimension != target.dimension:
        raise InputError("registration", f"source points have {source.dimension} coordinates, target points "
                         f"{target.dimension}", "give both in the plane or both in space")  # fmt: skip
    # always a new array in C order: kernels are compiled anew for every other layout
    T, size = np.array(T_target_source, dtype=np.float64, order="C"), source.dimension + 1
    if T.shape != (size, size) or not math.isfinite(np.vdot(T, T)):  # a fifth of the time of np.isfinite(T).all()
        problem = f"the initial T_target_source of shape {T.shape} is not a finite pose of {source.dimension}D points"
        raise InputError("registration", problem, f"give a {size} x {size} matrix")
    off = distance_from_rigid(T)
    if off > RIGID_TOLERANCE:
        problem = "the initial T_target_source is no rigid motion: it scales, shears or reflects"
        raise InputError("registration", problem, "give a rotation and a translation")
    if off > RIGID_ROUNDING:
        R = T[:-1, :-1]
        for _ in range(3):  # each squares the distance (Bjorck and Bowie 1971): 2e-3 becomes less than rounding
            R[:] = R @ (1.5 * np.eye(len(R)) - 0.5 * R.T @ R)
    return T


@kernel
def distance_from_rigid(T: FloatArray) -> float:
    """Largest entry of R^T R - 1 for R in T (d+1, d+1); infinite if T reflects or its last row is not 0, .., 0, 1."""
    d = len(T) - 1
    largest = 0.0
    for a in range(d):
        for b in range(d):
            product = -1.0 if a == b else 0.0
            for c in range(d):
                product += T[c, a] * T[c, b]
            largest = max(largest, abs(product))
        if T[d, a] != 0.0:
            return np.inf
    if d == 2:
        volume = T[0, 0] * T[1, 1] - T[0, 1] * T[1, 0]
    else:
        volume = (
            T[0, 0] * (T[1, 1] * T[2, 2] - T[1, 2] * T[2, 1])
            + T[0, 1] * (T[1, 2] * T[2, 0] - T[1, 0] * T[2, 2])
            + T[0, 2] * (T[1, 0] * T[2, 1] - T[1, 1] * T[2, 0])
        )
    return largest if volume > 0.0 and T[d, d] == 1.0 else np.inf


def _source_normals(source: Cloud, settings: IcpSettings) -> FloatArray:
    """Normals of the source where they count, else none: they need not be fitted then."""
    if settings.residual is not ResidualKind.GENERALISED:
        return NO_NORMALS
    return source.surface.normals_in_space


def _weights(residual: Residual, scene: Scene, pairs: Pairs, settings: IcpSettings) -> FloatArray:
    """Weights (m,) of the pairs."""
    trust = residual.trust(scene, pairs)
    if settings.loss is Loss.NONE:
        return trust
    lengths = residual.lengths(scene, pairs)
    scale = settings.loss_scale_m or residual_scale(
        lengths, residual.dimension(scene), settings.translation_tolerance_m
    )
    return trust * robust_weights(settings.loss, lengths, scale)
