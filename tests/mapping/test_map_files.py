"""Map files: exact archives, nav2 maps read by nav2's own rules, and what unusable files say."""

from __future__ import annotations

import math
import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from posegraph_slam.errors import InputError
from posegraph_slam.mapping.archive import read_occupancy, replace_file, write_occupancy
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.images import read_image, write_png
from posegraph_slam.mapping.nav2 import map_pixels, read_nav2, write_nav2
from posegraph_slam.mapping.occupancy import OccupancyGrid

FULL = 4 * math.log(4)


def grid_of(log_odds, observed=None, *, origin=(-1.25, 3.7), resolution=0.05, yaw=0.0) -> OccupancyGrid:
    log_odds = np.asarray(log_odds, dtype=np.float32)
    geometry = GridGeometry(origin_m=np.array(origin), resolution_m=resolution, shape=log_odds.shape, yaw_rad=yaw)
    return OccupancyGrid(geometry=geometry, log_odds=log_odds, observed=log_odds != 0 if observed is None else observed)


def as_nav2_would(yaml: Path) -> tuple[np.ndarray, dict[str, str]]:
    """Read a trinary map as nav2's map_server does: occupancy 100, 0 or -1 for every cell, row 0 at the bottom."""
    keys = dict(re.findall(r"^(\w+): (.+)$", yaml.read_text(), flags=re.MULTILINE))
    header, size, depth, pixels = (yaml.parent / keys["image"]).read_bytes().split(b"\n", 3)
    assert (header, depth) == (b"P5", b"255")
    width, height = map(int, size.split())
    assert len(pixels) == width * height
    cells = np.full((height, width), -1)
    for y in range(height):
        for x in range(width):
            occupancy = (255 - pixels[width * y + x]) / 255
            if occupancy > float(keys["occupied_thresh"]):
                cells[height - y - 1, x] = 100
            elif occupancy < float(keys["free_thresh"]):
                cells[height - y - 1, x] = 0
    return cells, keys


@given(
    log_odds=hnp.arrays(np.float32, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9),
                        elements=st.sampled_from([-FULL, -math.log(4), -0.3, 0.0, 0.3, math.log(4), FULL])),
)  # fmt: skip
def test_nav2_reads_what_was_mapped(tmp_path_factory, log_odds):
    grid = grid_of(log_odds)
    cells, keys = as_nav2_would(write_nav2(grid, tmp_path_factory.mktemp("map")))
    expected = np.where(log_odds > math.log(0.65 / 0.35), 100, np.where(log_odds < -math.log(0.65 / 0.35), 0, -1))
    assert (cells == expected).all()
    assert keys["origin"] == "[-1.25, 3.7, 0.0]"
    assert keys["mode"] == "trinary"
    assert (float(keys["resolution"]), int(keys["negate"])) == (0.05, 0)
    assert (float(keys["occupied_thresh"]), float(keys["free_thresh"])) == (0.65, 0.196)


def test_one_observation_decides_between_free_and_occupied(tmp_path):
    cells, _ = as_nav2_would(write_nav2(grid_of([[math.log(4), -math.log(4), 0.0]]), tmp_path))
    assert cells.tolist() == [[100, 0, -1]]


@given(
    shape=st.tuples(st.integers(1, 8), st.integers(1, 8)), seed=st.integers(0, 99),
    origin=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), resolution=st.floats(1e-6, 5), yaw=st.floats(-4, 4),
)  # fmt: skip
def test_nav2_map_read_back_is_the_same_map(tmp_path_factory, shape, seed, origin, resolution, yaw):
    log_odds = np.random.default_rng(seed).choice([-FULL, 0.0, FULL], shape)
    grid = grid_of(log_odds, origin=origin, resolution=resolution, yaw=yaw)
    back = read_nav2(write_nav2(grid, tmp_path_factory.mktemp("map"), "floor"))
    assert (back.log_odds == grid.log_odds).all()
    assert (back.observed == grid.observed).all()
    assert (back.geometry.origin_m == grid.geometry.origin_m).all()
    assert (back.geometry.resolution_m, back.geometry.yaw_rad) == (resolution, yaw)


def write_map(folder: Path, pixels, **changes: str | None) -> Path:
    write_png(np.asarray(pixels, dtype=np.uint8), folder / "m.png")
    keys = {"image": "m.png", "resolution": "0.1", "origin": "[1, 2, 0.5]", "negate": "0", "occupied_thresh": "0.65",
            "free_thresh": "0.25"}  # fmt: skip
    keys.update(changes)
    path = folder / "m.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in keys.items() if value is not None))
    return path


