"""The folder that a run leaves: built beside its final name, moved there when complete, and read back later.

docs/run_directory.md describes the files.
"""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.errors import InputError
from posegraph_slam.files import name_target, replacing
from posegraph_slam.pipeline.configuration import Configuration, load_configuration
from posegraph_slam.pipeline.run_forms import MetricsForm, RecordForm, read_form
from posegraph_slam.pipeline.settings_files import to_toml

RECORD, CONFIGURATION, METRICS, LOOPS = "run.json", "config.toml", "metrics.json", "loops.csv"
REPORT = "report.html"
EDITS, APPLIED_EDITS = "edits.toml", "applied_edits.toml"
"""A person's edits of this run, and those of another run that this one was made with."""
FORMAT_VERSION = 1
"""Raised when files change so that older readers would misread them."""


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """A run directory being written, at `folder` until it is complete."""

    folder: Path

    def path(self, name: str) -> Path:
        """Return where the file `name` (with subfolders) goes, making its folder."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write_text(self, name: str, text: str) -> None:
        """Write a text file as UTF-8; bytes of file names that are no text become \\udcXX, as JSON escapes them."""
        with replacing(self.path(name)) as temporary:
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")

    def write_json(self, name: str, value: object) -> None:
        """Write records, arrays and numbers as JSON; what is not finite becomes null."""
        self.write_text(name, json.dumps(plain(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n")

    def write_rows(self, name: str, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """Write a CSV table; numbers keep full precision, what is not finite or None is left empty."""
        with replacing(self.path(name)) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(header)
            for row in rows:
                if len(row) != len(header):
                    raise InputError(name, f"a row of {len(row)} values does not fit {len(header)} columns")
                writer.writerow([_cell(value) for value in row])

    def write_configuration(self, configuration: Configuration) -> None:
        """Write every key of the effective configuration, with its description."""
        self.write_text(CONFIGURATION, to_toml(configuration))


def plain(value: object) -> Any:
    """Return `value` as dicts, lists, strings, numbers, booleans and None only; what is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(plain(key)): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _cell(value: object) -> str:
    value = plain(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value is None else str(value)


def require_free(path: Path, *, overwrite: bool) -> None:
    """Raise InputError unless a run may be written to `path`.

    An existing run directory needs `overwrite`; a folder with anything else in it, a run that was edited by hand, or a
    file is never replaced.
    """
    if path.is_dir():
        if any(path.iterdir()) and not (path / RECORD).is_file():
            raise InputError(path, "is a folder that is not a run directory", "choose another --out")
        if not overwrite and (path / RECORD).is_file():
            raise InputError(path, "already holds a run", "add --overwrite to replace it, or choose another --out")
        if (path / EDITS).is_file():
            raise InputError(path / EDITS, "was made by hand and would be lost", "move it away, then --overwrite")
    elif path.exists():
        raise InputError(path, "is a file", "choose another --out")


@contextmanager
def create_run_directory(path: Path, *, overwrite: bool = False) -> Iterator[RunDirectory]:
    """Yield a `RunDirectory` to fill, and give it the name `path` when the block ends well.

    Until then it is `.<name>.partial-<pid>` beside `path`, removed if the block raises; a run that is replaced stays
    in place until that moment. Raises InputError where `path` is taken.
    """
    path = path.resolve()
    require_free(path, overwrite=overwrite)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    try:
        yield RunDirectory(partial)
        require_free(path, overwrite=overwrite)
        _publish(partial, path)
    except OSError as error:
        name_target(error, partial, path)
        raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _publish(partial: Path, path: Path) -> None:
    if not path.exists():
        partial.rename(path)
        return
    old = path.with_name(f".{path.name}.old-{os.getpid()}")
    path.rename(old)
    try:
        partial.rename(path)
    except OSError:
        old.rename(path)
        raise
    shutil.rmtree(old)


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredRun:
    """A complete run directory: its record, effective configuration and metrics."""

    folder: Path
    record: Mapping[str, Any]
    configuration: Configuration
    metrics: Mapping[str, Any]

    def path(self, name: str) -> Path:
        """Return the file `name` of the run; raise InputError where the run has none."""
        path = self.folder / name
        if not path.exists():
            raise InputError(self.folder, f"has no {name}", "run `psg optimize` again to write it")
        return path


def read_run_directory(folder: Path) -> StoredRun:
    """Read back what `create_run_directory` left; raise InputError where `folder` is no complete run."""
    if not (folder / RECORD).is_file():
        raise InputError(folder, f"is not a run directory (it has no {RECORD})", "name a folder made by psg optimize")
    record = read_form(folder / RECORD, RecordForm)
    version = record.get("format_version")
    if version != FORMAT_VERSION:
        raise InputError(
            folder / RECORD, f"has format version {version}, not {FORMAT_VERSION}", "run `psg optimize` again"
        )
    return StoredRun(
        folder=folder,
        record=record,
        configuration=load_configuration([folder / CONFIGURATION]),
        metrics=read_form(folder / METRICS, MetricsForm) if (folder / METRICS).is_file() else {},
    )
