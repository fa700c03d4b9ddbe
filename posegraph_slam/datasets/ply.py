"""The vertices of PLY files (Turk 1994): ascii and binary of either byte order."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import ByteArray, FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.files import replacing

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
HEADER_BYTES_MAX = 1 << 20


@dataclass(frozen=True, slots=True)
class Element:
    """One element of the header: its rows and the type of each property; None for a list."""

    name: str
    count: int
    properties: dict[str, str | None]


def read_ply(path: Path) -> FloatArray:
    """Read x, y, z (n, 3) of the vertices; other properties, and elements after the vertices, are left out."""
    content = path.read_bytes()
    form, elements, start = _read_header(content, path)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise InputError(path, "has no vertices", f"its elements are {', '.join(names) or 'none'}")
    before, vertex = elements[: names.index("vertex")], elements[names.index("vertex")]
    for element in [*before, vertex]:
        if None in element.properties.values():
            raise InputError(path, f"has a list in element '{element.name}'", "store the vertices first, without lists")
    if not {"x", "y", "z"} <= vertex.properties.keys():
        raise InputError(path, f"has vertices of {', '.join(vertex.properties)}", "they must have x, y and z")
    if form == "ascii":
        return _ascii_vertices(content[start:], sum(e.count for e in before), vertex, path)
    return _binary_vertices(content, start, [*before, vertex], ORDERS[form], path)


def write_ply(points: FloatArray, path: Path, *, colours: ByteArray | None = None) -> None:
    """Write points (n, 3), and RGB `colours` (n, 3) if given, as a binary PLY file; it appears when it is complete.

    Coordinates are doubles, with colours single precision (half a micrometre at 8 m), as viewers expect.
    """
    real = "double" if colours is None else "float"
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property {real} {axis}\n" for axis in "xyz")
    rows = np.ascontiguousarray(points, dtype="<f8")
    if colours is not None:
        header += "".join(f"property uchar {channel}\n" for channel in ("red", "green", "blue"))
        rows = np.empty(len(points), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
        rows["xyz"], rows["rgb"] = points, colours
    with replacing(path) as temporary:
        temporary.write_bytes((header + "end_header\n").encode("ascii") + rows.tobytes())


def _read_header(content: bytes, path: Path) -> tuple[str, list[Element], int]:
    """Format, elements, and the byte at which the data start."""
    end = content.find(b"end_header", 0, HEADER_BYTES_MAX)
    if not content.startswith(b"ply") or end < 0:
        raise InputError(path, "is no PLY file: it has no header from 'ply' to 'end_header'")
    start = content.find(b"\n", end) + 1
    lines = content[:end].decode("ascii", errors="replace").splitlines()
    form, elements = "", list[Element]()
    for number, line in enumerate(lines, start=1):
        words = line.split()
        try:
            match words[:1]:
                case ["format"]:
                    form = words[1]
                case ["element"]:
                    elements.append(Element(words[1], int(words[2]), {}))
                case ["property"]:
                    elements[-1].properties[words[-1]] = None if words[1] == "list" else TYPES[words[1]]
        except (IndexError, ValueError, KeyError) as error:
            raise InputError(f"{path}:{number}", f"'{line}' is no line of a PLY header") from error
    if form not in ORDERS:
        raise InputError(path, f"has the unknown format '{form}'", f"known are {', '.join(ORDERS)}")
    return form, elements, start


def _ascii_vertices(body: bytes, skipped: int, vertex: Element, path: Path) -> FloatArray:
    columns = [list(vertex.properties).index(axis) for axis in "xyz"]
    rows = body.decode("ascii", errors="replace").splitlines()[skipped : skipped + vertex.count]
    try:
        table = np.loadtxt(rows, usecols=columns, ndmin=2) if rows else np.zeros((0, 3))
    except (ValueError, IndexError) as error:
        raise InputError(path, f"has a vertex that cannot be read ({str(error).splitlines()[0]})") from error
    return _complete(table, vertex.count, path)


def _binary_vertices(content: bytes, start: int, elements: list[Element], order: str, path: Path) -> FloatArray:
    for element in elements:
        dtype = np.dtype([(name, order + str(kind)) for name, kind in element.properties.items()])
        stop = start + element.count * dtype.itemsize
        if element.name == "vertex":
            whole = max((min(stop, len(content)) - start) // dtype.itemsize, 0)
            rows = np.frombuffer(content, dtype, count=whole, offset=min(start, len(content)))
            return _complete(np.column_stack([rows[a].astype(np.float64) for a in "xyz"]), element.count, path)
        start = stop
    raise AssertionError("the last element is the vertices")


def _complete(points: FloatArray, count: int, path: Path) -> FloatArray:
    if len(points) != count:
        raise InputError(path, f"ends after {len(points)} of {count} vertices", "the file is truncated: copy it again")
    return points
