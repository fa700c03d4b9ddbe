"""`psg pf-slam`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from posegraph_slam.cli.arguments import Config, Format, Json, Log, Overwrite, Quiet, Set
from posegraph_slam.cli.console import ProgressBars, print_json, print_note, print_table


def pf_slam(
    log: Log,
    out: Annotated[Path, typer.Option("--out", "-o", help="Run directory.")],
    config: Config = None,
    settings: Set = None,
    log_format: Format = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of every random choice.")] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Map a log with a particle filter: no graph, no loop closures; a baseline, and a way to learn."""
    from posegraph_slam.pipeline.configuration import load_configuration
    from posegraph_slam.pipeline.particle_slam import run_particle_slam

    configuration = load_configuration(config or [], settings or [], seed=seed)
    with ProgressBars(enabled=not quiet) as progress:
        summary = run_particle_slam(
            log, configuration, out=out, overwrite=overwrite, log_format=log_format, progress=progress
        )
    if as_json:
        print_json({"folder": str(summary.folder), "metrics": summary.metrics, "run": summary.record})
    elif not quiet:
        for remark in summary.remarks:
            print_note(remark)
        print_table(summary.table.as_text_rows())
        typer.echo(f"\nresults:  {summary.folder}")
