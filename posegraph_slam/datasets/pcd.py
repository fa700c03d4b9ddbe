"""The points of PCD files (Point Cloud Library, version 0.7): ascii, binary and compressed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from posegraph_slam.arrays import ByteArray, FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.jit import kernel

KINDS = {"F": "f", "I": "i", "U": "u"}


def read_pcd(path: Path) -> FloatArray:
    """Read x, y, z (n, 3); points without return are NaN in organised clouds and come back as they are."""
    content = path.read_bytes()
    header, start = _read_header(content, path)
    count, dtype = _layout(header, path)
    form = header["DATA"][0].lower()
    if form == "ascii":
        return _complete(_ascii_points(content[start:], header["FIELDS"], dtype, path), count, path)
    if form not in ("binary", "binary_compressed"):
        raise InputError(path, f"has the unknown data format '{form}'", "known are ascii, binary, binary_compressed")
    if form == "binary":
        rows = np.frombuffer(content, dtype, count=min(count, (len(content) - start) // dtype.itemsize), offset=start)
        return _complete(np.column_stack([rows[a].astype(np.float64) for a in "xyz"]), count, path)
    return _compressed_points(content, start, count, dtype, path)


def _read_header(content: bytes, path: Path) -> tuple[dict[str, list[str]], int]:
    """Words of each header line by its first word, and the byte at which the data start."""
    header, start = dict[str, list[str]](), 0
    while "DATA" not in header:
        end = content.find(b"\n", start)
        if end < 0 or end > 1 << 16:
            raise InputError(path, "is no PCD file: its header has no DATA line")
        words = content[start:end].decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
        start = end + 1
    return header, start


def _layout(header: dict[str, list[str]], path: Path) -> tuple[int, np.dtype]:
    """Points and the type of one of them; a field of several numbers is one subarray."""
    try:
        fields, kinds = header["FIELDS"], [KINDS[kind] for kind in header["TYPE"]]
        sizes = [int(size) for size in header["SIZE"]]
        counts = [int(number) for number in header.get("COUNT", ["1"] * len(fields))]
        points = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        names = [name if name in ("x", "y", "z") else f"_{column}" for column, name in enumerate(fields)]
        parts = zip(names, kinds, sizes, counts, strict=True)
        dtype = np.dtype(
            [(name, f"<{kind}{size}", (number,) if number > 1 else ()) for name, kind, size, number in parts]
        )
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise InputError(path, f"has a header that does not describe its points ({error})") from error
    if not {"x", "y", "z"} <= set(names):
        raise InputError(path, f"has points of {', '.join(fields)}", "they must have x, y and z")
    return points, dtype


def _ascii_points(body: bytes, fields: list[str], dtype: np.dtype, path: Path) -> FloatArray:
    widths = [int(np.prod(dtype[column].shape)) for column in range(len(fields))]
    first = np.cumsum([0, *widths])
    columns = [int(first[fields.index(axis)]) for axis in "xyz"]
    try:
        rows = body.decode("ascii", errors="replace").splitlines()
        return np.loadtxt(rows, usecols=columns, ndmin=2) if rows else np.zeros((0, 3))
    except (ValueError, IndexError) as error:
        raise InputError(path, f"has a point that cannot be read ({str(error).splitlines()[0]})") from error


def _compressed_points(content: bytes, start: int, count: int, dtype: np.dtype, path: Path) -> FloatArray:
    """Points of an LZF block that holds one field after the other."""
    sizes = np.frombuffer(content[start : start + 8], "<u4")
    packed = np.frombuffer(content[start + 8 :], np.uint8)
    size = count * dtype.itemsize
    if len(sizes) < 2 or len(packed) < sizes[0] or sizes[1] != size:
        raise InputError(path, "has a compressed block that does not fit its header", "the file may be truncated")
    raw = expand_lzf(packed[: sizes[0]], size)
    if len(raw) != size:
        raise InputError(path, "has a compressed block that is damaged", "copy the file again")
    columns, offset = dict[str, FloatArray](), 0
    for name in dtype.names or ():
        part = raw[offset : offset + count * dtype[name].itemsize]
        offset += len(part)
        if name in ("x", "y", "z"):
            columns[name] = np.frombuffer(part.tobytes(), dtype[name]).astype(np.float64)
    return np.column_stack([columns[axis] for axis in "xyz"])


@kernel
def expand_lzf(packed: ByteArray, size: int) -> ByteArray:
    """Expand LZF bytes into `size` bytes; fewer come back where the input is damaged.

    A control byte under 32 announces that many literals less one; else its upper three bits and lower five give the
    length less two and the upper part of the distance of a repetition (7 in the upper three: one more length byte).
    """
    raw = np.zeros(size, dtype=np.uint8)
    at, to = 0, 0
    while at < len(packed):
        control = int(packed[at])
        at += 1
        if control < 32:
            length = control + 1
            if at + length > len(packed) or to + length > size:
                return raw[:0]
            raw[to : to + length] = packed[at : at + length]
            at += length
        else:
            length = (control >> 5) + 2
            if at + (2 if length == 9 else 1) > len(packed):
                return raw[:0]
            if length == 9:
                length += int(packed[at])
                at += 1
            origin = to - ((control & 31) << 8) - int(packed[at]) - 1
            at += 1
            if origin < 0 or to + length > size:
                return raw[:0]
            for k in range(length):  # one by one: a repetition may overlap itself
                raw[to + k] = raw[origin + k]
        to += length
    return raw[:to]


def _complete(points: FloatArray, count: int, path: Path) -> FloatArray:
    if len(points) != count:
        raise InputError(path, f"ends after {len(points)} of {count} points", "the file is truncated: copy it again")
    return points
