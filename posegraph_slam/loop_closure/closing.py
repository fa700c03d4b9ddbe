"""Propose, register, verify and solve, in rounds, until no new closure is found."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress
from posegraph_slam.geometry import SE2
from posegraph_slam.loop_closure.innovation import innovation, linearise
from posegraph_slam.loop_closure.ledger import Ledger, LoopRecord
from posegraph_slam.loop_closure.matching import constraints_of, register_candidates
from posegraph_slam.loop_closure.proposals import (
    Candidates,
    narrowed,
    propose_fixed_interval,
    propose_proximity,
    propose_start_end,
)
from posegraph_slam.loop_closure.settings import LoopClosureSettings, VerificationSettings
from posegraph_slam.loop_closure.verification import (
    Apart,
    apart_reasons,
    chi2_gate,
    consistency_reasons,
    count_support,
    first_reasons,
    gaussian_sigmas,
    passing,
    rejection_reasons,
    surprise_reasons,
)
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph
from posegraph_slam.pose_graph.residuals import chi2
from posegraph_slam.pose_graph.solve import solve
from posegraph_slam.pose_graph.solver_settings import SolveResult, SolverSettings
from posegraph_slam.registration.beam_scans import BeamScans

SETTLING_ROUNDS = 12
"""Solutions at most until the set of closures that agree stays the same."""
WORST_SHARE = 0.25
"""Closures are dropped together when their chi-square is at least this share of the worst."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopClosureResult:
    """The graph with its accepted closures, solved, and the record of every candidate."""

    graph: PoseGraph
    records: tuple[LoopRecord, ...]
    rounds: int
    solution: SolveResult

    def summary(self) -> dict[str, Any]:
        """Return counts of the candidates, in all and by kind, and how the solver fared."""
        proposed = Counter(record.kind for record in self.records)
        accepted = Counter(record.kind for record in self.records if record.accepted)
        return {
            "loops_proposed": proposed.total(),
            "loops_accepted": accepted.total(),
            "loops_by_kind": {
                kind: {"proposed": proposed[kind], "accepted": accepted[kind]} for kind in sorted(proposed)
            },
            "loop_rounds": self.rounds,
            "graph_cost_initial": self.solution.cost_initial,
            "graph_cost": self.solution.cost,
            "solver_stop_reason": str(self.solution.stop_reason),
        }

    def warnings(self) -> list[str]:
        """Return what a user should look at in the solution, in plain sentences."""
        notes = list(self.solution.notes)
        if not self.solution.converged:
            notes.append(f"the pose graph did not converge: {self.solution.stop_reason}")
        return notes


def close_loops(
    graph: PoseGraph,
    scans: BeamScans,
    settings: LoopClosureSettings,
    solver: SolverSettings,
    *,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
    apart: Apart | None = None,
) -> LoopClosureResult:
    """Add loop closures to a chain of keyframes: `graph` (K nodes, base poses) and their `scans` (K).

    Short loops come first: each round takes the pairs with less uncovered travel than a limit that doubles when a
    round brings nothing new. What disagrees with the solved graph is taken out again. Pairs that are `apart` are
    refused, whatever their scans say.
    """
    executor = executor or SerialExecutor()
    chain, ledger = graph.constraints, Ledger()
    steps = np.linalg.norm(np.diff(graph.poses[:, :2, 2], axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(steps)])
    closures = Constraints.empty(graph.group)
    limit, round_ = settings.proposals.travel_first_m, 0
    while round_ < settings.proposals.rounds_max and settings.enabled:
        progress("loop closure", round_, settings.proposals.rounds_max)
        candidates = _propose(graph, path_m, closures, limit, first=round_ == 0, settings=settings)
        candidates = candidates.select(ledger.untried(candidates))
        refused = apart_reasons(candidates, graph.poses, apart)
        found = _verify(candidates, graph, scans, path_m, round_, ledger, settings.verification, executor, refused)
        if len(found):
            closures = Constraints.concatenate([closures, found])
            graph, sigmas, kept = settle(graph, chain, closures, solver, settings.verification.sigma_max)
            ledger.settle(sigmas, kept)
            closures = closures.select(kept)
        round_ += 1
        if not len(found):
            if limit > path_m[-1]:
                break
            limit *= 2
    graph = graph.with_constraints(Constraints.concatenate([chain, closures]))
    solution = solve(graph, solver)
    progress("loop closure", settings.proposals.rounds_max, settings.proposals.rounds_max)
    return LoopClosureResult(
        graph=graph.with_poses(solution.poses), records=tuple(ledger.records), rounds=round_, solution=solution
    )


