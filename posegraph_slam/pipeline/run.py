"""From a log on disk to a run directory: read, optimise, save, draw, and record how it went."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from posegraph_slam.datasets import read
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.evaluation.tables import ComparisonTable
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.jit import measure_compile_time
from posegraph_slam.pipeline.clock import StageClock
from posegraph_slam.pipeline.configuration import Configuration, usable_workers
from posegraph_slam.pipeline.executors import open_executor
from posegraph_slam.pipeline.matching_file import MATCHING, read_matching
from posegraph_slam.pipeline.optimize import OptimizationResult, optimize
from posegraph_slam.pipeline.run_directory import (
    RECORD,
    RunDirectory,
    create_run_directory,
    read_run_directory,
    require_free,
)
from posegraph_slam.pipeline.run_record import run_record
from posegraph_slam.pipeline.saving import save_run

Draw = Callable[[OptimizationResult, RunDirectory], None]
"""Adds pictures to a run directory; given by the caller, since drawing lies above the pipeline."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSummary:
    """What a run gave: its folder, the comparison of its stages, its metrics and record, and remarks for people."""

    folder: Path
    table: ComparisonTable
    metrics: Mapping[str, Any]
    record: Mapping[str, Any]
    remarks: tuple[str, ...]


def run(
    log_path: Path,
    configuration: Configuration,
    *,
    out: Path,
    overwrite: bool = False,
    log_format: str | None = None,
    truth: Path | None = None,
    matching_of: Path | None = None,
    draw: Draw | None = None,
    progress: Progress = silent_progress,
    command: Sequence[str] | None = None,
) -> RunSummary:
    """Optimise the log at `log_path` and leave everything in the run directory `out`.

    `truth` names a TUM file of true body poses that replaces the log's own; `matching_of` a run directory of the same
    log whose scan matching is taken over. `out` appears when all is written; an
    error leaves nothing. Raises InputError where `out` is taken or the log cannot be used.
    """
    require_free(out, overwrite=overwrite)
    clock = StageClock()
    with create_run_directory(out, overwrite=overwrite) as directory:
        with measure_compile_time() as compiling, open_executor(usable_workers(configuration)) as executor:
            with clock.stage("reading"):
                log = read(log_path, format=log_format)
                if truth is not None:
                    log = dataclasses.replace(log, truth=read_tum(truth, parent="ref", child="base"))
            matched = None
            if matching_of is not None and log.scans is not None:
                matched = read_matching(read_run_directory(matching_of).path(MATCHING), len(log.scans))
            result = optimize(log, configuration, matched=matched, progress=progress, executor=executor)
        for name, seconds in result.stages_s.items():
            clock.seconds[name] = seconds
        with clock.stage("saving"):
            directory.write_configuration(configuration)
            save_run(result, directory)
        if draw is not None:
            with clock.stage("figures"):
                draw(result, directory)
        record = run_record(
            configuration,
            log_path,
            log_format=log.format,
            stages_s=clock.seconds,
            jit_compile_s=compiling.seconds,
            command=command,
        )
        directory.write_json(RECORD, record)
    return RunSummary(
        folder=out, table=result.comparison, metrics=result.metrics, record=record, remarks=result.remarks
    )
