"""The bridge to GTSAM: graphs of arrays into factors, batch optimisers stepped one iteration at a time, poses out.

GTSAM has no batch insertion, so factors are built in tight loops (about 6 us each). Keys are row numbers. Fixed nodes
are held by NonlinearEquality: unlike a tight prior it holds several nodes exactly and adds no cost, in the same time.
"""

from __future__ import annotations

import time
from typing import Any

import gtsam
import numpy as np
from gtsam import utilities

from posegraph_slam.arrays import FloatArray
from posegraph_slam.execution import Progress
from posegraph_slam.geometry import pose_from_rotation_translation, pose_from_xyt, xyt_from_pose
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.robust import RobustLoss, RobustSettings
from posegraph_slam.pose_graph.solver_settings import (
    EliminationOrdering,
    IterationRecord,
    OptimizerRun,
    SolverMethod,
    SolverSettings,
    StopReason,
)

LAMBDA_UPPER_BOUND = 1e5
"""GTSAM's default; past it no step was found."""
DENSE_EDGES_PER_NODE = 4
"""Above this METIS wins: 3000 nodes with 30000 edges take 0.19 s an iteration, 0.30 s with COLAMD."""


def to_poses(poses: FloatArray) -> list[Any]:
    """Turn matrices (N, d+1, d+1) into GTSAM poses."""
    if poses.shape[-1] == 3:
        pose2 = gtsam.Pose2
        return [pose2(x, y, theta) for x, y, theta in xyt_from_pose(poses).tolist()]
    pose3 = gtsam.Pose3
    return [pose3(matrix) for matrix in poses]


def to_values(poses: FloatArray) -> Any:
    """Put poses into GTSAM values under their row numbers."""
    values = gtsam.Values()
    insert = values.insert
    for key, pose in enumerate(to_poses(poses)):
        insert(key, pose)
    return values


def from_values(values: Any, matrix_size: int) -> FloatArray:
    """Take poses (N, d+1, d+1) out of GTSAM values in the order of their keys."""
    if matrix_size == 3:
        return pose_from_xyt(utilities.extractPose2(values))
    rows = utilities.extractPose3(values)
    return pose_from_rotation_translation(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])


def noise_models(information: FloatArray) -> list[Any]:
    """Turn information (E, p, p) into GTSAM noise models."""
    create = gtsam.noiseModel.Gaussian.Information
    return [create(matrix) for matrix in information]


def _robust_estimator(settings: RobustSettings) -> Any:
    estimators = gtsam.noiseModel.mEstimator
    name = {
        RobustLoss.HUBER: "Huber",
        RobustLoss.CAUCHY: "Cauchy",
        RobustLoss.GEMAN_MCCLURE: "GemanMcClure",
        RobustLoss.DCS: "DCS",
    }[settings.loss]
    return getattr(estimators, name)(settings.scale)


def to_factor_graph(graph: PoseGraph, robust: RobustSettings | None = None) -> Any:
    """Build GTSAM's factor graph: a BetweenFactor a constraint, NonlinearEquality on fixed nodes."""
    c = graph.constraints
    planar = graph.group.dimension == 2
    between = gtsam.BetweenFactorPose2 if planar else gtsam.BetweenFactorPose3
    hold = gtsam.NonlinearEqualityPose2 if planar else gtsam.NonlinearEqualityPose3
    models = noise_models(c.information)
    if robust is not None and robust.loss is not RobustLoss.NONE:
        estimator, wrap = _robust_estimator(robust), gtsam.noiseModel.Robust.Create
        for edge in np.flatnonzero(c.is_loop).tolist():
            models[edge] = wrap(estimator, models[edge])
    factors = gtsam.NonlinearFactorGraph()
    add = factors.add
    for i, j, pose, model in zip(c.i.tolist(), c.j.tolist(), to_poses(c.T_i_j), models, strict=True):
        add(between(i, j, pose, model))
    rows = np.flatnonzero(graph.fixed)
    for key, pose in zip(rows.tolist(), to_poses(graph.poses[rows]), strict=True):
        add(hold(key, pose))
    return factors


