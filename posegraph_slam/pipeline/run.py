"""From a log on disk to a run directory: read, optimise, save, draw, and record how it went."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from posegraph_slam.datasets.trajectory_files import read_trajectory
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.pipeline.configuration import Configuration, usable_workers
from posegraph_slam.pipeline.editing import check_log, close_with_edits, planar
from posegraph_slam.pipeline.edits import Edits, edits_digest, to_text
from posegraph_slam.pipeline.executors import open_executor
from posegraph_slam.pipeline.jobs import JobResult, optimize_log, save_job
from posegraph_slam.pipeline.matching_file import MATCHING, read_matching
from posegraph_slam.pipeline.recording import Report, RunSummary, recorded_run
from posegraph_slam.pipeline.run_directory import APPLIED_EDITS, RunDirectory, read_run_directory
from posegraph_slam.pipeline.stored_graph import read_stored_graph

__all__ = ["Draw", "RunSummary", "run"]

Draw = Callable[[JobResult, RunDirectory], None]
"""Adds pictures to a run directory; given by the caller, since drawing lies above the pipeline."""


def run(
    log_path: Path,
    configuration: Configuration,
    *,
    out: Path,
    overwrite: bool = False,
    log_format: str | None = None,
    topics: Mapping[str, str] | None = None,
    truth: Path | None = None,
    matching_of: Path | None = None,
    edits: Edits | None = None,
    draw: Draw | None = None,
    report: Report | None = None,
    progress: Progress = silent_progress,
    command: Sequence[str] | None = None,
) -> RunSummary:
    """Optimise the log at `log_path` and leave everything in the run directory `out`.

    `truth` names a file of true body poses (TUM, KITTI, EuRoC, CSV) that replaces the log's own; `matching_of` a run
    directory of the same log whose scan matching is taken over, and with `edits` its closures too, as a person changed
    them; `topics` those of a bag. `out` appears when all is written; an error leaves nothing. Raises InputError where
    `out` is taken or the log cannot be used.
    """
    close = None
    with recorded_run(
        log_path,
        configuration,
        out=out,
        overwrite=overwrite,
        log_format=log_format,
        topics=topics,
        report=report,
        command=command,
    ) as under_way:
        log, clock = under_way.log, under_way.clock
        matched = None
        with clock.stage("reading"):
            if truth is not None:
                log = dataclasses.replace(log, truth=read_trajectory(truth))
            if matching_of is not None and log.scans is None:
                raise InputError(matching_of, "is the run of a log without laser scans", "start it over at `matching`")
            if matching_of is not None and log.scans is not None:
                earlier = read_run_directory(matching_of)
                matched = read_matching(earlier.path(MATCHING), len(log.scans))
                if edits is not None:
                    check_log(edits, earlier)
                    stored = planar(read_stored_graph(earlier))
                    close = partial(close_with_edits, stored, edits, configuration.pose_graph)
                    under_way.inputs["edits"] = {"run": str(matching_of.resolve()), "sha256": edits_digest(edits)}
                    under_way.directory.write_text(APPLIED_EDITS, to_text(edits))
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
        folder=out, table=result.comparison, metrics=result.metrics, record=under_way.record, remarks=result.remarks
    )
