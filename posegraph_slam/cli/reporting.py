"""`psg report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from posegraph_slam.cli.arguments import Json, Quiet, Verbose
from posegraph_slam.cli.console import print_json

Run = Annotated[Path, typer.Argument(metavar="RUN", help="Run directory, made by psg optimize or another command.")]


def report(
    run: Run,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE.html", help="Where to; default: report.html in RUN.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Show a run in one HTML file that needs no network: comparison, interactive map, closures, residuals, times."""
    from posegraph_slam.errors import InputError
    from posegraph_slam.report.findings import warnings
    from posegraph_slam.report.page import write_report
    from posegraph_slam.report.run_content import read_run_content

    if out is not None and out.is_dir():
        raise InputError(out, "is a folder", "give the file to write, as --out report.html")
    path = write_report(run, out)
    if as_json:
        content = read_run_content(run)
        print_json({"report": str(path), "bytes": path.stat().st_size, "warnings": warnings(content)})
    elif not quiet:
        typer.echo(f"report:   {path}")
