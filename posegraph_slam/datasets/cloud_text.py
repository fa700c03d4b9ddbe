"""Points in text files: x y z on every line between spaces, commas or semicolons, with or without a header."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError

COMMENTS = ("#", "//")
HEADER_LINES_MAX = 2
"""A count and a title, as XYZ and PTS files have, or the names of the columns."""

Lines = list[tuple[int, str]]
"""Numbers of lines, from 1, and what they hold."""


def read_text_points(path: Path) -> FloatArray:
    """Read x, y, z (n, 3) of a text file, the first three columns unless a header names others x, y and z.

    Comments (# or //) and blank lines count for nothing; a count in the first line is held against the points. Raises
    `InputError` naming the first line that cannot be read.
    """
    text = path.read_bytes().decode("utf-8-sig", errors="replace")
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line and not line.startswith(COMMENTS)]
    if not lines:
        raise InputError(path, "holds no points", "give x y z on every line")
    middle = lines[len(lines) // 2][1]
    delimiter = next((mark for mark in ";," if mark in middle), None)
    columns, announced, skipped = _read_header(lines, delimiter)
    points = _read_rows(lines[skipped:], delimiter, columns, path)
    if announced is not None and announced != len(points):
        problem = f"holds {len(points)} points where its first line announces {announced}"
        raise InputError(path, problem, "the file may be truncated: copy it again")
    return points


def _read_header(lines: Lines, delimiter: str | None) -> tuple[list[int], int | None, int]:
    """Columns of x, y and z, the number of points if the first line is one, and the lines that hold no points."""
    columns, announced, skipped = [0, 1, 2], None, 0
    for _, line in lines[:HEADER_LINES_MAX]:
        words = _words(line, delimiter)
        if skipped == 0 and len(words) == 1 and words[0].isdecimal():
            announced = int(words[0])
        elif any(_is_number(word) for word in words):
            break
        elif {"x", "y", "z"} <= {word.lower() for word in words}:
            columns = [[word.lower() for word in words].index(axis) for axis in "xyz"]
        skipped += 1
    return columns, announced, skipped


def _read_rows(lines: Lines, delimiter: str | None, columns: list[int], path: Path) -> FloatArray:
    if not lines:
        return np.zeros((0, 3))
    try:
        rows = np.loadtxt([line for _, line in lines], delimiter=delimiter, usecols=columns, ndmin=2, comments=None)
    except ValueError as error:
        number, line = next((n, row) for n, row in lines if not _gives_a_point(row, delimiter, columns))
        shown = line if len(line) <= 60 else line[:57] + "..."
        raise InputError(f"{path}:{number}", f"'{shown}' gives no point", "give x y z on every line") from error
    return np.asarray(rows, dtype=np.float64)


def _gives_a_point(line: str, delimiter: str | None, columns: list[int]) -> bool:
    words = line.split(delimiter)
    return len(words) > max(columns) and all(_is_number(words[column]) for column in columns)


def _words(line: str, delimiter: str | None) -> list[str]:
    return [word.strip().strip('"') for word in line.split(delimiter)]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word and word.isascii()  # Python reads more than NumPy
