"""`psg datasets`."""

from __future__ import annotations

from posegraph_slam.cli.arguments import Json, Quiet, Verbose
from posegraph_slam.cli.console import print_json


def datasets(as_json: Json = False, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """List the formats of logs that can be read."""
    import typer

    from posegraph_slam.datasets.registry import available_readers

    readers = available_readers()
    if as_json:
        print_json([{"name": each.name, "description": each.description, "layout": each.layout} for each in readers])
    if as_json or quiet:
        return
    for reader in readers:
        typer.secho(reader.name, bold=True)
        typer.echo(f"  {reader.description}\n  {reader.layout}")
