"""How the commands speak: results on stdout, progress and warnings on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

import typer


def print_json(value: Mapping[str, Any] | Sequence[Any]) -> None:
    """Print one JSON document, the only thing on stdout of a command with --json."""
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False))


def print_table(rows: Sequence[Sequence[str]], *, title: str = "") -> None:
    """Print rows of cells, the header first; the first column is text, the others are numbers set to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    if title:
        typer.secho(title, bold=True)
    for number, row in enumerate(rows):
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        typer.secho("  ".join(cells).rstrip(), bold=number == 0)


def print_warning(sentence: str) -> None:
    """Print a warning on stderr."""
    typer.secho(f"warning: {sentence}", fg=typer.colors.YELLOW, err=True)


def print_note(sentence: str) -> None:
    """Print on stderr what was done and may be of interest."""
    typer.secho(f"note: {sentence}", dim=True, err=True)


class ProgressBars:
    """Receives progress and draws a bar for each stage on stderr; draws nothing where stderr is no terminal."""

    def __init__(self, *, enabled: bool = True) -> None:
        self._enabled = enabled and sys.stderr.isatty()
        self._tasks: dict[str, Any] = {}
        self._bars: Any = None

    def __enter__(self) -> ProgressBars:
        if self._enabled:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

            columns = TextColumn("{task.description:<22}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
            self._bars = Progress(*columns, console=Console(stderr=True), transient=True)
            self._bars.start()
        return self

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that `done` of `total` units of `stage` are finished."""
        if self._bars is None:
            return
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total)
        self._bars.update(self._tasks[stage], completed=done, total=total)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bars is not None:
            self._bars.stop()
