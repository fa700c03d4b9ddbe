"""Solving a pose graph: checks, the optimiser, and the proof that it did its work."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from posegraph_slam.errors import ConfigurationError
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.pose_graph.checks import check_graph
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph
from posegraph_slam.pose_graph.gtsam_solver import chosen_ordering, run_gtsam
from posegraph_slam.pose_graph.incremental import run_incremental
from posegraph_slam.pose_graph.linearization import block_decrease, chi2_at, normal_equations
from posegraph_slam.pose_graph.robust import RobustSettings, constraint_costs, constraint_weights
from posegraph_slam.pose_graph.solver_settings import (
    EliminationOrdering,
    OptimizerRun,
    SolveResult,
    SolverKind,
    SolverMethod,
    SolverSettings,
    StopReason,
)
from posegraph_slam.pose_graph.sparse_solver import cost_at, run_sparse

OPTIMALITY_TOLERANCE = 1e-6
"""Largest share of the cost that a move of the nodes one by one may still promise at an optimum."""
OPTIMALITY_FLOOR = 1e-9
"""The same in absolute terms, for graphs that fit perfectly."""
CLAMPS = (1e2, 1e5)
"""Caps on information eigenvalues, over the median of the edges' largest, of the starts tried after a stall."""


def solve(
    graph: PoseGraph, settings: SolverSettings | None = None, *, progress: Progress = silent_progress
) -> SolveResult:
    """Minimise the sum of rho(sqrt(chi2)) over all poses of a graph but the fixed ones; SE(2) and SE(3) alike.

    The graph is checked first (`GraphError`). Loop constraints are under the robust loss of the settings; fixed nodes
    keep their poses exactly. The result never costs more than the start. GTSAM can return its start without an
    error (an information eigenvalue of 1e12 suffices); this is recognised by the gradient, then other orderings and a
    start from the graph with clamped information are tried, and what remains is said in `stop_reason` and `notes`.
    """
    settings = SolverSettings() if settings is None else settings
    check_graph(graph)
    best, notes = _run(graph, settings, progress), []
    cost_initial, best_cost = float(best.record.cost[0]), _cost_of(graph, best, settings)
    optimal, warm = _is_optimum(graph, best, best_cost, settings), best.poses
    for attempt in _attempts(graph, settings, best.stop_reason) if settings.retry and not optimal else ():
        notes.append(attempt.note)
        if attempt.easier is not None:  # each easier graph starts where the one before ended: a continuation
            warm = _run(attempt.easier.with_poses(warm), attempt.settings, progress).poses
        start = graph.with_poses(best.poses if attempt.easier is None else warm)
        run = _run(start, attempt.settings, progress, orthogonal=attempt.orthogonal)
        cost = _cost_of(graph, run, settings)
        if cost < best_cost:
            best, best_cost = run, cost
            optimal = _is_optimum(graph, best, best_cost, settings)
        if optimal:
            break
    return _result(graph, settings, cost_initial, best, optimal, tuple(notes))


def chosen_kind(settings: SolverSettings) -> SolverKind:
    """Resolve `AUTO`: the sparse solver, which is faster than GTSAM on every graph tried, for the methods it knows."""
    foreign = settings.method in (SolverMethod.DOGLEG, SolverMethod.ISAM2)
    if settings.kind is SolverKind.AUTO:
        return SolverKind.GTSAM if foreign else SolverKind.SPARSE
    if settings.kind is SolverKind.SPARSE and foreign:
        raise ConfigurationError(
            "solver.method", f"the sparse solver knows no {settings.method.value}", "set solver.kind = gtsam or auto"
        )
    return settings.kind


def graph_cost(graph: PoseGraph, robust: RobustSettings | None = None) -> float:
    """Return the cost of a graph at its poses: half the sum of chi-square, with the loss on loops if given."""
    robust = RobustSettings() if robust is None else robust
    return cost_at(graph, graph.poses, robust)


def possible_decrease(graph: PoseGraph, robust: RobustSettings | None = None) -> float:
    """Estimate the cost that moving each node alone would save, to first order: 1/2 sum g^T H^-1 g over its block.

    It is near zero only where the gradient is, is free of units, and so tells an optimum from a stalled solver.
    """
    c = graph.constraints
    weights = constraint_weights(c.is_loop, chi2_at(graph.poses, c), RobustSettings() if robust is None else robust)
    linear = normal_equations(graph.poses, c, weights)
    return float(block_decrease(linear.gradient, linear.diagonal, ~graph.fixed))


