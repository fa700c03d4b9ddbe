"""Lines of a CARMEN log to arrays: one pass over the lines, then one parse of all numbers of a kind of message.

Every message is `NAME numbers... ipc_stamp host logger_stamp`. Messages of equal layout are parsed together, about
0.1 us a number; only when that fails are they looked at one by one, to name the line that is wrong.
"""

from __future__ import annotations

import gzip
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray, IntArray, in_range, range_fault, read_only, single
from posegraph_slam.datasets.number_text import parse_numbers
from posegraph_slam.errors import InputError

SCAN_MESSAGES = (b"FLASER", b"ROBOTLASER1", b"RLASER")
NUMERIC_MESSAGES = (*SCAN_MESSAGES, b"ODOM")
Lines = list[tuple[int, bytes]]
"""Line numbers from one, and the lines."""
LONGEST_NAME = 24
ROBOTLASER_HEAD = 7
"""Numbers before the count of readings: type, start angle, field of view, resolution, maximum range, accuracy, mode."""
ROBOTLASER_TAIL = 11
"""Numbers after the remissions without the stamp: laser pose, robot pose, two speeds, two distances, turn axis."""


@dataclass(slots=True)
class Messages:
    """The lines of a log by kind: numbered numeric messages, parameters, and how many were ignored."""

    numbered: dict[bytes, Lines]
    parameters: dict[str, str] = field(default_factory=dict)
    ignored: dict[str, int] = field(default_factory=dict)
    truncated_line: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanMessages:
    """Scans of one laser with equal numbers of beams, in file order.

    `ranges_m` (N, B), `laser_xyt` and `robot_xyt` (N, 3) in the odometry frame; `configuration` (N, 7) holds the
    numbers at the head of ROBOTLASER1 and has no columns for other messages. `dropped` scans had other beam counts.
    """

    line_numbers: IntArray
    stamps_s: FloatArray
    ranges_m: Float32Array
    laser_xyt: FloatArray
    robot_xyt: FloatArray
    configuration: FloatArray
    dropped: int

    def __post_init__(self) -> None:
        for name in ("stamps_s", "laser_xyt", "robot_xyt", "configuration"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def read_lines(path: Path) -> Messages:
    """Sort the lines of a log, plain or .gz, by message; a malformed last line is taken as cut off and dropped."""
    messages = Messages({name: [] for name in NUMERIC_MESSAGES})
    last: tuple[bytes, int] | None = None
    for number, line in enumerate(_bytes(path).split(b"\n"), 1):
        words = line[:LONGEST_NAME].split(None, 1)
        if not words or words[0].startswith(b"#"):
            continue
        name = words[0]
        last = (name, number)
        if name in messages.numbered:
            messages.numbered[name].append((number, line))
        elif name == b"PARAM":
            fields = line.decode("latin-1").split()
            if len(fields) > 2:
                messages.parameters[fields[1]] = fields[2]
        else:
            text = name.decode("latin-1")
            messages.ignored[text] = messages.ignored.get(text, 0) + 1
    if last is not None and last[0] in messages.numbered:
        name, number = last
        if not _is_whole(name, messages.numbered[name][-1][1]):
            messages.numbered[name].pop()
            messages.truncated_line = number
    return messages


def _bytes(path: Path) -> bytes:
    try:
        if path.suffix == ".gz":
            with gzip.open(path) as file:
                return file.read()
        return path.read_bytes()
    except (OSError, EOFError, zlib.error) as error:
        problem = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        raise InputError(path, problem, "the file may be truncated: copy it again") from error


def parse_odometry(path: Path, messages: Messages) -> tuple[FloatArray, FloatArray]:
    """Return the stamps (N,) and poses [x, y, theta] (N, 3) of the ODOM messages, in file order."""
    lines = messages.numbered[b"ODOM"]
    if not lines:
        return np.empty(0), np.empty((0, 3))
    [(numbers, rows)] = _batches(path, b"ODOM", lines)
    _refuse_not_finite(path, rows[:, [0, 1, 2, -1]], numbers)
    return rows[:, -1], rows[:, :3]


def parse_scans(path: Path, messages: Messages, name: bytes) -> ScanMessages:
    """Return the scans of the messages called `name`, of the number of beams that most of them have."""
    groups: dict[tuple[bytes, int], Lines] = {}
    head = _count_column(name)
    for number, line in messages.numbered[name]:
        # Equal counts of readings and of spaces mostly mean one layout; ROBOTLASER1 may carry remissions or not.
        words = line.split(None, head + 2)
        groups.setdefault((words[head + 1] if len(words) > head + 1 else b"", line.count(b" ")), []).append(
            (number, line)
        )
    parts: dict[int, list[tuple[IntArray, FloatArray]]] = {}
    for lines in groups.values():
        for numbers, rows in _batches(path, name, lines):
            parts.setdefault(int(rows[0, head]), []).append((numbers, rows))
    beams = max(parts, key=lambda beams: sum(len(rows) for _, rows in parts[beams]))
    kept = sum(len(rows) for _, rows in parts[beams])
    return _assemble(path, name, parts[beams], len(messages.numbered[name]) - kept)


def _assemble(path: Path, name: bytes, parts: list[tuple[IntArray, FloatArray]], dropped: int) -> ScanMessages:
    """Cut the columns of each layout apart and bring the scans back into file order."""
    head = _count_column(name)
    beams = int(parts[0][1][0, head])
    numbers = np.concatenate([numbers for numbers, _ in parts])
    order = np.argsort(numbers, kind="stable")
    tail = ROBOTLASER_TAIL + 1 if name == b"ROBOTLASER1" else 7

    def columns(cut: slice) -> FloatArray:
        return np.concatenate([rows[:, cut] for _, rows in parts])[order]

    others = columns(slice(-tail, None))
    configuration = columns(slice(0, head))
    _refuse_not_finite(path, np.column_stack([configuration, others]), numbers[order])
    return ScanMessages(
        line_numbers=numbers[order],
        stamps_s=others[:, -1],
        ranges_m=single(columns(slice(head + 1, head + 1 + beams))),
        laser_xyt=others[:, 0:3],
        robot_xyt=others[:, 3:6],
        configuration=configuration,
        dropped=dropped,
    )


def _batches(path: Path, name: bytes, lines: Lines) -> list[tuple[IntArray, FloatArray]]:
    """Parse lines into line numbers (n,) and rows (n, width), one pair a layout; a row ends with the ipc stamp.

    Raises `InputError` for the first line that is malformed.
    """
    numbers = np.array([number for number, _ in lines])
    try:
        width, counts = _layout(name, parse_numbers(_numeric(lines[0][1])))
        rows = parse_numbers(b" ".join(_numeric(line) for _, line in lines)).reshape(len(lines), width)
        if all((rows[:, column] == rows[0, column]).all() for column in counts):
            return [(numbers, rows)]
    except (ValueError, IndexError):
        pass
    layouts: dict[tuple[int, ...], list[int]] = {}
    parsed = []
    for k, (number, line) in enumerate(lines):
        try:
            row = parse_numbers(_numeric(line))
            width, counts = _layout(name, row)
        except (ValueError, IndexError):
            where, problem = f"{path}:{number}", f"malformed {name.decode()} message"
            raise InputError(where, problem, "correct or remove the line") from None
        parsed.append(row)
        layouts.setdefault((width, *(int(row[column]) for column in counts)), []).append(k)
    return [(numbers[index], np.stack([parsed[k] for k in index])) for index in layouts.values()]


def _layout(name: bytes, row: FloatArray) -> tuple[int, list[int]]:
    """Return the width that `row` must have and the columns with counts; raise ValueError when it has another."""
    counts: list[int] = []
    width = 7
    if name != b"ODOM":
        head = _count_column(name)
        counts = [head]
        width = head + 1 + _count(row, head, 1) + 7
    if name == b"ROBOTLASER1":
        remissions = width - 7
        counts.append(remissions)
        width = remissions + 1 + _count(row, remissions, 0) + ROBOTLASER_TAIL + 1
    if len(row) != width:
        raise ValueError(f"{len(row)} numbers instead of {width}")
    return width, counts


def _count(row: FloatArray, column: int, least: int) -> int:
    """Return the count in a column; raise IndexError or ValueError when there is none."""
    value = float(row[column])
    if not (value >= least and value.is_integer()):
        raise ValueError(f"{value} is no count")
    return int(value)


def _count_column(name: bytes) -> int:
    return ROBOTLASER_HEAD if name == b"ROBOTLASER1" else 0


def _numeric(line: bytes) -> bytes:
    """Cut the name, the host and the logger's stamp off a line."""
    return line.split(None, 1)[1].rsplit(None, 2)[0]


def _is_whole(name: bytes, line: bytes) -> bool:
    try:
        _layout(name, parse_numbers(_numeric(line)))
    except (ValueError, IndexError):
        return False
    return True


def _refuse_not_finite(path: Path, values: FloatArray, numbers: IntArray) -> None:
    bad = ~in_range(values).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        problem = f"holds a pose or stamp that is {range_fault(values[row])}"
        raise InputError(f"{path}:{numbers[row]}", problem, "correct or remove the line")
