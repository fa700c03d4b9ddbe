"""The main job: from a log to an optimised trajectory, a pose graph and maps, one stage after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from posegraph_slam.arrays import IntArray
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.summary import TrajectoryMetrics, compare, evaluate_trajectory
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress
from posegraph_slam.geometry import SE2, Trajectory
from posegraph_slam.loop_closure.closing import LoopClosureResult, close_loops
from posegraph_slam.loop_closure.refinement import refine_overlaps
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.mapping.texture import TextureMap
from posegraph_slam.odometry.scan_matching import ScanMatchingResult
from posegraph_slam.pipeline.clock import StageClock
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.depth_maps import DepthMaps, build_depth_maps
from posegraph_slam.pipeline.matching import keyframe_scans, match_log
from posegraph_slam.pipeline.outcome import JobOutcome
from posegraph_slam.pipeline.plan_view import PlanView
from posegraph_slam.pipeline.stage_maps import build_stage_maps
from posegraph_slam.pose_graph.graph import ConstraintKind, PoseGraph
from posegraph_slam.registration.beam_scans import BeamScans
from posegraph_slam.sensors import LaserScans, RobotLog

STAGES = ("odometry", "scan matching", "optimised")
"""Names of the trajectories that a run compares."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OptimizationResult(JobOutcome):
    """Everything that a run found.

    `stages` are odometry, scan matching and optimised, trajectories of the body; `matched` says which scans are nodes
    of `graph`; maps are None where they were not asked for.
    """

    matched: ScanMatchingResult
    occupancy: OccupancyGrid | None
    depth_maps: DepthMaps

    @property
    def texture(self) -> TextureMap | None:
        """The texture map, None where the log has no images."""
        return self.depth_maps.texture

    @property
    def keyframes(self) -> IntArray:
        """Scans (K,) that are nodes of the graph."""
        return self.matched.keyframes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchedLog:
    """A log up to scan matching: what the planar stages see of it, the matched scans (N), the keyframes' scans (K)."""

    view: PlanView
    matched: ScanMatchingResult
    beams: BeamScans


Close = Callable[[], LoopClosureResult]
"""Gives the closures of a run whose scan matching is taken over, in place of the search for them."""


def optimize(
    log: RobotLog,
    configuration: Configuration,
    *,
    matched: ScanMatchingResult | None = None,
    close: Close | None = None,
    progress: Progress = silent_progress,
    executor: Executor | None = None,
) -> OptimizationResult:
    """Run all stages on a log in memory: odometry, scan matching, loop closure, maps and their comparison.

    `matched` is the scan matching of an earlier run of the same log, taken instead of a new one, and `close`
    gives its closures. The result depends on these, the log and the configuration alone, not on the number of workers.
    Raises InputError for a log without usable scans.
    """
    executor, clock = executor or SerialExecutor(), StageClock()
    basis = match(log, configuration, matched=matched, progress=progress, executor=executor, clock=clock)
    view, odometry, matched = basis.view, basis.view.odometry, basis.matched
    with clock.stage("loop closure"):
        closed = close() if close is not None else _close(basis, executor, progress)
    with clock.stage("refinement"):
        graph, optimised = finish(closed.graph, basis, progress=progress, executor=executor)
    found = (view.lifted(odometry.trajectory), view.lifted(matched.trajectory), optimised)
    stages = dict(zip(STAGES, found, strict=True))
    with clock.stage("maps"):
        occupancy, crisp = build_stage_maps(stages, view, matched, executor=executor, progress=progress)
        depth_maps = build_depth_maps(
            log, stages["optimised"], occupancy, configuration, executor=executor, progress=progress
        )
    with clock.stage("evaluation"):
        measured = _evaluate(stages, log, crisp)
    notes = (*log.remarks, *odometry.remarks, *view.remarks, *matched.remarks)
    warnings = _warnings(closed)
    return OptimizationResult(
        stages=stages,
        matched=matched,
        graph=graph,
        loops=closed.records,
        occupancy=occupancy,
        depth_maps=depth_maps,
        comparison=compare(measured),
        metrics={
            "stages": {name: metrics.as_dict() for name, metrics in measured.items()},
            **_summary(view.scans, matched, closed),
            "remarks": list(notes),
            "warnings": list(warnings),
        },
        stages_s=clock.seconds,
        truth=log.truth,
        remarks=(*notes, *warnings, *depth_maps.remarks),
    )