def clamp_information(constraints: Constraints, largest: float) -> Constraints:
    """Return the constraints with the eigenvalues of their information limited to `largest`."""
    values, vectors = np.linalg.eigh(constraints.information)
    clamped = (vectors * np.minimum(values, largest)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    changed = (values[:, -1] > largest)[:, None, None]
    information = np.where(changed, 0.5 * (clamped + np.swapaxes(clamped, 1, 2)), constraints.information)
    return Constraints(
        i=constraints.i, j=constraints.j, T_i_j=constraints.T_i_j, information=information, kind=constraints.kind
    )


def _run(graph: PoseGraph, settings: SolverSettings, progress: Progress, *, orthogonal: bool = False) -> OptimizerRun:
    if chosen_kind(settings) is SolverKind.SPARSE:
        return run_sparse(graph, settings, progress)
    if settings.method is SolverMethod.ISAM2:
        return run_incremental(graph, settings, progress)
    return run_gtsam(graph, settings, progress, orthogonal=orthogonal)


def _cost_of(graph: PoseGraph, run: OptimizerRun, settings: SolverSettings) -> float:
    return graph_cost(graph.with_poses(run.poses), settings.robust)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Attempt:
    """Something to try after a stall: a graph to solve first for a start, if any, and how to solve from there."""

    note: str
    settings: SolverSettings
    easier: PoseGraph | None = None
    orthogonal: bool = False


def _attempts(graph: PoseGraph, settings: SolverSettings, reason: StopReason) -> Iterator[_Attempt]:
    """Yield what to try: the other ordering, then starts with clamped information, then QR instead of Cholesky."""
    damped = settings.model_copy(update={"method": SolverMethod.LEVENBERG_MARQUARDT})
    metis, colamd = EliminationOrdering.METIS, EliminationOrdering.COLAMD
    other = colamd if chosen_ordering(graph, settings.ordering) is metis else metis
    if reason is not StopReason.MAX_ITERATIONS:
        changes = {"ordering": other, "kind": SolverKind.GTSAM}
        yield _Attempt(note=f"tried GTSAM with {other} ordering", settings=damped.model_copy(update=changes))
    largest = np.linalg.eigvalsh(graph.constraints.information)[:, -1]
    caps = [factor * float(np.median(largest)) for factor in CLAMPS]
    for cap in (cap for cap in caps if np.any(largest > cap)):
        clamped = graph.with_constraints(clamp_information(graph.constraints, cap))
        note = f"tried a start with information clamped at {cap:.3g}"
        yield _Attempt(note=note, settings=damped, easier=clamped)
    if np.any(largest > caps[-1]):
        gtsam = damped.model_copy(update={"kind": SolverKind.GTSAM})
        yield _Attempt(note="tried GTSAM with QR elimination", settings=gtsam, orthogonal=True)


def _is_optimum(graph: PoseGraph, run: OptimizerRun, cost: float, settings: SolverSettings) -> bool:
    saved = run.possible_decrease
    if saved is None:
        saved = possible_decrease(graph.with_poses(run.poses), settings.robust)
    return saved <= OPTIMALITY_TOLERANCE * cost + OPTIMALITY_FLOOR


def _result(
    graph: PoseGraph,
    settings: SolverSettings,
    cost_initial: float,
    run: OptimizerRun,
    optimal: bool,
    notes: tuple[str, ...],
) -> SolveResult:
    poses = np.where(graph.fixed[:, None, None], graph.poses, run.poses)
    squared = chi2_at(poses, graph.constraints)
    cost = float(np.sum(constraint_costs(graph.constraints.is_loop, squared, settings.robust)))
    reason = run.stop_reason
    if optimal and reason is not StopReason.MAX_ITERATIONS:
        unchanged = cost_initial - cost <= settings.relative_tolerance * cost_initial + settings.absolute_tolerance
        reason = StopReason.ALREADY_OPTIMAL if unchanged else StopReason.CONVERGED
    elif not optimal and reason is StopReason.CONVERGED:
        reason = StopReason.STALLED
    return SolveResult(
        poses=poses,
        cost_initial=cost_initial,
        cost=cost,
        iterations=len(run.record.cost) - 1,
        stop_reason=reason,
        record=run.record,
        chi2=squared,
        weights=constraint_weights(graph.constraints.is_loop, squared, settings.robust),
        notes=notes,
    )
