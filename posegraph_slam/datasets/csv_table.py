"""Numbers between commas, with the line named when one of them is wrong."""

from __future__ import annotations

from pathlib import Path

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.number_text import numbered_lines, parse_numbers
from posegraph_slam.errors import InputError


def read_csv(path: Path, columns: tuple[str, ...]) -> tuple[FloatArray, list[int]]:
    """Read the first `columns` of a comma-separated table into values (N, C) and the line number of each row.

    Comments (#), blank lines and a first line without any number are skipped; further columns are left out. Raises
    `InputError` naming the line where columns are missing or something is not a number.
    """
    rows = numbered_lines(path)
    if rows and not any(map(_is_number, rows[0][1].split(b","))):
        rows = rows[1:]
    if not rows:
        raise InputError(path, "holds no row", f"expected the columns {', '.join(columns)}")
    parsed = []
    for number, line in rows:
        values = _numbers(line, len(columns))
        if values is None:
            problem = f"does not begin with {len(columns)} numbers ({', '.join(columns)})"
            raise InputError(f"{path}:{number}", problem, "correct or remove the line; the file may be truncated")
        parsed.append(values)
    return parse_numbers(b" ".join(parsed)).reshape(-1, len(columns)), [number for number, _ in rows]


def _numbers(line: bytes, count: int) -> bytes | None:
    """Return the first `count` cells of a line between spaces; None where they are fewer or no numbers."""
    cells = line.split(b",")[:count]
    text = b" ".join(cells)
    try:
        return text if len(cells) == count and len(parse_numbers(text)) == count else None
    except ValueError:
        return None


def _is_number(cell: bytes) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
