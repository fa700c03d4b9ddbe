"""The commands put together, and how every one of them ends: exit codes and one line for an error."""

from __future__ import annotations

import sys
import traceback
import warnings
from io import TextIOWrapper
from typing import Annotated, Any, TextIO

import typer
from typer.core import TyperGroup

from posegraph_slam import __version__
from posegraph_slam.cli import (
    alignment,
    attitude,
    configuration,
    conversion,
    datasets,
    editing,
    evaluating,
    inspection,
    localization,
    optimisation,
    particle_slam,
    reporting,
    simulation,
    solving,
    viewing,
)
from posegraph_slam.errors import PosegraphSlamError

EXIT_ERROR, EXIT_INTERRUPTED = 2, 130
LINE_MAX = 1000
"""Characters of an error at most; our own are shorter, but they quote names and what others raise."""


class Commands(TyperGroup):
    """Runs a command and turns what a user can cause into one line on stderr; other exceptions are bugs and pass."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command of `ctx`; exit with 2 on a user's error and 130 on Ctrl-C."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.secho("\ninterrupted; nothing was written", fg=typer.colors.RED, err=True)
            raise typer.Exit(EXIT_INTERRUPTED) from None
        except BrokenPipeError:
            raise
        except (PosegraphSlamError, OSError, MemoryError) as error:
            if ctx.params.get("debug"):
                typer.echo(traceback.format_exc(), err=True)
            typer.secho(f"error: {one_line(error)}", fg=typer.colors.RED, err=True)
            raise typer.Exit(EXIT_ERROR) from None


def one_line(error: Exception) -> str:
    """Return the message of an error on one line, with the file first for errors of the system."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, MemoryError):
        return f"memory: not enough for this input ({str(error) or 'no more can be had'}); give a smaller one"
    line = " ".join(str(error).split()) or type(error).__name__
    if len(line) > LINE_MAX:  # it quotes what it read, which may be a whole file: keep where, what and the remedy
        return f"{line[: LINE_MAX // 2]} ... {line[-LINE_MAX // 2 :]}"
    return line


def show_version(wanted: bool) -> None:
    """Print the version and end."""
    if wanted:
        typer.echo(f"psg {__version__}")
        raise typer.Exit


app = typer.Typer(
    name="psg",
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=show_version, is_eager=True)
    ] = False,
) -> None:
    """Turn a robot's log into an optimised trajectory and maps.

    Most logs need `psg optimize LOG` alone; `psg inspect LOG` tells first what is in one.

    Exit codes: 0 done, 2 wrong input or usage, 130 interrupted, 1 a bug.
    """


app.command("optimize", short_help="Optimise a log: trajectory, maps, comparison.")(optimisation.optimize)
app.command("icp", short_help="Align clouds with the model of an object.")(alignment.icp)
app.command("solve", short_help="Solve a pose graph and certify the optimum.")(solving.solve)
app.command("edit", short_help="Edit the closures of a run in the browser.")(editing.edit)
app.command("report", short_help="Show a run in one HTML file.")(reporting.report)
app.command("inspect", short_help="Show what is in a log, and what is suspicious.")(inspection.inspect)
app.command("localize", short_help="Find the robot in a known map at every scan.")(localization.localize)
app.command("pf-slam", short_help="Map a log with a particle filter.")(particle_slam.pf_slam)
app.command("simulate", short_help="Write a simulated log with its truth.")(simulation.simulate)
app.command("attitude", short_help="Estimate orientation from an IMU.")(attitude.attitude)
app.command("convert", short_help="Write a trajectory or log in another format.")(conversion.convert)
app.command("evaluate", short_help="Measure a trajectory against the truth.")(evaluating.evaluate)
app.command("compare", short_help="Put several runs side by side.")(evaluating.compare)
app.command("view", short_help="Show a run in the rerun viewer.")(viewing.view)
app.command("datasets", short_help="List the formats that can be read.")(datasets.datasets)
app.add_typer(configuration.app, name="config", short_help="List presets, show the configuration.")


def main() -> None:
    """Run the command line."""
    warnings.showwarning = _show_warning
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # names and signs that a terminal cannot show must not end a command
            stream.reconfigure(errors="backslashreplace")
    app()


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Show a warning as one line without the place in the code."""
    sys.stderr.write(f"warning: {' '.join(str(message).split())}\n")
