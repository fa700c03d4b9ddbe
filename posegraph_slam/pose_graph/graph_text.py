"""Line records of pose-graph text files to arrays and back, the part that g2o and TORO files share.

A record is a tag, one or two integer ids and a fixed number of reals. Files without a fault are parsed in compiled
code. For others all reals of a tag are parsed in one call, where a sentinel behind each line makes a line of wrong
length show even if the total would fit; then the faulty line is looked for.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.errors import InputError
from posegraph_slam.pose_graph.decimal_text import count_tags, parse_lines, powers_of_five

SENTINEL = "inf"
"""Not finite, so that it can stand for no number of a valid record."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordFormat:
    """How many ids and reals follow a tag; `ids` None means any number of ids and no reals."""

    ids: int | None
    reals: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Records:
    """The records of one tag: ids (n, k), reals (n, m), and the line (n,) of the file that each stands on."""

    ids: IntArray
    reals: FloatArray
    lines: IntArray


def read_records(path: Path, formats: Mapping[str, RecordFormat]) -> dict[str, Records]:
    """Read every record of a file, grouped by tag in the order of the file; empty lines and # comments are skipped.

    Every tag of `formats` is in the answer, with no records if the file has none.

    Raises `InputError` naming file and line for an unknown tag, a wrong number of values or anything but numbers.
    """
    try:
        data = path.read_bytes()
        if (records := _parse_fast(data, formats)) is not None:
            return records
        text = data.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read ({error})", "give a pose-graph text file") from None
    rows: dict[str, list[str]] = {tag: [] for tag in formats}
    lines: dict[str, list[int]] = {tag: [] for tag in formats}
    for number, line in enumerate(text.splitlines(), 1):
        tag, _, rest = line.lstrip().partition(" ")
        if tag in rows:
            rows[tag].append(rest)
            lines[tag].append(number)
        elif tag and not tag.startswith("#"):
            words = line.split(None, 1)  # a tag may also be followed by a tab
            if words[0] not in rows:
                raise InputError(
                    f"{path}:{number}", f"unknown record {words[0][:40]!r}", "known: " + ", ".join(formats)
                )
            rows[words[0]].append(words[1] if len(words) > 1 else "")
            lines[words[0]].append(number)
    return {tag: _parse(path, tag, rows[tag], lines[tag], formats[tag]) for tag in formats}


def _parse_fast(data: bytes, formats: Mapping[str, RecordFormat]) -> dict[str, Records] | None:
    """Parse a whole file in compiled code; None if anything in it is out of the ordinary, faults included."""
    content = np.frombuffer(bytearray(data), np.uint8)
    names = [name.encode() for name in formats]
    tags = np.frombuffer(bytearray(b"".join(names)), np.uint8)
    tag_start = np.concatenate([[0], np.cumsum([len(name) for name in names])])
    odd, counts = count_tags(content, tags, tag_start)
    if odd:
        return None
    id_counts = np.array([1 if layout.ids is None else layout.ids for layout in formats.values()])
    real_counts = np.array([layout.reals for layout in formats.values()])
    id_start, real_start, line_start = (
        np.concatenate([[0], np.cumsum(counts * each)]) for each in (id_counts, real_counts, np.ones_like(counts))
    )
    ids, bits = np.empty(id_start[-1], np.int64), np.empty(real_start[-1], np.uint64)
    lines = np.empty(line_start[-1], np.int64)
    if not parse_lines(content, tags, tag_start, id_counts, real_counts, id_start, real_start, line_start,
                       *powers_of_five(), ids, bits, lines):  # fmt: skip
        return None
    reals = bits.view(np.float64)
    return {
        name: Records(
            ids=ids[id_start[k] : id_start[k + 1]].reshape(counts[k], id_counts[k]),
            reals=reals[real_start[k] : real_start[k + 1]].reshape(counts[k], real_counts[k]),
            lines=lines[line_start[k] : line_start[k + 1]],
        )
        for k, name in enumerate(formats)
    }


def _parse(path: Path, tag: str, rows: Sequence[str], lines: Sequence[int], layout: RecordFormat) -> Records:
    numbers = np.array(lines, dtype=np.int64)
    if not rows:
        return Records(
            ids=np.zeros((0, layout.ids or 1), dtype=np.int64), reals=np.zeros((0, layout.reals)), lines=numbers
        )
    try:
        if layout.ids is None:
            flat = [(int(word), line) for row, line in zip(rows, lines, strict=True) for word in row.split()]
            pairs = np.array(flat, dtype=np.int64).reshape(-1, 2)
            return Records(ids=pairs[:, :1], reals=np.zeros((len(pairs), 0)), lines=pairs[:, 1])
        split = [row.split(None, layout.ids) for row in rows]
        ids = np.array([[int(word) for word in words[: layout.ids]] for words in split], dtype=np.int64)
        joined = f" {SENTINEL} ".join([words[layout.ids] for words in split]) + f" {SENTINEL}"
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # numpy's way to say that it met no number
            table = np.fromstring(joined, dtype=np.float64, sep=" ").reshape(len(rows), layout.reals + 1)
        if np.isfinite(table[:, :-1]).all() and np.isposinf(table[:, -1]).all() and (ids >= 0).all():
            return Records(ids=ids, reals=np.ascontiguousarray(table[:, :-1]), lines=numbers)
    except (ValueError, IndexError, OverflowError, DeprecationWarning):
        pass
    raise _first_fault(path, tag, rows, lines, layout)


def _first_fault(path: Path, tag: str, rows: Sequence[str], lines: Sequence[int], layout: RecordFormat) -> InputError:
    """Find the line that made parsing fail, value by value."""
    ids = layout.ids
    for row, line in zip(rows, lines, strict=True):
        words = row.split()
        if ids is not None and len(words) != ids + layout.reals:
            return InputError(f"{path}:{line}", f"{tag} has {len(words)} values",
                              f"expected {ids} ids and {layout.reals} numbers")  # fmt: skip
        for position, word in enumerate(words):
            is_id = ids is None or position < ids
            if not (_is_id(word) if is_id else _is_finite_number(word)):
                kind = "a node id (an integer, 0 or more)" if is_id else "a finite number"
                return InputError(
                    f"{path}:{line}", f"value {position + 1} of {tag} is {word[:40]!r}", f"expected {kind}"
                )
    return InputError(path, f"its {tag} records cannot be parsed")


def _is_id(word: str) -> bool:
    try:
        return 0 <= int(word) < 2**63
    except ValueError:
        return False


def _is_finite_number(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word))) and "_" not in word
    except ValueError:
        return False


def format_records(tag: str, ids: IntArray, reals: FloatArray) -> Iterable[str]:
    """Yield one line a record: tag, ids and the shortest decimals that read back to the same doubles."""
    for numbers, values in zip(ids.tolist(), reals.tolist(), strict=True):
        yield " ".join([tag, *map(str, numbers), *map(repr, values)])