def probability(grid: OccupancyGrid) -> list[float | None]:
    return [
        round(float(p), 3) if seen else None for p, seen in zip(grid.probability.flat, grid.observed.flat, strict=True)
    ]


SURE = round(256 / 257, 3)
NOT = round(1 / 257, 3)


def test_modes_of_nav2_maps(tmp_path):
    pixels = [[0, 205, 254, 140]]
    assert probability(read_nav2(write_map(tmp_path, pixels))) == [SURE, NOT, NOT, None]  # 205 is free at 0.25
    assert probability(read_nav2(write_map(tmp_path, pixels, negate="1"))) == [NOT, SURE, SURE, None]
    # Scale: (255 - 140) / 255 = 0.451, half of the way from 0.25 to 0.65.
    assert probability(read_nav2(write_map(tmp_path, pixels, mode="scale"))) == [SURE, NOT, NOT, 0.5]
    raw = read_nav2(write_map(tmp_path, [[0, 100, 30, 101, 255]], mode="raw"))
    assert probability(raw) == [NOT, SURE, 0.3, None, None]


def test_colours_are_averaged_and_transparent_pixels_are_unknown(tmp_path):
    pixels = [[[0, 0, 0, 255], [0, 0, 0, 0], [255, 255, 255, 255], [0, 0, 90, 255]]]
    assert probability(read_nav2(write_map(tmp_path, pixels))) == [SURE, None, NOT, SURE]


def test_yaml_of_other_writers(tmp_path):
    pixels = [[0], [254]]
    path = write_map(tmp_path, pixels)
    path.write_text(
        "# saved by hand\nimage: './m.png'   # beside this file\nmode: \"trinary\"\nresolution: 5e-2\norigin:\n- -1\n"
        "  - 2.5 # y\n  - 1.5707963267948966\nnegate: false\noccupied_thresh: 0.65\nfree_thresh: 0.196\nlicence: none\n"
    )
    grid = read_nav2(path)
    assert grid.geometry.shape == (2, 1)
    assert grid.geometry.resolution_m == 0.05
    assert (grid.geometry.origin_m == [-1, 2.5]).all()
    assert grid.geometry.yaw_rad == math.pi / 2
    assert grid.occupied.tolist() == [[False], [True]]  # the first row of the image is the top


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"image": None}, "'image' is missing"),
        ({"image": "none.png"}, "none.png"),
        ({"resolution": "fine"}, "'resolution' is 'fine'"),
        ({"resolution": "0"}, "positive"),
        ({"resolution": "nan"}, "finite"),
        ({"origin": "[1, 2]"}, "'origin'"),
        ({"origin": "5"}, "'origin'"),
        ({"origin": "[1, 2"}, "line 3: the list is not closed"),
        ({"origin": "[1, 2, inf]"}, "'origin'"),
        ({"negate": "maybe"}, "'negate'"),
        ({"mode": "binary"}, "trinary, scale, raw"),
        ({"occupied_thresh": "0.1"}, "must rise"),
    ],
)
def test_unusable_yaml_names_the_key(tmp_path, changes, problem):
    with pytest.raises(InputError, match=re.escape(problem)):
        read_nav2(write_map(tmp_path, [[0]], **changes))


