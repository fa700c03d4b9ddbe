"""Point clouds in files: every format gives the same points, and a damaged file is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import savemat

from posegraph_slam.datasets.clouds import read_cloud
from posegraph_slam.datasets.pcd import expand_lzf
from posegraph_slam.datasets.ply import write_ply
from posegraph_slam.errors import InputError

POINTS = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32).astype(np.float64)


def lzf_literals(data: bytes) -> bytes:
    """Bytes as LZF runs of literals."""
    return b"".join(bytes([len(data[k : k + 32]) - 1]) + data[k : k + 32] for k in range(0, len(data), 32))


def pcd(form: str, points: np.ndarray) -> bytes:
    """Build a PCD file with an intensity between the coordinates and a field of two numbers."""
    dtype = np.dtype([("x", "<f4"), ("i", "<u2"), ("pair", "<f4", (2,)), ("y", "<f4"), ("z", "<f8")])
    rows = np.zeros(len(points), dtype)
    rows["x"], rows["y"], rows["z"], rows["i"] = *points.T, np.arange(len(points))
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x intensity pair y z\nSIZE 4 2 4 4 8\nTYPE F U F F F\nCOUNT 1 1 2 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {form}\n"
    ).encode()
    if form == "ascii":
        lines = [f"{x:.17g} 7 0 0 {y:.17g} {z:.17g}" for x, y, z in points]
        return header + "\n".join(lines).encode()
    if form == "binary":
        return header + rows.tobytes()
    columns = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in dtype.names)
    packed = lzf_literals(columns)
    return header + np.array([len(packed), len(columns)], "<u4").tobytes() + packed


def ply(form: str, points: np.ndarray) -> bytes:
    """Build a PLY file with an element before the vertices, a colour in them, and faces after them."""
    header = (
        f"ply\nformat {form} 1.0\ncomment made here\nelement camera 1\nproperty int id\n"
        f"element vertex {len(points)}\nproperty float x\nproperty uchar red\nproperty float y\nproperty double z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if form == "ascii":
        rows = [f"{x:.17g} 12 {y:.17g} {z:.17g}" for x, y, z in points]
        return header + "\n".join(["5", *rows, "3 0 1 2", ""]).encode()
    order = "<" if "little" in form else ">"
    rows = np.zeros(len(points), np.dtype([("x", order + "f4"), ("r", "u1"), ("y", order + "f4"), ("z", order + "f8")]))
    rows["x"], rows["y"], rows["z"] = points.T
    return header + np.array([5], order + "i4").tobytes() + rows.tobytes() + b"\x03" + bytes(12)


def store(folder: Path, kind: str) -> Path:
    """Write POINTS in one of the formats."""
    suffix, _, form = kind.partition(" ")
    path = folder / f"cloud.{suffix}"
    if suffix == "npy":
        np.save(path, POINTS.T if form == "columns" else POINTS)
    elif suffix == "mat":
        savemat(path, {"Mdata": POINTS.T if form == "columns" else POINTS, "note": "text"})
    elif suffix in ("xyz", "txt", "csv"):
        np.savetxt(
            path, np.column_stack([POINTS, np.ones(50)]), delimiter="," if suffix == "csv" else " ", header="x y z"
        )
    else:
        path.write_bytes((ply if suffix == "ply" else pcd)(form, POINTS))
    return path


KINDS = ["npy rows", "npy columns", "mat rows", "mat columns", "xyz", "txt", "csv", "ply ascii",
         "ply binary_little_endian", "ply binary_big_endian",
         "pcd ascii", "pcd binary", "pcd binary_compressed"]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_format_gives_the_same_points(tmp_path: Path, kind: str) -> None:
    cloud = read_cloud(store(tmp_path, kind))
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.dropped == 0


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.startswith(("ply", "pcd", "npy rows", "mat rows"))])
def test_a_truncated_file_is_named(tmp_path: Path, kind: str) -> None:
    path = store(tmp_path, kind)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.6)])
    with pytest.raises(InputError, match=path.name):
        read_cloud(path)


def test_written_points_are_read_back_exactly(tmp_path: Path) -> None:
    points = np.random.default_rng(1).normal(size=(7, 3))
    write_ply(points, tmp_path / "a" / "b.ply")
    np.testing.assert_array_equal(read_cloud(tmp_path / "a" / "b.ply").points, points)


def test_points_without_values_are_dropped_and_counted(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[[3, 8], 1] = np.nan
    np.save(tmp_path / "c.npy", points)
    cloud = read_cloud(tmp_path / "c.npy")
    assert cloud.dropped == 2
    np.testing.assert_array_equal(cloud.points, np.delete(POINTS, [3, 8], axis=0))


@pytest.mark.parametrize(("name", "content", "complaint"), [
    ("a.ply", b"plyx", "no PLY file"),
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex one\nend_header\n", "no line of a PLY header"),
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "must have x, y and z"),
    ("a.ply", b"ply\nformat ascii 1.0\nelement face 0\nproperty list uchar int i\nend_header\n", "no vertices"),
    ("a.pcd", b"VERSION 0.7\n", "no DATA line"),
    ("a.pcd", b"FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 1\nDATA ascii\n1 2\n", "must have x, y and z"),
    ("a.pcd", b"FIELDS x y z\nSIZE 4 4\nTYPE F F F\nPOINTS 1\nDATA ascii\n1 2 3\n", "does not describe"),
    ("a.xyz", b"1 2\n3 4\n", "x y z on every line"),
    ("a.xyz", b"1 2 word\n", "x y z on every line"),
    ("a.npy", b"nothing", "cannot be read"),
    ("a.mat", b"nothing", "MATLAB"),
    ("a.obj", b"v 1 2 3", "unknown suffix"),
])  # fmt: skip
def test_files_that_are_no_clouds_are_named(tmp_path: Path, name: str, content: bytes, complaint: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=complaint) as error:
        read_cloud(tmp_path / name)
    assert name in str(error.value)


ROWS = "1 2 3\n4 5 6\n"


@pytest.mark.parametrize(("name", "text"), [
    ("a.xyz", "# a comment\n// another\n\n" + ROWS + "\n"),
    ("a.xyz", "x y z\n" + ROWS),
    ("a.xyz", "id z y x\n7 3 2 1\n8 6 5 4\n"),
    ("a.xyz", "2\n" + ROWS),
    ("a.xyz", "2\na title\n" + ROWS),
    ("a.xyz", ROWS.replace(" ", ",")),
    ("a.xyz", ROWS.replace(" ", ", ")),
    ("a.xyz", ROWS.replace(" ", ";")),
    ("a.xyz", ROWS.replace(" ", "\t")),
    ("a.xyz", ROWS.replace("\n", " 255 0 0\n")),
    ("a.xyz", ROWS.replace("\n", "\r\n")),
    ("a.xyz", "\ufeff" + ROWS),
    ("a.csv", '"x","y","z"\n' + ROWS.replace(" ", ",")),
    ("a.csv", ",x,y,z\n0,1,2,3\n1,4,5,6\n"),
    ("a.csv", ROWS),
    ("a.txt", "X,Y,Z,intensity\n" + ROWS.replace(" ", ",").replace("\n", ",9\n")),
])  # fmt: skip
def test_text_is_read_with_and_without_header(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_bytes(text.encode())
    cloud = read_cloud(tmp_path / name)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    assert cloud.dropped == 0


@pytest.mark.parametrize(("text", "complaint"), [
    ("", "holds no points"),
    ("# nothing\n", "holds no points"),
    ("x y z\n", "no finite point"),
    ("3\n" + ROWS, "announces 3"),
    (ROWS + "7 8\n", r"a\.xyz:3: '7 8' gives no point"),
    (ROWS + "# here\n7 8 word\n", r"a\.xyz:4: '7 8 word' gives no point"),
    ("0,5 1,5 2,5\n0,5 1,5 2,5\n", r"a\.xyz:1: "),
    ("one two 3\n" + ROWS, r"a\.xyz:1: "),
    (ROWS + "\u0661 2 3\n", r"a\.xyz:3: "),
])  # fmt: skip
def test_text_without_points_is_named_with_its_line(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "a.xyz").write_text(text)
    with pytest.raises(InputError, match=complaint):
        read_cloud(tmp_path / "a.xyz")


@pytest.mark.parametrize("kind", ["npy rows", "xyz", "ply ascii", "ply binary_little_endian", "pcd binary_compressed"])
def test_damaged_headers_end_in_one_line(tmp_path: Path, kind: str) -> None:
    path, rng = store(tmp_path, kind), np.random.default_rng(0)
    content = np.frombuffer(path.read_bytes(), np.uint8)
    for _ in range(80):
        damaged = content.copy()
        damaged[rng.integers(0, min(len(damaged), 250), 3)] = rng.integers(0, 256, 3)
        path.write_bytes(damaged.tobytes())
        try:
            assert np.isfinite(read_cloud(path).points).all()
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017


def test_objects_are_never_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read"):
        read_cloud(tmp_path / "a.npy")


@given(st.lists(st.tuples(st.binary(min_size=1, max_size=20), st.integers(1, 300), st.integers(1, 260)), max_size=8))
def test_compressed_bytes_expand(parts: list[tuple[bytes, int, int]]) -> None:
    packed, raw = bytearray(), bytearray()
    for literals, back, length in parts:
        packed += bytes([len(literals) - 1]) + literals
        raw += literals
        distance, length = min(back, len(raw)), max(length, 3)
        head = (distance - 1) >> 8
        packed += bytes([(min(length - 2, 7) << 5) | head])
        packed += bytes([length - 9]) if length >= 9 else b""
        packed += bytes([(distance - 1) & 255])
        for _ in range(length):
            raw.append(raw[-distance])
    expanded = expand_lzf(np.frombuffer(bytes(packed), np.uint8), len(raw))
    assert expanded.tobytes() == bytes(raw)
    if packed:
        assert len(expand_lzf(np.frombuffer(bytes(packed[:-1]), np.uint8), len(raw))) < len(raw)
