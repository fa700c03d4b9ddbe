"""`psg config list` and `psg config show`."""

from __future__ import annotations

from typing import Annotated

import typer

from posegraph_slam.cli.arguments import Json, Quiet, Set, Verbose
from posegraph_slam.cli.console import print_json

app = typer.Typer(help="List the presets, and show every configuration key with its value.", no_args_is_help=True)


@app.command("list")
def list_presets(as_json: Json = False, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """List the presets and what they are for."""
    from posegraph_slam.pipeline.configuration import available_presets, preset_title

    presets = available_presets()
    if as_json:
        print_json([{"name": name, "title": preset_title(path), "file": str(path)} for name, path in presets.items()])
    if as_json or quiet:
        return
    width = max(map(len, presets), default=0)
    for name, path in presets.items():
        typer.echo(f"{name:<{width}}  {preset_title(path)}")


@app.command("show")
def show(
    files: Annotated[list[str] | None, typer.Argument(metavar="[FILE|PRESET]...")] = None,
    settings: Set = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Print the effective configuration as TOML: every key with its value, meaning and range.

    Files and presets are merged in the order given over the defaults, then --set. Save the output as a file of your own
    and pass it to `psg optimize --config`.
    """
    from posegraph_slam.pipeline.configuration import load_configuration
    from posegraph_slam.pipeline.settings_files import to_toml

    configuration = load_configuration(files or [], settings or [])
    if as_json:
        print_json(configuration.model_dump(mode="json"))
    elif not quiet:
        typer.echo(to_toml(configuration), nl=False)
