"""Where a solver starts: the poses given, the odometry chain, a spanning tree, or the chordal relaxation."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import GraphError
from posegraph_slam.execution import silent_progress
from posegraph_slam.pose_graph.checks import check_graph
from posegraph_slam.pose_graph.chordal import chordal_poses
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.initialization import propagate_poses, spread_poses
from posegraph_slam.pose_graph.solver_settings import SolverSettings
from posegraph_slam.pose_graph.sparse_solver import cost_at, run_sparse

TRIAL_ITERATIONS = 3
"""Steps given to each start before `BEST` compares their costs: what a start is worth shows only after some."""

SETTLED = 0.5
"""A chordal start whose last step lowered the cost by less than this share is near its optimum."""


class Start(StrEnum):
    """Which poses a solver starts from."""

    GIVEN = "given"
    ODOMETRY = "odometry"
    """Constraints composed in their order from the fixed nodes on."""
    SPANNING_TREE = "spanning_tree"
    """Constraints composed breadth first: the fewest from a fixed node to each other one."""
    CHORDAL = "chordal"
    """Rotations, then translations, by linear least squares."""
    BEST = "best"
    """That of the above which costs least after a few steps; only the promising ones are tried."""


def starting_poses(graph: PoseGraph, start: Start) -> tuple[FloatArray, Start]:
    """Return poses (N, d+1, d+1) to start from, and which start they are (the winner for `BEST`).

    Raises `GraphError` for a graph that cannot be solved.
    """
    check_graph(graph)
    return _best(graph) if start is Start.BEST else (_poses(graph, start), start)


def _poses(graph: PoseGraph, start: Start) -> FloatArray:
    if start is Start.GIVEN:
        return graph.poses
    if start is Start.ODOMETRY:
        return propagate_poses(graph.group, graph.poses, graph.fixed, graph.constraints)
    if start is Start.SPANNING_TREE:
        return spread_poses(graph.group, graph.poses, graph.fixed, graph.constraints)
    return chordal_poses(graph)


def _best(graph: PoseGraph) -> tuple[FloatArray, Start]:
    """Try the chordal start, which leads to the best known cost nearly always, and others where they promise more.

    A start is promising if it costs less than the chordal one after its steps; if that one still falls, all are tried.
    """
    settings = SolverSettings(max_iterations=TRIAL_ITERATIONS)
    found: list[tuple[float, FloatArray, Start]] = []
    limit = np.inf
    for start in (Start.CHORDAL, Start.GIVEN, Start.ODOMETRY, Start.SPANNING_TREE):
        try:
            poses = _poses(graph, start)
        except GraphError:
            continue
        cost = cost_at(graph, poses, settings.robust)
        if not cost < limit:
            continue
        run = run_sparse(graph.with_poses(poses), settings, silent_progress)
        costs = run.record.cost
        found.append((float(costs[-1]), run.poses, start))
        settled = len(costs) < 2 or costs[-2] - costs[-1] <= SETTLED * costs[-1]
        if start is Start.CHORDAL and settled:
            limit = float(costs[-1])
    ranked = [entry[0] if np.isfinite(entry[0]) else np.inf for entry in found]
    _, poses, winner = found[int(np.argmin(ranked))]
    return poses, winner
