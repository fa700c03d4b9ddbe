"""Levenberg-Marquardt and Gauss-Newton of our own: one symbolic analysis a graph, then numba from edges to step.

Damping (a multiple of the identity), its schedule and the acceptance of steps are GTSAM's, so that both solvers walk
from a start to the same optimum. Fixed nodes are left out of the system and so keep their poses exactly.
"""

from __future__ import annotations

import time

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.execution import Progress
from posegraph_slam.pose_graph.block_cholesky import factorize
from posegraph_slam.pose_graph.block_pattern import BlockPattern, block_pattern
from posegraph_slam.pose_graph.block_substitution import solve_factored
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.linearization import (
    NormalEquations,
    block_decrease,
    chi2_at,
    moved_poses,
    normal_equations,
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
SCREEN = 1e3
"""A decrease that shrinks as the last one did must come so close to the tolerance for the next to be estimated."""


def free_pattern(graph: PoseGraph) -> BlockPattern:
    """Analyse the normal equations of a graph's free nodes, of which there must be one."""
    c = graph.constraints
    return block_pattern(len(graph), c.i, c.j, graph.group.dof, kept=~graph.fixed)


def cost_at(graph: PoseGraph, poses: FloatArray, robust: RobustSettings) -> float:
    """Return the cost of a graph at other poses."""
    squared = chi2_at(poses, graph.constraints)
    return float(np.sum(constraint_costs(graph.constraints.is_loop, squared, robust)))


def run_sparse(graph: PoseGraph, settings: SolverSettings, progress: Progress) -> OptimizerRun:
    """Iterate until the cost stops falling; same meaning as `run_gtsam`. Knows no Dogleg.

    Near the optimum the gradient and the last factor give another step and what it saves, without a factorisation: if
    that is below the tolerance, the step is the last.
    """
    begin = time.perf_counter()
    if graph.fixed.all():
        return _nothing_to_do(graph, settings)
    pattern, state = free_pattern(graph), _State(graph, np.array(graph.poses), settings)
    damped = settings.method is SolverMethod.LEVENBERG_MARQUARDT
    rows = [(state.cost, state.damping, time.perf_counter() - begin)]
    reason, gain, left = StopReason.MAX_ITERATIONS, np.inf, None
    for iteration in range(settings.max_iterations):
        step = _step(graph, state, pattern, settings)
        progress("solve", iteration + 1, settings.max_iterations)
        if step is None:
            reason = StopReason.STALLED if damped else StopReason.DIVERGED
            break
        before, last, state = state.cost, gain, step
        rows.append((state.cost, state.damping, time.perf_counter() - begin))
        gain, tolerance = before - state.cost, settings.relative_tolerance * before + settings.absolute_tolerance
        near = gain * (gain / last if gain < last < np.inf else 1.0) <= SCREEN * tolerance
        if gain > tolerance and near and (end := state.repeated(graph, pattern, settings, tolerance)) is not None:
            left, state = state.possible_decrease(graph, settings), end
            rows.append((state.cost, state.damping, time.perf_counter() - begin))
            gain = 0.0
        if gain <= tolerance:
            reason = StopReason.CONVERGED
            break
    costs, dampings, seconds = np.array(rows).T
    record = IterationRecord(cost=costs, lambda_=dampings if damped else np.full(len(rows), np.nan), seconds=seconds)
    return OptimizerRun(poses=state.poses, stop_reason=reason, record=record, possible_decrease=left)


class _State:
    """Where a solver stands: poses, chi-square of every constraint, cost, damping, and the factor that led there.

    The normal equations are made when first asked for, and kept.
    """

    def __init__(
        self,
        graph: PoseGraph,
        poses: FloatArray,
        settings: SolverSettings,
        damping: float | None = None,
        factor: FloatArray | None = None,
    ) -> None:
        first = settings.lambda_initial if settings.method is SolverMethod.LEVENBERG_MARQUARDT else 0.0
        self.damping = first if damping is None else damping
        self.poses, self.factor, self.chi2 = poses, factor, chi2_at(poses, graph.constraints)
        self.cost = float(np.sum(constraint_costs(graph.constraints.is_loop, self.chi2, settings.robust)))
        self._linear: NormalEquations | None = None

    def linear(self, graph: PoseGraph, settings: SolverSettings) -> NormalEquations:
        """Return the normal equations here."""
        if self._linear is None:
            c = graph.constraints
            weights = constraint_weights(c.is_loop, self.chi2, settings.robust)
            self._linear = normal_equations(self.poses, c, weights)
        return self._linear

    def repeated(
        self, graph: PoseGraph, pattern: BlockPattern, settings: SolverSettings, tolerance: float
    ) -> _State | None:
        """Return the state after a step with the factor of the last one, None if it promises more than `tolerance`."""
        if self.factor is None:
            return None
        gradient = self.linear(graph, settings).gradient
        delta = -solve_factored(pattern, self.factor, gradient)
        if -0.5 * float(np.sum(gradient * delta)) > tolerance:
            return None
        end = _State(graph, moved_poses(self.poses, delta), settings, self.damping)
        return end if end.cost < self.cost else self

    def possible_decrease(self, graph: PoseGraph, settings: SolverSettings) -> float:
        """Return what moving each node alone would save, to first order."""
        linear = self.linear(graph, settings)
        return float(block_decrease(linear.gradient, linear.diagonal, ~graph.fixed))


def _step(graph: PoseGraph, state: _State, pattern: BlockPattern, settings: SolverSettings) -> _State | None:
    """Return the state after a step, the old one if the cost is level, None if no step lowers it."""
    linear, damping, cost = state.linear(graph, settings), state.damping, state.cost
    damped = settings.method is SolverMethod.LEVENBERG_MARQUARDT
    tolerance = settings.relative_tolerance * cost + settings.absolute_tolerance
    while True:
        factor = factorize(pattern, linear.diagonal, linear.off_diagonal, damping)
        if factor is not None:
            delta = -solve_factored(pattern, factor, linear.gradient)
            less = max(damping / LAMBDA_FACTOR, LAMBDA_LOWER_BOUND) if damped else 0.0
            moved = _State(graph, moved_poses(state.poses, delta), settings, less, factor)
            predicted = 0.5 * float(np.sum(delta * (damping * delta - linear.gradient)))
            if moved.cost < cost and (not damped or cost - moved.cost > LEAST_FIDELITY * predicted):
                return moved
            if abs(cost - moved.cost) <= tolerance:
                return moved if moved.cost < cost else state
        if not damped or damping * LAMBDA_FACTOR > LAMBDA_UPPER_BOUND:
            return None
        damping *= LAMBDA_FACTOR


def _nothing_to_do(graph: PoseGraph, settings: SolverSettings) -> OptimizerRun:
    cost = np.array([cost_at(graph, graph.poses, settings.robust)])
    record = IterationRecord(cost=cost, lambda_=np.full(1, np.nan), seconds=np.zeros(1))
    return OptimizerRun(poses=graph.poses, stop_reason=StopReason.CONVERGED, record=record)
