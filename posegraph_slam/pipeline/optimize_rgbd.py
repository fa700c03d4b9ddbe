"""The job of an RGB-D log: odometry, loop closure, fused cloud, and the comparison of before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.ape import absolute_pose_error
from posegraph_slam.evaluation.summary import TrajectoryMetrics, compare, evaluate_trajectory
from posegraph_slam.evaluation.tables import ComparisonRow, ComparisonTable
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress
from posegraph_slam.geometry import SE3, Trajectory, deform
from posegraph_slam.loop_closure.closing import LoopClosureResult
from posegraph_slam.loop_closure.rgbd_closing import close_rgbd_loops
from posegraph_slam.loop_closure.rgbd_lag import lag_motion
from posegraph_slam.loop_closure.rgbd_views import KeyframeViews
from posegraph_slam.mapping.colour_cloud import ColourCloud, ColourCloudSettings, fuse_cloud
from posegraph_slam.mapping.surface_thickness import SurfaceCells, surface_cells, upward_direction
from posegraph_slam.odometry.rgbd_odometry import RgbdOdometry, track_rgbd
from posegraph_slam.pipeline.clock import StageClock
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.outcome import JobOutcome
from posegraph_slam.pipeline.rgbd_frame_status import FrameParts, frame_parts
from posegraph_slam.pipeline.rgbd_frames import FrameImages, PreparedFrames, chosen_camera
from posegraph_slam.pose_graph.graph import ConstraintKind, PoseGraph
from posegraph_slam.pose_graph.solve import solve
from posegraph_slam.registration.rgbd_alignment import align_frames
from posegraph_slam.sensors import RobotLog

SAMPLED_KEYFRAMES = 150
"""The thickness of surfaces is measured on so many keyframes at most."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdResult(JobOutcome):
    """Everything that a run of an RGB-D log found.

    `stages` are odometry and optimised, trajectories of the camera. `cloud` is None where maps were not asked for.
    `upward` (3,) is the direction against gravity in the map frame, as far as floors and tables tell.
    """

    odometry: RgbdOdometry
    parts: FrameParts
    cloud: ColourCloud | None
    samples: Mapping[str, FloatArray]
    """Points (n, 3) of some keyframes, placed by each stage: what the thickness was measured on."""
    upward: FloatArray

    @property
    def keyframes(self) -> IntArray:
        """Frames (K,) that are nodes of the graph."""
        return self.odometry.keyframes


def optimize_rgbd(
    log: RobotLog,
    configuration: Configuration,
    *,
    progress: Progress = silent_progress,
    executor: Executor | None = None,
) -> RgbdResult:
    """Track the camera, close loops, fuse the frames and compare odometry with the optimised trajectory.

    The result depends on the log and the configuration alone, not on the number of workers. Raises InputError for a
    log without RGB-D images, or whose frames cannot be aligned.
    """
    if log.rgbd_sequence is None:
        raise InputError(log.path, "has no RGB-D images", "give a folder of colour and depth images")
    executor, clock, settings = executor or SerialExecutor(), StageClock(), configuration.rgbd
    camera, remarks = chosen_camera(log.rgbd_sequence.camera, settings.camera)
    sequence = replace(log.rgbd_sequence, camera=camera)
    images = FrameImages(sequence=sequence)
    frames = PreparedFrames(images=images, max_depth_m=settings.max_depth_m)
    with clock.stage("odometry"):
        tracked = track_rgbd(
            frames, sequence.stamps_s, settings.odometry, seed=configuration.seed, executor=executor, progress=progress
        )
    with clock.stage("loop closure"):
        lag = lag_motion(tracked.trajectory, tracked.keyframes, sequence.depth_lag_s)
        views = KeyframeViews(frames, tracked.keyframes, executor, lag=lag)
        closed = _close(tracked, views, configuration, executor, progress)
        optimised = deform(tracked.trajectory, tracked.keyframes, closed.graph.poses)
        parts = frame_parts(tracked, closed.graph)
    stages = {"odometry": tracked.trajectory, "optimised": optimised.with_poses(optimised.poses, parent="map")}
    cloud = None
    if configuration.maps:
        with clock.stage("fusing"):
            cloud = fuse_cloud(
                images, stages["optimised"].poses, camera.vector(), settings.cloud,
                depth_units_per_m=camera.depth_units_per_m, frames=parts.main, executor=executor, progress=progress,
            )  # fmt: skip
    with clock.stage("evaluation"):
        samples, cells = _samples(stages, tracked.keyframes, parts, views, settings.cloud.max_depth_m)
        gaps = _first_to_last(stages, tracked.keyframes, views, configuration)
        measured = {name: evaluate_trajectory(t, truth=log.truth) for name, t in stages.items()}
        table, metrics = _compared(stages, log.truth, measured, cells, gaps)
        upward = upward_direction(cells["optimised"], -stages["optimised"].poses[:, :3, 1].mean(axis=0))
    notes = (*_without_replaced(log.remarks, bool(remarks)), *remarks)
    warnings = _warnings(tracked, parts, closed, cloud, settings.cloud, measured["optimised"])
    return RgbdResult(
        stages=stages,
        odometry=tracked,
        parts=parts,
        graph=closed.graph,
        loops=closed.records,
        cloud=cloud,
        samples=samples,
        upward=upward,
        comparison=table,
        metrics={**metrics, **_summary(tracked, parts, closed, cloud), "remarks": notes, "warnings": warnings},
        stages_s=clock.seconds,
        truth=log.truth,
        remarks=(*notes, *warnings),
    )


