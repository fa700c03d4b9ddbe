"""A pose graph that grows: each new node and its constraints update the solution by GTSAM's ISAM2."""

from __future__ import annotations

import time
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import ConfigurationError, GraphError
from posegraph_slam.execution import Progress
from posegraph_slam.geometry import Group
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph
from posegraph_slam.pose_graph.gtsam_solver import from_values, noise_models, to_poses
from posegraph_slam.pose_graph.robust import RobustLoss
from posegraph_slam.pose_graph.solver_settings import IterationRecord, OptimizerRun, SolverSettings, StopReason
from posegraph_slam.pose_graph.sparse_solver import cost_at

ANCHOR_VARIANCE = 1e-12
"""Variance of the prior on the first node: ISAM2 knows no exact constraints of its own for poses."""
RELINEARIZE_ABOVE = 0.01
"""Change of a node, in metres and radians, from which its constraints are linearised again."""
BATCHES = 50
"""Parts in which `run_incremental` adds a graph."""


class IncrementalSolver:
    """Holds the solution of a graph that grows; rows are numbered in the order in which nodes were added.

    `add` takes new nodes with their guesses and new constraints between any rows, old or new, and updates what they
    change; `poses` returns the estimate. The state is GTSAM's ISAM2 (Kaess et al. 2012), relinearised by threshold.
    """

    def __init__(self, group: Group, *, relinearize_above: float = RELINEARIZE_ABOVE) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(relinearize_above)
        parameters.relinearizeSkip = 1
        self._solver = gtsam.ISAM2(parameters)
        self._group, self._count = group, 0

    def __len__(self) -> int:
        return self._count

    def add(self, guesses: FloatArray, constraints: Constraints, *, updates: int = 1) -> None:
        """Add nodes at `guesses` (n, d+1, d+1) and constraints; `updates` more rounds of relinearisation.

        The first node ever added is held where its guess is. Raises `GraphError` for a constraint to a row that
        does not exist, and for new nodes that no constraint ties to the rest.
        """
        total = self._count + len(guesses)
        rows = np.concatenate([constraints.i, constraints.j])
        if len(rows) and (rows.min() < 0 or rows.max() >= total):
            raise GraphError("constraints", f"they join rows up to {rows.max()} of a graph of {total} nodes")
        untied = np.setdiff1d(np.arange(max(self._count, 1), total), rows)
        if len(untied):
            raise GraphError(f"row {untied[0]}", "no constraint ties it to the graph", "add them together")
        factors, values = self._factors(constraints), gtsam.Values()
        for key, pose in enumerate(to_poses(guesses), self._count):
            values.insert(key, pose)
        if self._count == 0 and len(guesses):
            planar = self._group.dimension == 2
            prior = gtsam.PriorFactorPose2 if planar else gtsam.PriorFactorPose3
            noise = gtsam.noiseModel.Isotropic.Variance(self._group.dof, ANCHOR_VARIANCE)
            factors.add(prior(0, to_poses(guesses[:1])[0], noise))
        self._solver.update(factors, values)
        self._count = total
        for _ in range(updates - 1):
            self.relinearize()

    def relinearize(self) -> None:
        """Linearise again what changed, and solve."""
        self._solver.update()

    def poses(self) -> FloatArray:
        """Return the estimate (N, d+1, d+1) of all nodes."""
        if self._count == 0:
            return self._group.identity(0)
        return from_values(self._solver.calculateEstimate(), self._group.matrix_size)

    def _factors(self, constraints: Constraints) -> Any:
        between = gtsam.BetweenFactorPose2 if self._group.dimension == 2 else gtsam.BetweenFactorPose3
        factors = gtsam.NonlinearFactorGraph()
        poses, models = to_poses(constraints.T_i_j), noise_models(constraints.information)
        for i, j, pose, model in zip(constraints.i.tolist(), constraints.j.tolist(), poses, models, strict=True):
            factors.add(between(i, j, pose, model))
        return factors


def run_incremental(graph: PoseGraph, settings: SolverSettings, progress: Progress) -> OptimizerRun:
    """Add a graph to ISAM2 batch by batch, breadth first from its fixed node, then relinearise until the cost is level.

    The poses of the graph are the guesses. Raises `ConfigurationError` unless just one node is fixed, and for losses.
    """
    if int(graph.fixed.sum()) != 1 or settings.robust.loss is not RobustLoss.NONE:
        raise ConfigurationError(
            "solver.method", "isam2 takes graphs with one fixed node and no loss", "set levenberg_marquardt"
        )
    began, c, n = time.perf_counter(), graph.constraints, len(graph)
    links = coo_array((np.ones(len(c), dtype=np.int8), (c.i, c.j)), shape=(n, n)).tocsr()
    order = breadth_first_order(links, int(np.argmax(graph.fixed)), directed=False, return_predecessors=False)
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    renamed = Constraints(i=place[c.i], j=place[c.j], T_i_j=c.T_i_j, information=c.information, kind=c.kind)
    later, solver = np.maximum(renamed.i, renamed.j), IncrementalSolver(graph.group, relinearize_above=1e-9)
    bounds = np.unique(np.linspace(0, n, BATCHES + 1).astype(np.int64))
    for number, (first, last) in enumerate(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)):
        new = renamed.select((later >= first) & (later < last))
        solver.add(graph.poses[order[first:last]], new)
        progress("solve", number, len(bounds) - 1)
    rows = [(cost_at(graph, graph.poses, settings.robust), np.nan, time.perf_counter() - began)]
    best, reason = np.array(graph.poses), StopReason.MAX_ITERATIONS
    for _ in range(settings.max_iterations):
        poses = np.empty_like(best)
        poses[order] = solver.poses()
        cost, before = cost_at(graph, poses, settings.robust), rows[-1][0]
        rows.append((cost, np.nan, time.perf_counter() - began))
        best = poses if cost <= min(row[0] for row in rows) else best
        if len(rows) > 2 and abs(before - cost) <= settings.relative_tolerance * before + settings.absolute_tolerance:
            reason = StopReason.CONVERGED
            break
        solver.relinearize()
    costs, damping, seconds = np.array(rows).T
    record = IterationRecord(cost=costs, lambda_=damping, seconds=seconds)
    return OptimizerRun(poses=best, stop_reason=reason, record=record)
