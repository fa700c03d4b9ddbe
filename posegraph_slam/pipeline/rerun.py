"""Which log, configuration and earlier results a run starts from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from posegraph_slam.errors import ConfigurationError, InputError, did_you_mean
from posegraph_slam.pipeline.configuration import Configuration, load_configuration
from posegraph_slam.pipeline.edits import Edits, read_edits
from posegraph_slam.pipeline.run_directory import CONFIGURATION, RECORD, read_run_directory

STAGE_SWITCHES = {
    "odometry": (),
    "matching": ("scan_matching.matcher=none",),
    "graph": ("loop_closure.enabled=false",),
    "maps": ("maps=false",),
}
"""Stages of a run, and the keys that leave each out; odometry always runs."""
STARTS = ("matching", "graph")
"""Stages at which a finished run can be taken up again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunPlan:
    """What to read and with which configuration; `matching_of` is the run whose scan matching is taken over."""

    log: Path
    configuration: Configuration
    log_format: str | None = None
    topics: Mapping[str, str] | None = None
    matching_of: Path | None = None
    edits: Edits | None = None
    """Changes to the closures of that run, which are then taken over too."""


def plan_run(
    log: Path,
    files: Sequence[str | Path],
    overrides: Sequence[str],
    *,
    seed: int | None = None,
    workers: int | None = None,
    no_loops: bool = False,
    stages: str | None = None,
    start: str | None = None,
    edits: Path | None = None,
) -> RunPlan:
    """Turn the options of a run into a plan.

    With `start`, `log` is a run directory: its log and configuration are taken, the latter under `files` and
    `overrides`. `stages` names the ones to run, comma-separated; `edits` is a file of changes to the closures of
    a run that is taken up at its graph. Raises ConfigurationError for an unknown stage and InputError for a run
    directory, log or file of edits that is not there.
    """
    if edits is not None and (start != "graph" or no_loops or stages is not None):
        raise ConfigurationError("--edits", "changes the closures of a finished run", "use it with --from graph alone")
    overrides = [*overrides, *(["loop_closure.enabled=false"] if no_loops else []), *_switches(stages)]
    if start is None:
        return RunPlan(log=log, configuration=load_configuration(files, overrides, seed=seed, workers=workers))
    if start not in STARTS:
        raise ConfigurationError(
            "--from",
            f"'{start}' is not a stage to start from",
            f"{did_you_mean(start, STARTS)}it is {' or '.join(STARTS)}",
        )
    run = read_run_directory(log)
    read = run.record.get("input", {})
    if not read.get("path") or not read.get("format"):
        raise InputError(log / RECORD, "does not say which log was read", "optimise the log again, without --from")
    source = Path(read["path"])
    if not source.exists():
        raise InputError(source, f"is gone: {log} was made from it", "put the log back, or optimise it where it is now")
    return RunPlan(
        log=source,
        configuration=load_configuration([log / CONFIGURATION, *files], overrides, seed=seed, workers=workers),
        log_format=read["format"],
        topics=read.get("topics"),
        matching_of=log if start == "graph" else None,
        edits=read_edits(edits) if edits is not None else None,
    )


def _switches(stages: str | None) -> list[str]:
    """Overrides that leave out the stages that are not named."""
    if stages is None:
        return []
    wanted = [name.strip() for name in stages.split(",")]
    unknown = [name for name in wanted if name not in STAGE_SWITCHES]
    if unknown:
        guess = did_you_mean(unknown[0], STAGE_SWITCHES)
        remedy = f"{guess}they are {', '.join(STAGE_SWITCHES)}"
        raise ConfigurationError("--stages", f"'{unknown[0]}' is not a stage", remedy)
    return [key for name, keys in STAGE_SWITCHES.items() if name not in wanted for key in keys]
