"""Numbers from text, a whole file at a time, with the line named when one of them is wrong."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, in_range, range_fault
from posegraph_slam.errors import InputError

BYTE_ORDER_MARK = b"\xef\xbb\xbf"


def parse_numbers(text: bytes) -> FloatArray:
    """Parse numbers separated by white space, about 0.1 us each; raise ValueError where something is not a number."""
    with warnings.catch_warnings():
        # NumPy before 2.4 only warns about text that it could not parse to the end.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.asarray(np.fromstring(text, sep=" "), dtype=np.float64)  # type: ignore[arg-type,unused-ignore]
        except DeprecationWarning as error:
            raise ValueError(str(error)) from error


def numbered_lines(path: Path) -> list[tuple[int, bytes]]:
    """Return the lines of a text file that hold something, stripped, each with its number.

    Blank lines, lines that begin with # and the byte order mark that some editors write are skipped; lines end with
    LF or CRLF. Raises `InputError` where the file cannot be read.
    """
    try:
        lines = path.read_bytes().removeprefix(BYTE_ORDER_MARK).split(b"\n")
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error})", "check the path") from error
    rows = [(number, line.strip()) for number, line in enumerate(lines, 1)]
    return [(number, line) for number, line in rows if line and not line.startswith(b"#")]


def read_table(path: Path, columns: tuple[str, ...]) -> tuple[FloatArray, list[int]]:
    """Read a text table of `columns` into values (N, C) and the line number of each row.

    Blank lines and lines that begin with # are skipped. Raises `InputError` naming file and line when a row has another
    number of columns or something that is not a number, and when the file cannot be read or holds no row.
    """
    rows = numbered_lines(path)
    if not rows:
        raise InputError(path, "holds no row", f"expected the columns {' '.join(columns)}")
    for number, line in rows:
        found = len(line.split())
        if found != len(columns):
            problem = f"has {found} columns instead of the {len(columns)} of '{' '.join(columns)}'"
            raise InputError(f"{path}:{number}", problem, "correct or remove the line")
    try:
        values = parse_numbers(b" ".join(line for _, line in rows))
    except ValueError:
        number = next(number for number, line in rows if not _is_numeric(line))
        raise InputError(f"{path}:{number}", "holds something that is not a number", "correct the line") from None
    return values.reshape(-1, len(columns)), [number for number, _ in rows]


def _is_numeric(line: bytes) -> bool:
    try:
        parse_numbers(line)
    except ValueError:
        return False
    return True


def refuse_first(bad: BoolArray | np.bool_, path: Path, numbers: list[int], problem: str) -> None:
    """Raise `InputError` for the first row whose flag in `bad` (N,) is set."""
    if np.any(bad):
        raise InputError(f"{path}:{numbers[int(np.argmax(bad))]}", problem, "correct or remove the line")


def require_in_range(values: FloatArray, path: Path, numbers: list[int]) -> None:
    """Raise `InputError` for the first row of values (N, C) that holds one that is not finite or far too large."""
    bad = ~in_range(values).all(axis=1)
    if bad.any():
        refuse_first(bad, path, numbers, f"holds a value that is {range_fault(values[int(np.argmax(bad))])}")
