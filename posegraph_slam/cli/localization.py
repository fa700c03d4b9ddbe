"""`psg localize`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from posegraph_slam.cli.arguments import (
    Config,
    Format,
    Json,
    Log,
    Out,
    Overwrite,
    Page,
    Quiet,
    Seed,
    Set,
    Topic,
    Verbose,
    Workers,
    topic_names,
)
from posegraph_slam.cli.console import ProgressBars
from posegraph_slam.cli.runs import report

if TYPE_CHECKING:
    from posegraph_slam.arrays import FloatArray
    from posegraph_slam.pipeline.recording import RunOutcome

Map = Annotated[Path, typer.Argument(metavar="MAP", help="YAML file of a nav2 map.")]


def localize(
    known_map: Map,
    log: Log,
    out: Out,
    start: Annotated[
        str | None,
        typer.Option("--start", metavar="X,Y,YAW", help="Pose of the first scan (m, rad); without it, search the map."),
    ] = None,
    config: Config = None,
    settings: Set = None,
    log_format: Format = None,
    topic: Topic = None,
    seed: Seed = None,
    workers: Workers = None,
    page: Page = True,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: Json = False,
) -> None:
    """Find a robot in a known map at every scan of its log, and say when its pose is not known."""
    from posegraph_slam.pipeline.configuration import load_configuration
    from posegraph_slam.pipeline.localize import run_localization
    from posegraph_slam.report.page import write_report_of

    configuration = load_configuration(config or [], settings or [], seed=seed, workers=workers)
    with ProgressBars(enabled=not quiet) as progress:
        summary = run_localization(
            known_map,
            log,
            configuration,
            out=out,
            start=None if start is None else parse_pose(start),
            overwrite=overwrite,
            log_format=log_format,
            topics=topic_names(topic),
            report=write_report_of if page else None,
            progress=progress,
        )
    report(summary, show, quiet=quiet, as_json=as_json)


def parse_pose(text: str) -> FloatArray:
    """Return the three numbers of `x,y,yaw`; raise InputError for anything else."""
    import numpy as np

    from posegraph_slam.errors import InputError

    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise InputError("--start", f"'{text}' is not a pose", "give x,y,yaw in metres and radians, as 1.5,-2,0.7")
    return values


def show(outcome: RunOutcome) -> None:
    """Print when the pose was known, and how well."""
    metrics = outcome.metrics
    counts = ", ".join(f"{count} {name}" for name, count in reversed(metrics["health"].items()))
    typer.echo(f"scans     {metrics['scans']} ({counts})")
    if metrics["first_known_s"] is not None:
        typer.echo(f"known     from {metrics['first_known_s']:.1f} s on, lost {metrics['times_lost']} times")
        typer.echo(f"sigma     {metrics['median_position_sigma_m']:.3f} m (median of the position)")
