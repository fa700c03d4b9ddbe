"""From a graph as read to the best solution known and what is proven of it: start, false loops, solve, certify."""

from __future__ import annotations

import csv
import io
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import BoolArray, FloatArray, read_only
from posegraph_slam.errors import GraphError
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.pose_graph.certificate import Certificate, CertificateStatus, certify, with_status
from posegraph_slam.pose_graph.checks import check_graph
from posegraph_slam.pose_graph.graph import ConstraintKind, PoseGraph
from posegraph_slam.pose_graph.graph_file import node_ids, write_text
from posegraph_slam.pose_graph.linearization import chi2_at
from posegraph_slam.pose_graph.outliers import Classified, OutlierMethod, OutlierSettings, classify_loops, loop_weights
from posegraph_slam.pose_graph.solve import graph_cost, solve
from posegraph_slam.pose_graph.solver_settings import SolveResult, SolverSettings, StopReason
from posegraph_slam.pose_graph.starts import Start, starting_poses
from posegraph_slam.settings import Settings

SAME_COST = 1e-9
"""Relative difference below which two costs are the same optimum."""
SAME_BASIN_RAD = 0.2
"""Turn of any node between solution and chordal optimum from which both are compared by solving again."""


class OptimumSettings(Settings):
    """How the best solution of a graph is looked for."""

    start: Start = Field(default=Start.BEST, description="given, odometry, spanning_tree, chordal or best")
    certify: bool = Field(default=True, description="prove the solution optimal, or find a better one")
    solver: SolverSettings = Field(default=SolverSettings(), description="the solver")
    outliers: OutlierSettings = Field(default=OutlierSettings(), description="false loops")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Optimum:
    """The solved graph with all its edges, how it was reached, and what is known of it.

    `kept`, `chi2` and `weights` (E,) are for every edge; `error` is half the chi-square of the kept edges (under a
    loss, its cost), `error_initial` the same of the graph as given.
    """

    graph: PoseGraph
    start: Start
    error_initial: float
    error: float
    iterations: int
    result: SolveResult
    kept: BoolArray
    chi2: FloatArray
    weights: FloatArray
    classified: Classified | None
    certificate: Certificate | None
    seconds: dict[str, float]
    notes: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "kept", read_only(self.kept, np.bool_))
        for name in ("chi2", "weights"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def stop_reason(self) -> str:
        """Why the last solver stopped; `already_optimal` only where the graph as given was."""
        reason = self.result.stop_reason
        if reason is StopReason.ALREADY_OPTIMAL and self.error < self.error_initial * (1 - SAME_COST):
            reason = StopReason.CONVERGED
        return reason.value

    @property
    def kept_graph(self) -> PoseGraph:
        """The solved graph without the rejected edges."""
        return self.graph.with_constraints(self.graph.constraints.select(self.kept))


def find_optimum(
    graph: PoseGraph, settings: OptimumSettings | None = None, *, progress: Progress = silent_progress
) -> Optimum:
    """Solve a graph from the best start, without its false loops if asked for, and certify the solution.

    Where the certificate leads to a better basin, that solution is returned (`SUBOPTIMAL` tells so). Raises
    `GraphError` for a graph that cannot be solved.
    """
    settings = OptimumSettings() if settings is None else settings
    check_graph(graph)
    clock, seconds, solver = time.perf_counter, {}, settings.solver
    if settings.outliers.loss is not None:
        solver = solver.model_copy(update={"robust": settings.outliers.loss})
    robust = settings.outliers.method is not OutlierMethod.NONE
    began = clock()
    poses, start = _start(graph, settings.start, robust=robust)
    seconds["init"], began = clock() - began, clock()
    classified, kept = None, np.ones(len(graph.constraints), dtype=np.bool_)
    if settings.outliers.method in (OutlierMethod.GNC, OutlierMethod.AUTO):
        classified = classify_loops(graph.with_poses(poses), settings.outliers, solver, progress=progress)
        kept, poses = np.array(classified.kept), classified.poses
    used = graph.with_constraints(graph.constraints.select(kept))
    result = solve(used.with_poses(poses), solver, progress=progress)
    seconds["solve"], began = clock() - began, clock()
    certificate = None
    iterations = result.iterations
    if settings.certify and solver.robust.loss.value == "none":
        relaxed = start is Start.CHORDAL
        result, certificate, extra = _certified(used, result, solver, progress, from_relaxation=relaxed)
        iterations += extra
    seconds["certify"] = clock() - began
    solved = graph.with_poses(result.poses)
    return Optimum(
        graph=solved, start=start, error_initial=graph_cost(used, solver.robust), error=result.cost,
        iterations=iterations, result=result, kept=kept,
        chi2=chi2_at(result.poses, graph.constraints),
        weights=loop_weights(solved, settings.outliers, kept), classified=classified, certificate=certificate,
        seconds=seconds, notes=result.notes)  # fmt: skip


def _start(graph: PoseGraph, start: Start, *, robust: bool) -> tuple[FloatArray, Start]:
    """Return the start; `BEST` is the odometry chain where loops may be false, as all others follow them."""
    if robust and start is Start.BEST:
        odometry = graph.with_constraints(graph.constraints.select(~graph.constraints.is_loop))
        try:
            return starting_poses(odometry, Start.ODOMETRY)
        except GraphError:  # without its loops the graph falls apart
            return starting_poses(graph, Start.ODOMETRY)
    return starting_poses(graph, start)


def _certified(
    graph: PoseGraph, result: SolveResult, solver: SolverSettings, progress: Progress, *, from_relaxation: bool
) -> tuple[SolveResult, Certificate, int]:
    """Certify a solution; where the proven chordal optimum lies elsewhere, solve from there and keep the better one."""
    certificate = certify(graph.with_poses(result.poses), from_relaxation=from_relaxation)
    if not certificate.proven or certificate.rank == 0:
        return result, certificate, 0
    if certificate.status is CertificateStatus.CERTIFIED and _turn(result.poses, certificate.poses) < SAME_BASIN_RAD:
        return result, certificate, 0
    again = solve(graph.with_poses(certificate.poses), solver, progress=progress)
    if again.cost < result.cost * (1 - SAME_COST):
        reason = f"a better basin was found and used: {again.cost:.9g} instead of {result.cost:.9g}"
        return again, with_status(certificate, CertificateStatus.SUBOPTIMAL, reason), again.iterations
    if again.cost <= result.cost * (1 + SAME_COST):
        return result, with_status(certificate, CertificateStatus.CERTIFIED, ""), again.iterations
    reason = f"the proven chordal optimum leads to a higher cost under the full information, {again.cost:.9g}"
    return result, with_status(certificate, CertificateStatus.UNKNOWN, reason), again.iterations


def _turn(a: FloatArray, b: FloatArray) -> float:
    """Return the largest angle between the rotations of two sets of poses."""
    d = a.shape[-1] - 1
    trace = np.einsum("nij,nij->n", a[:, :d, :d], b[:, :d, :d])
    return float(np.max(np.arccos(np.clip((trace - (d - 2)) / 2, -1.0, 1.0)), initial=0.0))


def write_edges(optimum: Optimum, path: Path) -> None:
    """Write one row an edge: number, ids of its nodes, kind, chi-square, weight, 1 if it was kept."""
    c, ids = optimum.graph.constraints, node_ids(optimum.graph)
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["edge", "i", "j", "kind", "chi2", "weight", "kept"])
    kinds = [ConstraintKind(kind).name.lower() for kind in c.kind.tolist()]
    rows.writerows(
        zip(range(len(c)), ids[c.i].tolist(), ids[c.j].tolist(), kinds, map(repr, optimum.chi2.tolist()),
            map(repr, optimum.weights.tolist()), optimum.kept.astype(int).tolist(), strict=True))  # fmt: skip
    write_text(path, text.getvalue())