def match(
    log: RobotLog,
    configuration: Configuration,
    *,
    executor: Executor,
    matched: ScanMatchingResult | None = None,
    progress: Progress = silent_progress,
    clock: StageClock | None = None,
) -> MatchedLog:
    """Take a log up to scan matching; `matched` is that of an earlier run. Raises InputError for unusable scans."""
    clock, scans = clock or StageClock(), usable_scans(log)
    with clock.stage("odometry"):
        view = PlanView.of(log, scans, configuration)
        if matched is not None:
            view = view.calibrated(log, matched.wheels)
    with clock.stage("scan matching"):
        if matched is None:
            matched = match_log(view.scans, view.odometry, view.configuration, executor=executor, progress=progress)
            wheels = view.calibration(matched)
            if wheels.known:
                view = view.calibrated(log, wheels)
                matched = match_log(
                    view.scans, view.odometry, view.configuration, executor=executor, progress=progress, known=matched
                )
                matched = replace(matched, wheels=wheels)
        beams = keyframe_scans(view.scans, matched, view.configuration, executor)
    return MatchedLog(view=view, matched=matched, beams=beams)


def finish(
    graph: PoseGraph, basis: MatchedLog, *, executor: Executor, progress: Progress = silent_progress
) -> tuple[PoseGraph, Trajectory]:
    """Refine a graph of keyframes with its closures; return it and the optimised trajectory of all scans (N)."""
    graph = _refine(graph, basis, executor, progress)
    graph, optimised = basis.view.finish(graph, basis.matched, progress)
    return graph, in_map_frame(optimised)


def _close(basis: MatchedLog, executor: Executor, progress: Progress) -> LoopClosureResult:
    """Search the chain of keyframes for closures."""
    return close_loops(
        keyframe_chain(basis.matched),
        basis.beams,
        basis.view.configuration.loop_closure,
        basis.view.configuration.pose_graph,
        executor=executor,
        progress=progress,
        apart=basis.view.apart(basis.matched.keyframes),
    )


def _refine(graph: PoseGraph, basis: MatchedLog, executor: Executor, progress: Progress) -> PoseGraph:
    """Match overlapping keyframes again, unless loop closure is off: then the chain of scan matching stands."""
    configuration = basis.view.configuration
    if not configuration.loop_closure.enabled:
        return graph
    return refine_overlaps(
        graph,
        basis.beams,
        configuration.refinement,
        configuration.loop_closure.verification,
        configuration.pose_graph,
        executor=executor,
        progress=progress,
        apart=basis.view.apart(basis.matched.keyframes),
    )


def _evaluate(
    stages: Mapping[str, Trajectory], log: RobotLog, crisp: Mapping[str, float]
) -> dict[str, TrajectoryMetrics]:
    """Compare each stage's trajectory with what is known of the true one."""
    return {
        name: evaluate_trajectory(trajectory, truth=log.truth, relations=log.relations, crispness=crisp.get(name))
        for name, trajectory in stages.items()
    }


def usable_scans(log: RobotLog) -> LaserScans:
    """Return the log's scans; raise InputError where there are too few, or none of them hit anything."""
    if log.scans is None or len(log.scans) < 2:
        count = 0 if log.scans is None else len(log.scans)
        raise InputError(log.path, f"has {count} laser scans", "scan matching needs a log with a LiDAR stream")
    if not any(log.scans.returns(slice(start, start + 1000)).any() for start in range(0, len(log.scans), 1000)):
        raise InputError(log.path, "no beam of any scan hit anything", "check range_min, range_max and units (metres)")
    return log.scans


def keyframe_chain(matched: ScanMatchingResult) -> PoseGraph:
    """Return the graph of the keyframes, each tied to the one before by scan matching; the first is fixed."""
    poses = matched.trajectory.poses[matched.keyframes]
    return PoseGraph.chain(
        poses,
        matched.keyframes,
        T_i_j=SE2.between(poses[:-1], poses[1:]),
        information=matched.keyframe_information,
        kind=int(ConstraintKind.SCAN_MATCHING),
    )


def in_map_frame(trajectory: Trajectory) -> Trajectory:
    """Name the parent frame of an optimised trajectory."""
    return trajectory.with_poses(trajectory.poses, parent="map")


def _summary(scans: LaserScans, matched: ScanMatchingResult, closed: LoopClosureResult) -> dict[str, Any]:
    """Counts of the run for `metrics.json`."""
    return {
        "scans": len(scans),
        "keyframes": len(matched.keyframes),
        "scans_searched": len(matched.searched),
        "odometry_lag_scans": matched.lag,
        "sweep_scans": matched.sweep,
        **closed.summary(),
    }


def _warnings(closed: LoopClosureResult) -> tuple[str, ...]:
    """Plain sentences on what a user should look at."""
    remarks = closed.warnings()
    dropped = sum(not record.accepted and np.isfinite(record.sigmas_after) for record in closed.records)
    if dropped:
        remarks.append(f"{dropped} closures disagreed with the rest and were taken out; loops.csv says which")
    return tuple(remarks)
