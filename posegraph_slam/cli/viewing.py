"""`psg view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from posegraph_slam.cli.arguments import Json, Quiet, Verbose
from posegraph_slam.cli.console import print_json


def view(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run directory.")],
    save: Annotated[
        Path | None, typer.Option("--save", metavar="FILE.rrd", help="Write a recording instead of opening the viewer.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Show a run in the rerun viewer: map, paths, closures, and the robot moving over time."""
    from posegraph_slam.report.viewer import view_run

    shown = view_run(run, save=save)
    if as_json:
        print_json(shown)
    elif not quiet:
        typer.echo(", ".join(f"{count} {name}" for name, count in shown.items()))
        if save is not None:
            typer.echo(f"recording:  {save}")
