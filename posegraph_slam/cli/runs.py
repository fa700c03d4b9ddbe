"""What commands that leave a run directory have in common: how they end."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import typer

from posegraph_slam.cli.console import print_json, print_note

if TYPE_CHECKING:
    from posegraph_slam.pipeline.recording import RunOutcome

Outcome = TypeVar("Outcome", bound="RunOutcome")


def report(outcome: Outcome, show: Callable[[Outcome], None], *, quiet: bool, as_json: bool) -> None:
    """Print a run as JSON, or its remarks (on stderr), what `show` prints of it, and where its results lie."""
    from posegraph_slam.pipeline.run_directory import REPORT

    if as_json:
        print_json({"folder": str(outcome.folder), "metrics": outcome.metrics, "run": outcome.record})
    elif not quiet:
        for remark in outcome.remarks:
            print_note(remark)
        show(outcome)
        typer.echo(f"\nresults:  {outcome.folder}")
        if (outcome.folder / REPORT).is_file():
            typer.echo(f"report:   {outcome.folder / REPORT}")
