"""Matching again all keyframes that overlap in the optimised map (Lu and Milios 1997, with point-to-line matches)."""

from __future__ import annotations

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from posegraph_slam.arrays import IntArray
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress
from posegraph_slam.geometry import wrap_angle, xyt_from_pose
from posegraph_slam.loop_closure.matching import constraints_of, register_candidates
from posegraph_slam.loop_closure.proposals import Candidates
from posegraph_slam.loop_closure.settings import VerificationSettings
from posegraph_slam.loop_closure.transients import without_transients
from posegraph_slam.loop_closure.verification import Apart, apart_reasons, chi2_gate, passing, rejection_reasons
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.residuals import chi2, constraint_residuals
from posegraph_slam.pose_graph.solve import solve
from posegraph_slam.pose_graph.solver_settings import SolverSettings
from posegraph_slam.registration.beam_scans import BeamScans
from posegraph_slam.settings import Settings

NEAREST = 64
"""Keyframes nearest to one that are looked at: in a place visited ten times, those of all visits."""
RECENT = 10
"""Keyframes fewer than this apart belong to one visit."""


class RefinementSettings(Settings):
    """Which overlapping keyframes are matched again, and how often."""

    rounds: int = Field(default=1, ge=0, le=20)
    """Rounds of matching and solving; 0 switches the refinement off."""
    neighbours: int = Field(default=6, ge=1, le=32)
    """Keyframes of the same visit that each keyframe is matched to,"""
    revisits: int = Field(default=6, ge=0, le=32)
    """and keyframes of other visits."""
    distance_max_m: float = Field(default=3.0, gt=0)
    """Keyframes further apart are not matched,"""
    turn_max_rad: float = Field(default=1.6, gt=0)
    """nor those that look further apart than this."""
    seen_through_min: int = Field(default=2, ge=0)
    """Points that at least so many other keyframes look through, and more than confirm them, are left out of these
    matches: people, doors, glass. 0 keeps all."""
    moved_max_m: float = Field(default=0.2, gt=0)
    """A match that moves a pair further has slipped along a wall: the graph is already right to centimetres."""
    covariance_floor_m: float = Field(default=0.01, gt=0)
    """A match is not known better than this,"""
    covariance_floor_rad: float = Field(default=0.003, gt=0)
    """nor than this."""


def refine_overlaps(
    graph: PoseGraph,
    scans: BeamScans,
    settings: RefinementSettings,
    verification: VerificationSettings,
    solver: SolverSettings,
    *,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
    apart: Apart | None = None,
) -> PoseGraph:
    """Add the matches of overlapping keyframes to a graph that is right up to centimetres, and solve it again.

    `graph` (K nodes, base poses) and `scans` (K). Each round replaces the matches of the round before; those that
    fail verification, move the pair too far, or lie beyond `verification.sigma_max` of the solution are left out, and
    so are pairs that are `apart`.
    """
    executor = executor or SerialExecutor()
    kept = graph.constraints
    single = verification.model_copy(update={"references": 0})
    gate = chi2_gate(verification.sigma_max, graph.group.dof)
    for round_ in range(settings.rounds):
        progress("refinement", round_, settings.rounds)
        candidates = overlapping_pairs(graph, settings)
        reasons = apart_reasons(candidates, graph.poses, apart)
        candidates = candidates.select(np.flatnonzero(passing(reasons)))
        lasting = scans
        if settings.seen_through_min:
            lasting = without_transients(graph, scans, candidates, settings.seen_through_min, executor)
        evidence = register_candidates(candidates, lasting, graph.poses @ scans.T_base_lidar, single, executor)
        found = constraints_of(candidates, evidence, scans, settings.covariance_floor_m, settings.covariance_floor_rad)
        moved = constraint_residuals(graph.with_constraints(found))
        near = np.hypot(moved[:, 0], moved[:, 1]) <= settings.moved_max_m
        found = found.select(near & passing(rejection_reasons(candidates, evidence, single)))
        graph = _solved(graph, kept, found, solver)
        graph = _solved(graph, kept, found.select(chi2(graph.with_constraints(found)) <= gate), solver)
    progress("refinement", settings.rounds, settings.rounds)
    return graph


def _solved(graph: PoseGraph, kept: Constraints, found: Constraints, solver: SolverSettings) -> PoseGraph:
    graph = graph.with_constraints(Constraints.concatenate([kept, found]))
    return graph.with_poses(solve(graph, solver).poses)


def overlapping_pairs(graph: PoseGraph, settings: RefinementSettings) -> Candidates:
    """Pair each keyframe with the nearest older ones of its own visit and of other visits that look a similar way."""
    xyt = xyt_from_pose(graph.poses)
    count = len(xyt)
    k = np.arange(1, min(NEAREST, count) + 1)
    near, other = cKDTree(xyt[:, :2]).query(xyt[:, :2], k=k, distance_upper_bound=settings.distance_max_m)
    source = np.repeat(np.arange(count), len(k))
    target, distance = np.ravel(other), np.ravel(near)
    older = (target < source) & (target < count)
    source, target, distance = source[older], target[older], distance[older]
    turn = np.abs(wrap_angle(xyt[source, 2] - xyt[target, 2]))
    alike = turn <= settings.turn_max_rad
    # half a metre further away or a radian more turned away overlaps about as much less
    source, target, cost = source[alike], target[alike], distance[alike] + 0.5 * turn[alike]
    recent = source - target < RECENT
    rows = np.concatenate(
        [
            _nearest(np.flatnonzero(recent), source, cost, settings.neighbours),
            _nearest(np.flatnonzero(~recent), source, cost, settings.revisits),
        ]
    )
    rows = np.sort(rows)
    return Candidates(
        target=target[rows],
        source=source[rows],
        kind=np.full(len(rows), int(ConstraintKind.OVERLAP)),
        travel_m=np.zeros(len(rows)),
        reach_m=np.zeros(len(rows)),
        reach_rad=np.zeros(len(rows)),
    )


def _nearest(rows: IntArray, group: IntArray, cost: np.ndarray, count: int) -> IntArray:
    """Keep of `rows` the `count` cheapest of each group."""
    ordered = rows[np.lexsort((cost[rows], group[rows]))]
    sorted_group = group[ordered]
    rank = np.arange(len(ordered)) - np.searchsorted(sorted_group, sorted_group)
    return ordered[rank < count]