def test_files_that_are_not_maps_are_named(tmp_path):
    path = tmp_path / "m.yaml"
    for content in (b"\xff\xfe", b"just words\n"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"m\.yaml"):
            read_nav2(path)
    write_map(tmp_path, [[0]])
    (tmp_path / "m.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"m\.png: is not an image"):
        read_nav2(tmp_path / "m.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        read_nav2(tmp_path / "absent.yaml")


def test_archive_is_exact_and_its_bytes_depend_on_the_map_alone(tmp_path):
    rng = np.random.default_rng(5)
    grid = grid_of(rng.normal(size=(40, 30)), rng.random((40, 30)) < 0.5, origin=(0.1 + 0.2, -7e5), yaw=0.3)
    for name in ("a.npz", "b.npz"):
        write_occupancy(grid, tmp_path / name)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    back = read_occupancy(tmp_path / "a.npz")
    assert (back.log_odds == grid.log_odds).all()
    assert (back.observed == grid.observed).all()
    assert (back.geometry.origin_m == grid.geometry.origin_m).all()
    assert back.geometry.yaw_rad == 0.3
    assert back.log_odds.dtype == np.float32
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]  # nothing temporary is left


def test_unusable_archives_are_named(tmp_path):
    path = tmp_path / "map.npz"
    write_occupancy(grid_of(np.ones((50, 50))), path)
    whole = path.read_bytes()
    np.savez(tmp_path / "pickled.npz", log_odds=np.array([{}], dtype=object))
    np.savez(tmp_path / "other.npz", counts=np.zeros(3))
    with np.load(path, allow_pickle=False) as arrays:
        np.savez(tmp_path / "shapes.npz", **{**arrays, "observed": np.ones((50, 49), dtype=bool)})
        np.savez(tmp_path / "version.npz", **{**arrays, "format_version": np.array(99)})
        np.savez(tmp_path / "place.npz", **{**arrays, "origin_m": np.array([0.0, np.inf])})
        np.savez(tmp_path / "text.npz", **{**arrays, "origin_m": np.array(["a", "b"])})
        np.savez(tmp_path / "nan.npz", **{**arrays, "log_odds": np.full((50, 50), np.nan)})
    kinds = ("pickled", "other", "shapes", "version", "place", "text", "nan")
    others = [(tmp_path / f"{name}.npz").read_bytes() for name in kinds]
    for content in (whole[: len(whole) // 2], b"", b"text", *others):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"map\.npz"):
            read_occupancy(path)
    with pytest.raises(InputError, match="no such file"):
        read_occupancy(tmp_path / "absent.npz")


def test_png_for_eyes_shows_the_top_row_first(tmp_path):
    grid = grid_of([[FULL, 0.0], [-FULL, 0.0], [0.0, FULL]])
    write_png(map_pixels(grid), tmp_path / "map.png")
    assert cv2.imread(str(tmp_path / "map.png"), cv2.IMREAD_UNCHANGED).tolist() == [[205, 0], [254, 205], [0, 205]]
    colours = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    for channels in (3, 4):
        write_png(colours[..., :channels], tmp_path / "c.png")
        assert (read_image(tmp_path / "c.png") == colours[..., :channels]).all()
        assert (cv2.imread(str(tmp_path / "c.png"))[..., ::-1] == colours[..., :3]).all() or channels == 4


def test_files_that_cannot_be_written_are_named_and_leave_the_old_ones(tmp_path):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(InputError, match="cannot be written"):
        replace_file(tmp_path / "file" / "below.npz", b"x")
    assert (tmp_path / "file").read_text() == "kept"


def png_of_size(columns: int, rows: int) -> bytes:
    head = b"IHDR" + struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    chunks = [head, b"IDAT" + zlib.compress(b"0"), b"IEND"]
    framed = (struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) for chunk in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"text",
        b"\x89PNG\r\n\x1a\n",
        png_of_size(100_000, 100_000),
        png_of_size(0, 4),
        b"P5\n99999 99999\n255\n",
        b"P5\n-1 4\n255\n",
    ],
)
def test_an_image_that_cannot_be_decoded_is_named(tmp_path, content, capfd):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.png: is not an image that can be decoded"):
        read_image(tmp_path / "a.png")
    assert "OpenCV" not in capfd.readouterr().err


def test_every_damaged_byte_of_a_picture_is_noticed(tmp_path, capfd):
    path = tmp_path / "a.png"
    write_png((np.arange(600).reshape(20, 30) % 251).astype(np.uint8), path)
    whole = path.read_bytes()
    for at in range(8, len(whole), 7):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
        with pytest.raises(InputError, match=r"a\.png: is not an image"):
            read_image(path)
        path.write_bytes(whole[:at])
        with pytest.raises(InputError, match=r"a\.png: is not an image"):
            read_image(path)
    assert capfd.readouterr().err == ""


def test_a_map_of_too_many_cells_is_refused_by_name(tmp_path, monkeypatch):
    yaml = write_nav2(grid_of(np.ones((5, 6))), tmp_path)
    monkeypatch.setattr("posegraph_slam.mapping.grid.MAXIMUM_CELLS", 29)
    with pytest.raises(InputError, match=r"map\.yaml: 5 x 6 cells"):
        read_nav2(yaml)


@pytest.mark.parametrize("resolution", ["1e-320", "1e300", "1.0e-7"])
def test_cells_of_no_sensible_size_are_refused(tmp_path, resolution):
    yaml = write_nav2(grid_of(np.ones((5, 6))), tmp_path)
    yaml.write_text(re.sub(r"resolution: .*", f"resolution: {resolution}", yaml.read_text()))
    with pytest.raises(InputError, match=r"map\.yaml: resolution .* is not between 1e-06 and 1e\+06 m"):
        read_nav2(yaml)
