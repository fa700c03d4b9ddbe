"""The iterative closest point loop (Besl and McKay 1992; Chen and Medioni 1992) over swappable parts."""

from __future__ import annotations

import math

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, SE3
from posegraph_slam.registration.cloud import Cloud, prepare_cloud
from posegraph_slam.registration.pairing import Pairs, Scene, association_for, pair_points, place, rejections_for
from posegraph_slam.registration.residuals import Residual, linearise, residual_for
from posegraph_slam.registration.result import RegistrationResult, RegistrationStatus
from posegraph_slam.registration.robust import influence_slopes, residual_scale, robust_weights
from posegraph_slam.registration.settings import IcpSettings, Loss
from posegraph_slam.registration.uncertainty import Evidence, information_of

DEFAULT_SETTINGS = IcpSettings()


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
    information zero. Raises `InputError` on shapes that do not fit and on values that are not finite.
    """
    source = _prepared(source, settings)
    target = _prepared(target, settings)
    T = _checked_pose(T_target_source, source, target)
    if min(len(source), len(target)) < settings.min_inliers:
        return failed(RegistrationStatus.TOO_FEW_POINTS, source.dimension)
    if not (source.spans_plane and target.spans_plane):
        return failed(RegistrationStatus.DEGENERATE, source.dimension)
    residual, associate, rejections = (
        residual_for(settings),
        association_for(target, settings),
        rejections_for(settings),
    )
    status, iteration = RegistrationStatus.MAX_ITERATIONS, 0
    for iteration in range(1, settings.max_iterations + 1):
        scene = place(source, target, T)
        pairs = pair_points(scene, associate, rejections)
        if len(pairs) < max(settings.min_inliers, settings.min_inlier_fraction * len(source)):
            return failed(RegistrationStatus.TOO_FEW_INLIERS, source.dimension, pairs=len(pairs), iterations=iteration)
        better = residual.improve(scene, pairs, _weights(residual, scene, pairs, settings)[0])
        if better is None:
            return failed(RegistrationStatus.DEGENERATE, source.dimension, pairs=len(pairs), iterations=iteration)
        settled = has_settled(T, better, settings)
        T = better
        if settled:
            status = RegistrationStatus.CONVERGED
            break
    # the last step is below the tolerances, or the loop gave up: either way the last pairs describe the end
    return _described(residual, place(source, target, T), pairs, settings, status, iteration)


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


def _checked_pose(T_target_source: FloatArray, source: Cloud, target: Cloud) -> FloatArray:
    """Return the guess if it fits both clouds."""
    if source.dimension != target.dimension:
        raise InputError("registration", f"source points have {source.dimension} coordinates, target points "
                         f"{target.dimension}", "give both in the plane or both in space")  # fmt: skip
    T, size = np.asarray(T_target_source, dtype=np.float64), source.dimension + 1
    if T.shape != (size, size) or not np.isfinite(T).all():
        problem = f"the initial T_target_source of shape {T.shape} is not a finite pose of {source.dimension}D points"
        raise InputError("registration", problem, f"give a {size} x {size} matrix")
    return T


def _weights(residual: Residual, scene: Scene, pairs: Pairs, settings: IcpSettings) -> tuple[FloatArray, float]:
    """Weights (m,) of the pairs, and the mean curvature of the robust loss over its mean weight."""
    trust = residual.trust(scene, pairs)
    if settings.loss is Loss.NONE:
        return trust, 1.0
    lengths = residual.lengths(scene, pairs)
    scale = settings.loss_scale_m or residual_scale(
        lengths, residual.dimension(scene), settings.translation_tolerance_m
    )
    weights = robust_weights(settings.loss, lengths, scale)
    slope = float(trust @ influence_slopes(settings.loss, lengths, scale) / (trust @ weights + 1e-300))
    return trust * weights, max(slope, 0.1)


def _described(
    residual: Residual, scene: Scene, pairs: Pairs, settings: IcpSettings, status: RegistrationStatus, iterations: int
) -> RegistrationResult:
    """Measure the pairs at the final pose."""
    lengths, trust = residual.lengths(scene, pairs), residual.trust(scene, pairs)
    weights, slope = _weights(residual, scene, pairs, settings)
    frame, jacobian = linearise(scene, pairs)
    # tangential distances of point pairs come from sampling, not from noise, yet they are what moves point-to-point
    errors = lengths
    evidence = Evidence(frame=frame, jacobian=jacobian, weights=weights, residuals_m=errors, slope=slope,
                        target=pairs.target)  # fmt: skip
    information, free = information_of(evidence, scene.target.surface, settings)
    return RegistrationResult(
        T_target_source=scene.T_target_source,
        status=status,
        inliers=len(pairs),
        inlier_fraction=len(pairs) / len(scene.source),
        rmse_m=float(np.sqrt(trust @ lengths**2 / max(trust.sum(), 1e-300))),
        information=information,
        degenerate_directions=free,
        iterations=iterations,
    )
