"""From a log on disk to a run directory: read, optimise, save, draw, and record how it went."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Unpack

from posegraph_slam.datasets.trajectory_files import read_trajectory
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.odometry.scan_matching import ScanMatchingResult
from posegraph_slam.pipeline.configuration import Configuration, usable_workers
from posegraph_slam.pipeline.editing import check_log, close_with_edits, planar
from posegraph_slam.pipeline.edits import Edits, edits_digest, to_text
from posegraph_slam.pipeline.executors import open_executor
from posegraph_slam.pipeline.jobs import JobResult, optimize_log, save_job
from posegraph_slam.pipeline.matching_file import MATCHING, read_matching
from posegraph_slam.pipeline.optimize import Close
from posegraph_slam.pipeline.recording import RunOptions, RunSummary, RunUnderWay, recorded_run
from posegraph_slam.pipeline.run_directory import APPLIED_EDITS, RunDirectory, read_run_directory
from posegraph_slam.pipeline.stored_graph import read_stored_graph

__all__ = ["Draw", "RunSummary", "run"]

Draw = Callable[[JobResult, RunDirectory], None]
"""Adds pictures to a run directory; given by the caller, since drawing lies above the pipeline."""


def run(
    log_path: Path,
    configuration: Configuration,
    *,
    truth: Path | None = None,
    matching_of: Path | None = None,
    edits: Edits | None = None,
    draw: Draw | None = None,
    progress: Progress = silent_progress,
    **options: Unpack[RunOptions],
) -> RunSummary:
    """Optimise the log at `log_path` and leave everything in the run directory `out`.

    `truth` names a file of true body poses (TUM, KITTI, EuRoC, CSV) that replaces the log's own; `matching_of` a run
    directory of the same log whose scan matching is taken over, and with `edits` its closures too, as a person changed
    them; `options` are those of every run. `out` appears when all is written; an error leaves nothing. Raises
    InputError where `out` is taken or the log cannot be used.
    """
    with recorded_run(log_path, configuration, **options) as under_way:
        log, clock = under_way.log, under_way.clock
        with clock.stage("reading"):
            if truth is not None:
                log = dataclasses.replace(log, truth=read_trajectory(truth))
            matched, close = _taken_over(matching_of, edits, under_way, configuration)
        with open_executor(usable_workers(configuration)) as executor:
            result = optimize_log(
                log, configuration, matched=matched, close=close, progress=progress, executor=executor
            )
        clock.seconds.update(result.stages_s)
        with clock.stage("saving"):
            save_job(result, under_way.directory)
        if draw is not None:
            with clock.stage("figures"):
                draw(result, under_way.directory)
    return RunSummary(
        folder=under_way.folder,
        table=result.comparison,
        metrics=result.metrics,
        record=under_way.record,
        remarks=result.remarks,
    )


def _taken_over(
    matching_of: Path | None, edits: Edits | None, under_way: RunUnderWay, configuration: Configuration
) -> tuple[ScanMatchingResult | None, Close | None]:
    """Read the scan matching of an earlier run, and with `edits` what gives its closures; note these in the record."""
    if matching_of is None:
        return None, None
    if under_way.log.scans is None:
        raise InputError(matching_of, "is the run of a log without laser scans", "start it over at `matching`")
    earlier = read_run_directory(matching_of)
    group = earlier.configuration.pose_graph.group
    if group != configuration.pose_graph.group:
        # in space the scans are matched in the frame of a level scanner, not of the base
        problem = f"was matched with pose_graph.group = {group}, not {configuration.pose_graph.group}"
        raise InputError(matching_of, problem, "start it over at `matching`")
    matched = read_matching(earlier.path(MATCHING), len(under_way.log.scans))
    if edits is None:
        return matched, None
    check_log(edits, earlier)
    stored = planar(read_stored_graph(earlier))
    under_way.inputs["edits"] = {"run": str(matching_of.resolve()), "sha256": edits_digest(edits)}
    under_way.directory.write_text(APPLIED_EDITS, to_text(edits))
    return matched, partial(close_with_edits, stored, edits, configuration.pose_graph)
