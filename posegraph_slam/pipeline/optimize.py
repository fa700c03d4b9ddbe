"""The main job: from a log to an optimised trajectory, a pose graph and maps, one stage after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.summary import compare, evaluate_trajectory
from posegraph_slam.evaluation.tables import ComparisonTable
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress
from posegraph_slam.geometry import SE2, Trajectory
from posegraph_slam.loop_closure.closing import LoopClosureResult, close_loops
from posegraph_slam.loop_closure.ledger import LoopRecord
from posegraph_slam.loop_closure.refinement import refine_overlaps
from posegraph_slam.mapping.crispness import crispness
from posegraph_slam.mapping.occupancy import OccupancyGrid, OccupancySettings, build_occupancy
from posegraph_slam.mapping.texture import TextureMap
from posegraph_slam.odometry.scan_matching import ScanMatchingResult
from posegraph_slam.pipeline.clock import StageClock
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.depth_maps import DepthMaps, build_depth_maps
from posegraph_slam.pipeline.matching import keyframe_scans, match_log, motion_in_sweep
from posegraph_slam.pipeline.plan_view import PlanView
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.registration.beam_scans import BeamScans
from posegraph_slam.sensors import LaserScans, RobotLog

STAGES = ("odometry", "scan matching", "optimised")
"""Names of the trajectories that a run compares."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OptimizationResult:
    """Everything that a run found.

    `stages` maps odometry, scan matching and optimised to their trajectories of all scans (body frame); `matched`
    says which scans are nodes of `graph`; `loops` records every candidate that was tried; maps are None where they
    were not asked for.
    """

    stages: Mapping[str, Trajectory]
    matched: ScanMatchingResult
    graph: PoseGraph
    loops: tuple[LoopRecord, ...]
    occupancy: OccupancyGrid | None
    depth_maps: DepthMaps
    comparison: ComparisonTable
    metrics: Mapping[str, Any]
    stages_s: Mapping[str, float]
    truth: Trajectory | None
    remarks: tuple[str, ...]

    @property
    def trajectory(self) -> Trajectory:
        """The optimised trajectory, map -> base, a pose for every scan."""
        return self.stages["optimised"]

    @property
    def texture(self) -> TextureMap | None:
        """The texture map, None where the log has no images."""
        return self.depth_maps.texture

    @property
    def keyframes(self) -> IntArray:
        """Scans (K,) that are nodes of the graph."""
        return self.matched.keyframes

    @property
    def rejected_pairs(self) -> IntArray:
        """Target and source keyframe (R, 2) of the candidates that were rejected."""
        pairs = [(record.target, record.source) for record in self.loops if not record.accepted]
        return np.array(pairs, dtype=np.int64).reshape(-1, 2)


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
        closed = close() if close is not None else _close(matched, basis.beams, view, executor, progress)
    with clock.stage("refinement"):
        graph, optimised = finish(closed.graph, basis, progress=progress, executor=executor)
    found = (view.lifted(odometry.trajectory), view.lifted(matched.trajectory), optimised)
    stages = dict(zip(STAGES, found, strict=True))
    with clock.stage("maps"):
        occupancy, crisp = _maps(view, stages, matched, executor, progress)
        depth_maps = build_depth_maps(
            log, stages["optimised"], occupancy, configuration, executor=executor, progress=progress
        )
    with clock.stage("evaluation"):
        measured = {
            name: evaluate_trajectory(
                trajectory,
                truth=log.truth,
                relations=log.relations,
                crispness=crisp.get(name),
            )
            for name, trajectory in stages.items()
        }
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
            "remarks": [*log.remarks, *odometry.remarks, *view.remarks, *matched.remarks],
            "warnings": list(_warnings(closed)),
        },
        stages_s=clock.seconds,
        truth=log.truth,
        remarks=(
            *log.remarks,
            *odometry.remarks,
            *view.remarks,
            *matched.remarks,
            *_warnings(closed),
            *depth_maps.remarks,
        ),
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
    with clock.stage("scan matching"):
        if matched is None:
            matched = match_log(view.scans, view.odometry, view.configuration, executor=executor, progress=progress)
        beams = keyframe_scans(view.scans, matched, view.configuration, executor)
    return MatchedLog(view=view, matched=matched, beams=beams)


def finish(
    graph: PoseGraph, basis: MatchedLog, *, executor: Executor, progress: Progress = silent_progress
) -> tuple[PoseGraph, Trajectory]:
    """Refine a graph of keyframes with its closures; return it and the optimised trajectory of all scans (N)."""
    graph = _refine(graph, basis.matched, basis.beams, basis.view, executor, progress)
    graph, optimised = basis.view.finish(graph, basis.matched, progress)
    return graph, in_map_frame(optimised)