def keyframe_chain(tracked: RgbdOdometry) -> PoseGraph:
    """Return the graph of the keyframes, each tied to the one before by its alignment; the first is fixed."""
    return PoseGraph.chain(
        tracked.trajectory.poses[tracked.keyframes],
        tracked.keyframes,
        T_i_j=tracked.T_i_j,
        information=tracked.information,
        kind=np.where(tracked.guessed, int(ConstraintKind.ODOMETRY), int(ConstraintKind.SCAN_MATCHING)),
    )


def _close(
    tracked: RgbdOdometry, views: KeyframeViews, configuration: Configuration, executor: Executor, progress: Progress
) -> LoopClosureResult:
    chain = keyframe_chain(tracked)
    chain = chain.with_constraints(views.believed(chain.constraints))
    if not configuration.loop_closure.enabled:
        return LoopClosureResult(graph=chain, records=(), rounds=0, solution=solve(chain, configuration.pose_graph))
    return close_rgbd_loops(
        chain,
        views,
        configuration.rgbd.loops,
        configuration.pose_graph,
        seed=configuration.seed,
        executor=executor,
        progress=progress,
    )


def _samples(
    stages: Mapping[str, Trajectory], keyframes: IntArray, parts: FrameParts, views: KeyframeViews, max_depth_m: float
) -> tuple[dict[str, FloatArray], dict[str, SurfaceCells]]:
    """Points of some keyframes of the largest part in the frame of each stage, and the surfaces they make there."""
    rows = np.flatnonzero(parts.part[keyframes] == 0)
    count = len(rows)
    chosen = rows[np.unique(np.linspace(0, count - 1, min(count, SAMPLED_KEYFRAMES)).astype(np.int64))].tolist()
    points = []
    for k in chosen:
        reference = views.reference(k)
        p = reference.points[0].points
        points.append(p[p[:, 2] <= max_depth_m])
    frame = np.repeat(chosen, [len(part) for part in points])
    placed, cells = {}, {}
    for name, trajectory in stages.items():
        T = trajectory.poses[keyframes[chosen]]
        placed[name] = np.concatenate([p @ t[:3, :3].T + t[:3, 3] for p, t in zip(points, T, strict=True)])
        cells[name] = surface_cells(placed[name], frame)
    return placed, cells


def _first_to_last(
    stages: Mapping[str, Trajectory], keyframes: IntArray, views: KeyframeViews, configuration: Configuration
) -> dict[str, FloatArray] | None:
    """Tangent (6,) by which each stage misses the direct alignment of the last keyframe to the first, if they overlap.

    The alignment starts from the optimised trajectory; None where it is not usable.
    """
    if len(keyframes) < 3:
        return None
    first, last = int(keyframes[0]), int(keyframes[-1])
    across = {name: SE3.between(t.poses[first], t.poses[last]) for name, t in stages.items()}
    found = align_frames(
        views.reference(0), views.reference(len(keyframes) - 1), across["optimised"], configuration.rgbd.loops.alignment
    )
    if not found.usable:
        return None
    return {name: SE3.local(T, found.T_target_source) for name, T in across.items()}


