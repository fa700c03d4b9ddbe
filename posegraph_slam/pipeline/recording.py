"""What every run has around its own work: a directory that appears when all is written, a clock, and a record."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Required, TypedDict

from posegraph_slam.datasets import read
from posegraph_slam.evaluation.tables import ComparisonTable
from posegraph_slam.jit import measure_compile_time
from posegraph_slam.pipeline.clock import StageClock
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.run_directory import RECORD, RunDirectory, create_run_directory, require_free
from posegraph_slam.pipeline.run_record import run_record
from posegraph_slam.sensors import RobotLog

Report = Callable[[RunDirectory, str], object]
"""Writes the report of a run directory that holds all else, given the name that the run will have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOutcome:
    """What a run gave: its folder, its metrics and record, and remarks for people."""

    folder: Path
    metrics: Mapping[str, Any]
    record: Mapping[str, Any]
    remarks: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSummary(RunOutcome):
    """The outcome of a run that compares trajectories: of its stages, or with odometry."""

    table: ComparisonTable


@dataclass(slots=True, kw_only=True)
class RunUnderWay:
    """A run that is going on: the log it reads, where it writes, and its clock.

    `folder` will be its run directory, `directory` is the one it writes until then. `inputs` are further entries of
    its record, which is complete once the block of `recorded_run` has ended.
    """

    log: RobotLog
    folder: Path
    directory: RunDirectory
    clock: StageClock
    inputs: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)


class RunOptions(TypedDict, total=False):
    """What every run may be told, as keyword arguments: where it writes, and how it reads its log."""

    out: Required[Path]
    """The run directory, which appears when all is written; an error leaves nothing."""
    overwrite: bool
    """Replace a run directory that is there already."""
    log_format: str | None
    """Name of the log's format; found out where not given."""
    topics: Mapping[str, str] | None
    """Topics of a bag, by sensor."""
    report: Report | None
    command: Sequence[str] | None
    """Command line for the record, where it is not that of this process."""


@contextmanager
def recorded_run(
    log_path: Path,
    configuration: Configuration,
    *,
    out: Path,
    overwrite: bool = False,
    log_format: str | None = None,
    topics: Mapping[str, str] | None = None,
    report: Report | None = None,
    command: Sequence[str] | None = None,
) -> Iterator[RunUnderWay]:
    """Read the log at `log_path`, yield the run to be done with it, and record how it went.

    The arguments are `RunOptions`. The run directory `out` appears when the block has ended and all is written; an
    error leaves nothing. Raises InputError where `out` is taken or the log cannot be read.
    """
    require_free(out, overwrite=overwrite)
    clock = StageClock()
    with create_run_directory(out, overwrite=overwrite) as directory:
        with measure_compile_time() as compiling:
            with clock.stage("reading"):
                log = read(log_path, format=log_format, topics=topics)
            run = RunUnderWay(log=log, folder=out, directory=directory, clock=clock)
            yield run
        directory.write_configuration(configuration)
        written = run_record(
            configuration,
            log_path,
            log_format=log.format,
            topics=topics,
            stages_s=clock.seconds,
            jit_compile_s=compiling.seconds,
            command=command,
        )
        run.record = {**written, **run.inputs}
        directory.write_json(RECORD, run.record)
        if report is not None:
            report(directory, out.resolve().name)