def _close(
    matched: ScanMatchingResult,
    beams: BeamScans,
    view: PlanView,
    executor: Executor,
    progress: Progress,
) -> LoopClosureResult:
    return close_loops(
        keyframe_chain(matched),
        beams,
        view.configuration.loop_closure,
        view.configuration.pose_graph,
        executor=executor,
        progress=progress,
        apart=view.apart(matched.keyframes),
    )


def _refine(
    graph: PoseGraph,
    matched: ScanMatchingResult,
    beams: BeamScans,
    view: PlanView,
    executor: Executor,
    progress: Progress,
) -> PoseGraph:
    """Match overlapping keyframes again, unless loop closure is off: then the chain of scan matching stands."""
    configuration = view.configuration
    if not configuration.loop_closure.enabled:
        return graph
    return refine_overlaps(
        graph,
        beams,
        configuration.refinement,
        configuration.loop_closure.verification,
        configuration.pose_graph,
        executor=executor,
        progress=progress,
        apart=view.apart(matched.keyframes),
    )


def _maps(
    view: PlanView,
    stages: Mapping[str, Trajectory],
    matched: ScanMatchingResult,
    executor: Executor,
    progress: Progress,
) -> tuple[OccupancyGrid | None, dict[str, float]]:
    """Build the occupancy map of all scans, and those of the keyframes at each stage for their crispness alone."""
    configuration = view.configuration
    if not configuration.maps:
        return None, {}
    scans = view.scans_from(stages["optimised"])
    motion = motion_in_sweep(scans, matched.trajectory.poses, matched.sweep, configuration.timing)
    plans = {name: view.plan(trajectory) for name, trajectory in stages.items()}
    final = _MapWork(trajectory=plans["optimised"], index=np.arange(len(scans)), keep=True)
    compared = [_MapWork(trajectory=trajectory, index=matched.keyframes, keep=False) for trajectory in plans.values()]
    build = partial(_build_map, scans=scans, motion=motion, settings=configuration.mapping, progress=progress)
    (occupancy, _), *measured = executor.map(build, [final, *compared])
    return occupancy, dict(zip(stages, (figure for _, figure in measured), strict=True))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _MapWork:
    """A map to be built from the scans at `index`; only its crispness is wanted where it is not to be kept."""

    trajectory: Trajectory
    index: IntArray
    keep: bool


def _build_map(
    work: _MapWork, *, scans: LaserScans, motion: FloatArray, settings: OccupancySettings, progress: Progress
) -> tuple[OccupancyGrid | None, float]:
    index = work.index
    grid = build_occupancy(
        scans if work.keep else scans.select(index),
        work.trajectory.select(index),
        settings,
        motion=motion[index],
        progress=progress if work.keep else silent_progress,
    )
    return (grid, 0.0) if work.keep else (None, crispness(grid))


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
    count = len(poses)
    fixed: BoolArray = np.arange(count) == 0
    return PoseGraph(
        poses=poses,
        session=np.zeros(count, dtype=np.int64),
        index=matched.keyframes,
        fixed=fixed,
        constraints=Constraints(
            i=np.arange(count - 1),
            j=np.arange(1, count),
            T_i_j=SE2.between(poses[:-1], poses[1:]),
            information=matched.keyframe_information,
            kind=np.full(count - 1, int(ConstraintKind.SCAN_MATCHING)),
        ),
    )


def in_map_frame(trajectory: Trajectory) -> Trajectory:
    """Name the parent frame of an optimised trajectory."""
    return trajectory.with_poses(trajectory.poses, parent="map")


def _summary(scans: LaserScans, matched: ScanMatchingResult, closed: LoopClosureResult) -> dict[str, Any]:
    """Counts of the run for `metrics.json`."""
    accepted = [record for record in closed.records if record.accepted]
    kinds = sorted({record.kind for record in closed.records})
    return {
        "scans": len(scans),
        "keyframes": len(matched.keyframes),
        "scans_searched": len(matched.searched),
        "odometry_lag_scans": matched.lag,
        "sweep_scans": matched.sweep,
        "loops_proposed": len(closed.records),
        "loops_accepted": len(accepted),
        "loops_by_kind": {
            kind: {
                "proposed": sum(record.kind == kind for record in closed.records),
                "accepted": sum(record.kind == kind for record in accepted),
            }
            for kind in kinds
        },
        "loop_rounds": closed.rounds,
        "graph_cost_initial": closed.solution.cost_initial,
        "graph_cost": closed.solution.cost,
        "solver_stop_reason": str(closed.solution.stop_reason),
    }


def _warnings(closed: LoopClosureResult) -> tuple[str, ...]:
    """Plain sentences on what a user should look at."""
    remarks = list(closed.solution.notes)
    if not closed.solution.converged:
        remarks.append(f"the pose graph did not converge: {closed.solution.stop_reason}")
    dropped = sum(not record.accepted and np.isfinite(record.sigmas_after) for record in closed.records)
    if dropped:
        remarks.append(f"{dropped} closures disagreed with the rest and were taken out; loops.csv says which")
    return tuple(remarks)