def _compared(
    stages: Mapping[str, Trajectory],
    truth: Trajectory | None,
    measured: Mapping[str, TrajectoryMetrics],
    cells: Mapping[str, SurfaceCells],
    gaps: Mapping[str, FloatArray] | None,
) -> tuple[ComparisonTable, dict[str, Any]]:
    """The table of the stages, and their metrics: errors where the truth is known, and what the images say alone."""
    rows, more = list[ComparisonRow](), dict[str, dict[str, float | None]]()

    def add(name: str, unit: str, decimals: int, values: Sequence[float | None]) -> None:
        rows.append(ComparisonRow(name=name, unit=unit, decimals=decimals, values=tuple(values)))
        more[name] = dict(zip(stages, values, strict=True))

    if truth is not None:
        steps = [m.rpe.per_frame for m in measured.values() if m.rpe is not None]
        add("RPE position a frame max", "m", 4, [e.translation_m.max if e.translation_m else None for e in steps])
        add("RPE rotation a frame max", "deg", 3, [e.rotation_deg.max if e.rotation_deg else None for e in steps])
        from_start = [absolute_pose_error(t, truth, alignment="origin") for t in stages.values()]
        add("position from the first frame max", "m", 4, [e.translation_m.max for e in from_start])
        add("rotation from the first frame max", "deg", 3, [e.rotation_deg.max for e in from_start])
    if gaps is not None:
        add("first to last frame, position off", "m", 4, [float(np.linalg.norm(gaps[name][3:])) for name in stages])
        add("first to last frame, rotation off", "deg", 3,
            [float(np.rad2deg(np.linalg.norm(gaps[name][:3]))) for name in stages])  # fmt: skip
    if all(len(cells[name].thickness_m) for name in stages):
        add("thickness of surfaces, median", "m", 5, [cells[name].median_m for name in stages])
    table = compare(measured)
    table = ComparisonTable(stages=table.stages, rows=(*table.rows, *rows))
    return table, {"stages": {name: m.as_dict() for name, m in measured.items()}, "images": more}


def _summary(
    tracked: RgbdOdometry, parts: FrameParts, closed: LoopClosureResult, cloud: ColourCloud | None
) -> dict[str, Any]:
    """Counts of the run for `metrics.json`."""
    return {
        "frames": len(tracked.trajectory),
        "frames_tracked": int(tracked.tracked.sum()),
        "parts": parts.count,
        "frames_of_largest_part": len(parts.main),
        "keyframes": len(tracked.keyframes),
        "guessed_motions": int(tracked.guessed.sum()),
        **closed.summary(),
        "cloud_points": len(cloud) if cloud is not None else 0,
        "cloud_voxel_m": cloud.voxel_m if cloud is not None else None,
    }


def _without_replaced(remarks: tuple[str, ...], camera_given: bool) -> tuple[str, ...]:
    """The reader's remarks, without that on the camera's numbers where the configuration gives others."""
    return tuple(remark for remark in remarks if not (camera_given and "intrinsics" in remark))


def _warnings(
    tracked: RgbdOdometry, parts: FrameParts, closed: LoopClosureResult, cloud: ColourCloud | None,
    settings: ColourCloudSettings, measured: TrajectoryMetrics,
) -> tuple[str, ...]:  # fmt: skip
    """Plain sentences on what a user should look at."""
    remarks = [*tracked.remarks, *parts.remarks(int(tracked.guessed.sum())), *closed.warnings()]
    if measured.ape is not None and measured.ape.remark:
        remarks.append(measured.ape.remark)
    if cloud is not None and cloud.voxel_m > settings.voxel_m:
        remarks.append(
            f"the cloud's voxels were widened to {cloud.voxel_m:g} m to bound memory (rgbd.cloud.voxels_max)"
        )
    return tuple(remarks)
