"""The job that fits what a log holds: laser scans, or the images of an RGB-D camera."""

from __future__ import annotations

from posegraph_slam.errors import InputError
from posegraph_slam.execution import Executor, Progress, silent_progress
from posegraph_slam.odometry.scan_matching import ScanMatchingResult
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.optimize import Close, OptimizationResult, optimize
from posegraph_slam.pipeline.optimize_rgbd import RgbdResult, optimize_rgbd
from posegraph_slam.pipeline.run_directory import RunDirectory
from posegraph_slam.pipeline.saving import save_run
from posegraph_slam.pipeline.saving_rgbd import save_rgbd_run
from posegraph_slam.sensors import RobotLog

JobResult = OptimizationResult | RgbdResult


def optimize_log(
    log: RobotLog,
    configuration: Configuration,
    *,
    matched: ScanMatchingResult | None = None,
    close: Close | None = None,
    progress: Progress = silent_progress,
    executor: Executor | None = None,
) -> JobResult:
    """Optimise a log by its laser scans, or by its RGB-D images where it has no scans.

    `matched` and `close` are the scan matching of an earlier run and what gives its closures. Raises InputError for a
    log that has neither scans nor images.
    """
    if log.scans is None and log.rgbd_sequence is not None:
        if matched is not None:
            raise InputError(log.path, "has no scan matching to take over", "run an RGB-D log from the start")
        return optimize_rgbd(log, configuration, progress=progress, executor=executor)
    return optimize(log, configuration, matched=matched, close=close, progress=progress, executor=executor)


def save_job(result: JobResult, directory: RunDirectory) -> None:
    """Write the files of a run into its directory."""
    if isinstance(result, RgbdResult):
        save_rgbd_run(result, directory)
    else:
        save_run(result, directory)
