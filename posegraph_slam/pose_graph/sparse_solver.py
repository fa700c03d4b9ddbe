"""Levenberg-Marquardt and Gauss-Newton of our own: one symbolic analysis a graph, then numba from edges to step.

Damping (a multiple of the identity), its schedule and the acceptance of steps are GTSAM's, so that both solvers walk
from a start to the same optimum. Fixed nodes are left out of the system and so keep their poses exactly.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.execution import Progress
from posegraph_slam.pose_graph.block_cholesky import factorize
from posegraph_slam.pose_graph.block_pattern import BlockPattern, block_pattern
from posegraph_slam.pose_graph.block_substitution import solve_factored
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.linearization import (
    jacobians_at,
    moved_poses,
    normal_equations,
    residuals_at,
    squared_lengths,
)
from posegraph_slam.pose_graph.robust import RobustSettings, constraint_costs, constraint_weights
from posegraph_slam.pose_graph.solver_settings import (
    IterationRecord,
    OptimizerRun,
    SolverMethod,
    SolverSettings,
    StopReason,
)

LAMBDA_FACTOR = 10.0
LAMBDA_UPPER_BOUND = 1e5
LAMBDA_LOWER_BOUND = 1e-14
LEAST_FIDELITY = 1e-3
"""Smallest share of the predicted decrease that makes a step good."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FreeSystem:
    """The linear system of a graph's free nodes: their rows (n,), which edges (E,) join two of them, the pattern."""

    rows: IntArray
    inner: BoolArray
    pattern: BlockPattern


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearized:
    """Gradient (n, p), diagonal blocks (n, p, p) and off-diagonal blocks of the free nodes."""

    gradient: FloatArray
    diagonal: FloatArray
    off_diagonal: FloatArray


def free_system(graph: PoseGraph) -> FreeSystem:
    """Analyse the pattern of a graph's free nodes."""
    c = graph.constraints
    rows = np.flatnonzero(~graph.fixed)
    place = np.cumsum(~graph.fixed) - 1
    inner = ~(graph.fixed[c.i] | graph.fixed[c.j])
    pattern = block_pattern(len(rows), place[c.i[inner]], place[c.j[inner]], graph.group.dof)
    return FreeSystem(rows=rows, inner=inner, pattern=pattern)


def linearize(graph: PoseGraph, poses: FloatArray, system: FreeSystem, robust: RobustSettings) -> Linearized:
    """Sum up the normal equations of the free nodes at `poses` (N, d+1, d+1), with robust weights on loops."""
    c = graph.constraints
    residuals, by_i, by_j = jacobians_at(poses, c)
    weights = constraint_weights(c.is_loop, squared_lengths(residuals, c.information), robust)
    gradient, diagonal, off = normal_equations(
        len(graph), c.i, c.j, residuals, by_i, by_j, c.information, weights)  # fmt: skip
    return Linearized(gradient=gradient[system.rows], diagonal=diagonal[system.rows], off_diagonal=off[system.inner])


def cost_at(graph: PoseGraph, poses: FloatArray, robust: RobustSettings) -> float:
    """Return the cost of a graph at other poses."""
    c = graph.constraints
    return float(np.sum(constraint_costs(c.is_loop, squared_lengths(residuals_at(poses, c), c.information), robust)))


def run_sparse(graph: PoseGraph, settings: SolverSettings, progress: Progress) -> OptimizerRun:
    """Iterate until the cost stops falling; same meaning as `run_gtsam`. Knows no Dogleg."""
    begin = time.perf_counter()
    if graph.fixed.all():
        return _nothing_to_do(graph, settings)
    system, poses, robust = free_system(graph), graph.poses, settings.robust
    damped = settings.method is SolverMethod.LEVENBERG_MARQUARDT
    cost, damping = cost_at(graph, poses, robust), settings.lambda_initial if damped else 0.0
    rows = [(cost, damping, time.perf_counter() - begin)]
    reason = StopReason.MAX_ITERATIONS
    for iteration in range(settings.max_iterations):
        step = _step(graph, poses, cost, damping, system, settings)
        progress("solve", iteration + 1, settings.max_iterations)
        if step is None:
            reason = StopReason.STALLED if damped else StopReason.DIVERGED
            break
        before, (poses, cost, damping) = cost, step
        rows.append((cost, damping, time.perf_counter() - begin))
        if before - cost <= settings.relative_tolerance * before + settings.absolute_tolerance:
            reason = StopReason.CONVERGED
            break
    costs, dampings, seconds = np.array(rows).T
    record = IterationRecord(cost=costs, lambda_=dampings if damped else np.full(len(rows), np.nan), seconds=seconds)
    return OptimizerRun(poses=poses, stop_reason=reason, record=record)


def _step(
    graph: PoseGraph, poses: FloatArray, cost: float, damping: float, system: FreeSystem, settings: SolverSettings
) -> tuple[FloatArray, float, float] | None:
    """Return poses, cost and damping after a step, the old ones if the cost is level, None if no step lowers it."""
    linear = linearize(graph, poses, system, settings.robust)
    damped = settings.method is SolverMethod.LEVENBERG_MARQUARDT
    tolerance = settings.relative_tolerance * cost + settings.absolute_tolerance
    while True:
        factor = factorize(system.pattern, linear.diagonal, linear.off_diagonal, damping)
        if factor is not None:
            delta = -solve_factored(system.pattern, factor, linear.gradient)
            moved = moved_poses(poses, system.rows, delta)
            now = cost_at(graph, moved, settings.robust)
            predicted = 0.5 * float(np.sum(delta * (damping * delta - linear.gradient)))
            if now < cost and (not damped or cost - now > LEAST_FIDELITY * predicted):
                return moved, now, max(damping / LAMBDA_FACTOR, LAMBDA_LOWER_BOUND) if damped else 0.0
            if abs(cost - now) <= tolerance:
                return (moved, now, damping) if now < cost else (poses, cost, damping)
        if not damped or damping * LAMBDA_FACTOR > LAMBDA_UPPER_BOUND:
            return None
        damping *= LAMBDA_FACTOR


def _nothing_to_do(graph: PoseGraph, settings: SolverSettings) -> OptimizerRun:
    cost = np.array([cost_at(graph, graph.poses, settings.robust)])
    record = IterationRecord(cost=cost, lambda_=np.full(1, np.nan), seconds=np.zeros(1))
    return OptimizerRun(poses=graph.poses, stop_reason=StopReason.CONVERGED, record=record)
