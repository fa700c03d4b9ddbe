"""Writing what a run of an RGB-D log found into its directory."""

from __future__ import annotations

from posegraph_slam.datasets.ply import write_ply
from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.loop_closure.rgbd_closing import RgbdLoopRecord
from posegraph_slam.pipeline.optimize_rgbd import RgbdResult
from posegraph_slam.pipeline.run_directory import METRICS, RunDirectory
from posegraph_slam.pipeline.saving import write_loops
from posegraph_slam.pose_graph.g2o import write_g2o

CLOUD = "maps/cloud.ply"
TRAJECTORY_FILES = {"odometry": "odometry.tum", "optimised": "trajectory.tum"}
"""File of each stage's trajectory: a pose of the camera for every frame."""
FRAMES = "frames.csv"


def save_rgbd_run(result: RgbdResult, directory: RunDirectory) -> None:
    """Write trajectories, frames, graph, loop candidates, metrics and the cloud; docs/rgbd.md describes the files."""
    for stage, name in TRAJECTORY_FILES.items():
        write_tum(result.stages[stage], directory.path(name))
    write_g2o(result.graph, directory.path("graph.g2o"))
    parts = result.parts
    directory.write_rows(
        FRAMES,
        ["frame", "stamp_s", "status", "part"],
        zip(range(len(parts.part)), result.trajectory.stamps_s, parts.status(), parts.part, strict=True),
    )
    stamps = result.trajectory.stamps_s[result.keyframes]
    write_loops(result.loops, result.keyframes, stamps, directory, record=RgbdLoopRecord, unit="frame")
    directory.write_json(METRICS, {"table": result.comparison.as_dict(), **result.metrics})
    if result.cloud is not None:
        write_ply(result.cloud.points, directory.path(CLOUD), colours=result.cloud.colours)