def _propose(
    graph: PoseGraph,
    path_m: FloatArray,
    closures: Constraints,
    limit_m: float,
    *,
    first: bool,
    settings: LoopClosureSettings,
) -> Candidates:
    parts = []
    if first:
        parts.append(propose_fixed_interval(path_m, settings.proposals))
    if settings.proposals.start_end and limit_m > path_m[-1]:
        parts.append(propose_start_end(path_m, settings.proposals))
    if settings.proposals.proximity:
        parts.append(propose_proximity(graph.poses[:, :2, 2], path_m, closures, limit_m, settings.proposals))
    return Candidates.concatenate(parts or [propose_start_end(path_m[:1], settings.proposals)])


def _verify(
    candidates: Candidates,
    graph: PoseGraph,
    scans: BeamScans,
    path_m: FloatArray,
    round_: int,
    ledger: Ledger,
    settings: VerificationSettings,
    executor: Executor,
    refused: list[str],
) -> Constraints:
    """Register the candidates and return those that pass as constraints between base poses, none of the `refused`."""
    lidar = graph.poses @ scans.T_base_lidar
    linear = linearise(graph, settings.drift)
    covariance = linear.relative_covariance(candidates.target, candidates.source)
    candidates = narrowed(candidates, covariance)
    evidence = register_candidates(candidates, scans, lidar, settings, executor)
    constraints = constraints_of(
        candidates, evidence, scans, settings.covariance_floor_m, settings.covariance_floor_rad
    )
    reasons = first_reasons(refused, rejection_reasons(candidates, evidence, settings))
    sigmas = gaussian_sigmas(innovation(linear, constraints, covariance), graph.group.dof)
    sigmas[~passing(reasons)] = np.nan
    reasons = first_reasons(reasons, surprise_reasons(sigmas, settings))
    agree, disagree = count_support(candidates, evidence.T_target_source, lidar, path_m, passing(reasons), settings)
    reasons = first_reasons(reasons, consistency_reasons(candidates, agree, disagree, settings))
    guess = SE2.between(lidar[candidates.target], lidar[candidates.source])
    error = SE2.local(guess, evidence.T_target_source)
    ledger.add(round_, candidates, evidence, error_before=error, sigmas_before=sigmas, reasons=reasons)
    return constraints.select(passing(reasons))


def settle(
    graph: PoseGraph, chain: Constraints, closures: Constraints, solver: SolverSettings, sigma_max: float
) -> tuple[PoseGraph, FloatArray, BoolArray]:
    """Solve with all closures, then without those beyond the gate, worst first, taking back those that fit in the end.

    Returns the solved graph with the kept closures, and for each closure its distance from that solution in
    sigmas (C,) and whether it is kept (C,).
    """
    gate = chi2_gate(sigma_max, graph.group.dof)
    everything = graph.with_constraints(Constraints.concatenate([chain, closures]))
    kept = np.ones(len(closures), dtype=np.bool_)
    for _ in range(SETTLING_ROUNDS):
        graph = everything.with_constraints(Constraints.concatenate([chain, closures.select(kept)]))
        graph = graph.with_poses(solve(graph.with_poses(everything.poses), solver).poses)
        everything = everything.with_poses(graph.poses)
        squared = chi2(everything)[len(chain) :]
        worst = float(np.max(squared[kept], initial=0.0))
        fits = squared <= max(gate, WORST_SHARE * worst)
        if np.array_equal(fits, kept) and worst <= gate:
            break
        kept = fits
    else:
        kept = squared <= gate
        graph = everything.with_constraints(Constraints.concatenate([chain, closures.select(kept)]))
    return graph, gaussian_sigmas(squared, graph.group.dof), kept