def chosen_ordering(graph: PoseGraph, ordering: EliminationOrdering) -> EliminationOrdering:
    """Resolve `AUTO` by the density of the graph."""
    if ordering is not EliminationOrdering.AUTO:
        return ordering
    dense = len(graph.constraints) > DENSE_EDGES_PER_NODE * len(graph)
    return EliminationOrdering.METIS if dense else EliminationOrdering.COLAMD


def _optimizer(
    factors: Any, values: Any, settings: SolverSettings, ordering: EliminationOrdering, *, orthogonal: bool
) -> Any:
    """Create the optimiser of the method asked for."""
    parameters: Any
    create: Any
    if settings.method is SolverMethod.LEVENBERG_MARQUARDT:
        parameters, create = gtsam.LevenbergMarquardtParams(), gtsam.LevenbergMarquardtOptimizer
        parameters.setlambdaInitial(settings.lambda_initial)
        parameters.setlambdaUpperBound(LAMBDA_UPPER_BOUND)
    elif settings.method is SolverMethod.GAUSS_NEWTON:
        parameters, create = gtsam.GaussNewtonParams(), gtsam.GaussNewtonOptimizer
    else:
        parameters, create = gtsam.DoglegParams(), gtsam.DoglegOptimizer
    # Inside one Levenberg-Marquardt iteration GTSAM gives up the search for lambda on changes below these.
    parameters.setRelativeErrorTol(settings.relative_tolerance)
    parameters.setAbsoluteErrorTol(settings.absolute_tolerance)
    parameters.setOrderingType(ordering.value.upper())
    if orthogonal:
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
    return create(factors, values, parameters)


def run_gtsam(
    graph: PoseGraph, settings: SolverSettings, progress: Progress, *, orthogonal: bool = False
) -> OptimizerRun:
    """Step a GTSAM optimiser until the cost stops falling; the best poses met are returned.

    `orthogonal` eliminates by QR instead of Cholesky: several times slower, for information that spans 1e12.

    The stop reason says only what the optimiser saw: `CONVERGED` is to be confirmed with the gradient.
    """
    start = time.perf_counter()
    factors, values = to_factor_graph(graph, settings.robust), to_values(graph.poses)
    ordering = chosen_ordering(graph, settings.ordering)
    optimizer = _optimizer(factors, values, settings, ordering, orthogonal=orthogonal)
    damped = settings.method is SolverMethod.LEVENBERG_MARQUARDT
    rows = [(optimizer.error(), settings.lambda_initial if damped else np.nan, time.perf_counter() - start)]
    size, best, reason = graph.group.matrix_size, graph.poses, StopReason.MAX_ITERATIONS
    for iteration in range(settings.max_iterations):
        try:
            optimizer.iterate()
        except RuntimeError:  # GTSAM's IndeterminantLinearSystemException: the system is singular here
            reason = StopReason.STALLED
            break
        before, now = rows[-1][0], optimizer.error()
        rows.append((now, optimizer.lambda_() if damped else np.nan, time.perf_counter() - start))
        progress("solve", iteration + 1, settings.max_iterations)
        if not np.isfinite(now) or now > before * (1 + settings.relative_tolerance) + settings.absolute_tolerance:
            reason = StopReason.DIVERGED
            break
        if now <= before:  # values() refers into the optimiser's state, which the next step frees: copy out now
            best = from_values(optimizer.values(), size)
        if before - now <= settings.relative_tolerance * before + settings.absolute_tolerance:
            reason = StopReason.CONVERGED
            break
    cost, lambda_, seconds = np.array(rows).T
    record = IterationRecord(cost=cost, lambda_=lambda_, seconds=seconds)
    return OptimizerRun(poses=best, stop_reason=reason, record=record)
