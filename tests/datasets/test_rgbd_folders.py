"""Reading folders of colour and depth images."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from posegraph_slam import datasets
from posegraph_slam.datasets.image_headers import read_image_header
from posegraph_slam.datasets.rgbd import nearest_pairs
from posegraph_slam.datasets.rgbd_camera import read_camera
from posegraph_slam.errors import InputError

Writer = Callable[..., Path]


def image(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


def plain_folder(folder: Path, *, colour: str = "color", suffix: str = ".png", frames: int = 3) -> Path:
    for k in range(frames):
        image(folder / colour / f"{k + 1}{suffix}", np.full((30, 40, 3), 10 * k, np.uint8))
        image(folder / "depth" / f"{k + 1}.pgm", np.full((30, 40), 1000 + k, np.uint16))
    return folder


def tum_folder(folder: Path) -> Path:
    lines: dict[str, list[str]] = {"rgb": ["# colour"], "depth": ["# depth"]}
    for k in range(4):
        for kind, shift in (("rgb", 0.0), ("depth", 0.004 if k else 0.5)):
            stamp = f"{1305031102.175 + 0.033 * k + shift:.6f}"
            pixels = np.zeros((30, 40, 3), np.uint8) if kind == "rgb" else np.full((30, 40), 5000, np.uint16)
            image(folder / kind / f"{stamp}.png", pixels)
            lines[kind].append(f"{stamp} {kind}/{stamp}.png")
    for kind, rows in lines.items():
        (folder / f"{kind}.txt").write_text("\n".join(rows) + "\n")
    return folder


def test_reads_what_the_simulation_writes(tmp_path: Path, rgbd_log: Writer) -> None:
    log = datasets.read(rgbd_log(tmp_path / "log", frames=5))
    sequence = log.rgbd_sequence
    assert sequence is not None
    assert log.truth is not None
    assert len(sequence) == len(log.truth) == 5
    assert (sequence.camera.width, sequence.camera.height) == (40, 30)
    assert sequence.camera.depth_units_per_m == 5000
    assert sequence.camera.fx_px == pytest.approx(0.82 * 40)
    assert log.truth.child == "camera"


@pytest.mark.parametrize("colour", ["rgb", "Color", "image"])
def test_says_which_intrinsics_it_assumes(tmp_path: Path, colour: str) -> None:
    log = datasets.read(plain_folder(tmp_path / "log", colour=colour, suffix=".jpg"))
    sequence = log.rgbd_sequence
    assert sequence is not None
    camera = sequence.camera
    # the same rays reach the corners of a smaller image
    assert camera.fx_px == pytest.approx(525 * 40 / 640)
    assert (camera.cx_px + 0.5) / 40 == pytest.approx((319.5 + 0.5) / 640)
    assert camera.depth_units_per_m == 1000
    assert any("no intrinsics" in remark and "32.8" in remark for remark in log.remarks)
    np.testing.assert_allclose(sequence.stamps_s, np.arange(3) / 30)
    assert not sequence.depth_lag_s.any()


def test_pairs_the_lists_of_the_tum_benchmark_by_time(tmp_path: Path) -> None:
    log = datasets.read(tum_folder(tmp_path / "rgbd_dataset_freiburg1_desk"))
    sequence = log.rgbd_sequence
    assert sequence is not None
    # the first colour frame has no depth frame within 20 ms
    assert [file.name for file in sequence.colour_files] == [
        f"{1305031102.175 + 0.033 * k:.6f}.png" for k in (1, 2, 3)
    ]  # fmt: skip
    assert all(abs(float(d.stem) - s) < 0.005 for d, s in zip(sequence.depth_files, sequence.stamps_s, strict=True))
    np.testing.assert_allclose(sequence.depth_lag_s, 0.004, atol=1e-6)
    assert sequence.camera.depth_units_per_m == 5000
    assert sequence.camera.fx_px == pytest.approx(517.3 / 16)
    assert any("1 of 4 colour frames" in remark for remark in log.remarks)


@pytest.mark.parametrize("gap_s", [0.02, 0.05])
def test_pairs_as_many_frames_as_trying_all_pairs_does(gap_s: float) -> None:
    rng = np.random.default_rng(4)
    a = np.arange(60) / 30 + rng.uniform(0, 0.01, 60)
    b = np.delete(np.arange(60) / 30 + 0.014 + rng.uniform(0, 0.01, 60), [7, 8, 30])
    rng.shuffle(b)
    # the rule of the benchmark's tool, written down plainly
    every = sorted((abs(s - t), i, j) for i, s in enumerate(a) for j, t in enumerate(b) if abs(s - t) <= gap_s)
    expected = dict[int, int]()
    for _, i, j in every:
        if i not in expected and j not in expected.values():
            expected[i] = j
    np.testing.assert_array_equal(nearest_pairs(a, b, gap_s), sorted(expected.items()))
    assert len(nearest_pairs(a, b, 1e-6)) == 0


def test_a_list_of_pairs_goes_before_two_lists(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "log")
    rgb, depth = sorted((folder / "rgb").iterdir()), sorted((folder / "depth").iterdir())
    chosen = [(3, 0), (2, 1)]
    for depth_first in (False, True):
        lines = []
        for c, d in chosen:
            words = [f"{rgb[c].stem} rgb/{rgb[c].name}", f"{depth[d].stem} depth/{depth[d].name}"]
            lines.append(" ".join(reversed(words) if depth_first else words))
        (folder / "associations.txt").write_text("# pairs\n" + "\n".join(lines) + "\n")
        sequence = datasets.read(folder).rgbd_sequence
        assert sequence is not None
        assert sequence.colour_files == (rgb[3], rgb[2])
        assert sequence.depth_files == (depth[0], depth[1])
        assert sequence.camera.depth_units_per_m == 5000
        np.testing.assert_allclose(sequence.stamps_s, [float(rgb[3].stem), float(rgb[2].stem)], atol=1e-9)
    (folder / "rgb.txt").unlink()
    assert datasets.read(folder).rgbd_sequence is not None
    (folder / "associations.txt").write_text("1.0 rgb/none.png 1.0 depth/none.png\n")
    with pytest.raises(InputError, match=r"associations.txt:1.*missing"):
        datasets.read(folder)
    (folder / "associations.txt").write_text("1.0 rgb/none.png\n")
    with pytest.raises(InputError, match="two pairs of a stamp and a file"):
        datasets.read(folder)


def test_takes_poses_without_stamps_as_truth(tmp_path: Path) -> None:
    folder = plain_folder(tmp_path / "log")
    (folder / "pose.txt").write_text("0 0 0 0 0 0 1\n1 0 0 0 0 0 1\n2 0 0 0 0 0.70710678 0.70710678\n")
    truth = datasets.read(folder).truth
    assert truth is not None
    np.testing.assert_allclose(truth.positions[:, 0], [0, 1, 2])
    np.testing.assert_allclose(truth.poses[2, :3, 0], [0, 1, 0], atol=1e-7)
    (folder / "pose.txt").write_text("0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="1 poses for 3 frames"):
        datasets.read(folder)


OPEN3D = {"width": 40, "height": 30, "intrinsic_matrix": [50, 0, 0, 0, 51, 0, 19.5, 14.5, 1]}
ROS = """
image_width: 40
image_height: 30
camera_name: kinect
camera_matrix:
  rows: 3
  cols: 3
  data: [50.0, 0, 19.5,
         0, 51., 14.5, 0, 0, 1]
distortion_coefficients:
  rows: 1
  cols: 5
  data: [%s, 0, 0, 0, 0]
"""


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera.json", json.dumps(OPEN3D)),
        ("intrinsic.json", json.dumps({"intrinsic_matrix": [[50, 0, 19.5], [0, 51, 14.5], [0, 0, 1]]})),
        ("camera.json", json.dumps({"camera": {"fx": 50, "fy": 51, "cx": 19.5, "cy": 14.5}, "depth_scale": 2000})),
        ("camera.yaml", ROS % "0"),
        ("camera.yml", "Camera.fx: 50\nCamera.fy: 51.0\nCamera.cx: 19.5 # column\nCamera.cy: 14.5\n"),
    ],
)
def test_finds_intrinsics_in_the_folder(tmp_path: Path, name: str, text: str) -> None:
    folder = plain_folder(tmp_path / "log")
    (folder / name).write_text(text)
    log = datasets.read(folder)
    assert log.rgbd_sequence is not None
    np.testing.assert_allclose(log.rgbd_sequence.camera.vector(), [50, 51, 19.5, 14.5])
    assert log.rgbd_sequence.camera.depth_units_per_m == (2000 if "depth_scale" in text else 1000)
    assert any(name in remark for remark in log.remarks)


def test_says_that_distortion_stays(tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text(ROS % "0.1")
    _, remarks = read_camera(file, 40, 30, 1000)
    assert "distortion" in remarks[0]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('{"fx": 50, "fy": 51, "cx": 1}', "cy"),
        ('{"fx": "50", "fy": 51, "cx": 1, "cy": 2}', "'fx' is not a number"),
        ('{"fx": 50, "fy": 51, "cx": 1, "cy": 2, "width": 640, "height": 480}', "640 x 480"),
        ('{"intrinsic_matrix": [1, 2]}', "9 numbers"),
        ('{"fx": 50,', "camera.json:1: is not valid JSON"),
        ('{"fx": Infinity}', "'fx' is inf"),
        ('{"width": 1e999}', "'width' is inf"),
        ('{"fx": ' + "9" * 5000 + "}", "is not valid JSON"),
        ("[" * 200_000, "is not valid JSON"),
        ('{"fx": -1, "fy": 1, "cx": 0, "cy": 0}', r"camera\.json: fx -1, fy 1 and depth unit .* are not all positive"),
        ('{"fx": -50, "fy": 51, "cx": 1, "cy": 2}', "not all positive"),
    ],
)
def test_wrong_intrinsics_are_named(tmp_path: Path, text: str, problem: str) -> None:
    folder = plain_folder(tmp_path / "log")
    (folder / "camera.json").write_text(text)
    with pytest.raises(InputError, match=problem):
        datasets.read(folder)


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def replace(name: str, pixels: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: image(folder / name, pixels) and None


@pytest.mark.parametrize(
    ("spoil", "where", "problem"),
    [
        (remove("depth/2.pgm"), "2.png", "no depth frame of the same number .3 colour and 2 depth"),
        (remove("color/3.png"), "3.pgm", "no colour frame of the same number"),
        (replace("depth/2.pgm", np.ones((30, 40), np.uint8)), "2.pgm", "8-bit grey, not 16-bit grey"),
        (replace("depth/3.pgm", np.ones((20, 40), np.uint16)), "3.pgm", "40 x 20, but the colour images are 40 x 30"),
        (replace("color/3.png", np.ones((20, 40, 3), np.uint8)), "3.png", "40 x 20"),
        (replace("color/2.png", np.ones((30, 40, 3), np.uint16)), "2.png", "16-bit colour"),
        (lambda folder: (folder / "color/1.png").write_bytes(b"no image"), "1.png", "not a PNG"),
        (lambda folder: (folder / "depth/2.pgm").write_bytes(b"P5\n40 30\n65535\n12"), "2.pgm", "truncated"),
    ],
)
def test_wrong_images_are_named(tmp_path: Path, spoil: Callable[[Path], None], where: str, problem: str) -> None:
    folder = plain_folder(tmp_path / "log")
    spoil(folder)
    with pytest.raises(InputError, match=problem) as caught:
        datasets.read(folder)
    assert where in caught.value.where
    assert "\n" not in str(caught.value)


def test_a_file_that_a_list_names_must_exist(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "log")
    next(iter((folder / "depth").iterdir())).unlink()
    with pytest.raises(InputError, match="missing"):
        datasets.read(folder)


@pytest.mark.parametrize(
    ("suffix", "shape"), [(".png", (7, 9)), (".pgm", (7, 9)), (".jpg", (7, 9, 3)), (".ppm", (7, 9, 3))]
)
def test_headers_tell_size_and_kind(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    header = read_image_header(image(tmp_path / f"a{suffix}", np.ones(shape, np.uint8)))
    assert (header.height, header.width, header.bits) == (7, 9, 8)
    assert header.channels == (3 if len(shape) == 3 else 1)


@pytest.mark.parametrize(("row", "problem"), [("0 0 nan 0 0 0 1", "not finite"), ("0 0 0 0 0 0 0", "zero quaternion")])
def test_true_poses_without_stamps_are_checked(tmp_path: Path, row: str, problem: str) -> None:
    folder = plain_folder(tmp_path / "log")
    (folder / "pose.txt").write_text(f"0 0 0 0 0 0 1\n{row}\n0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=rf"pose\.txt:2: holds a .*{problem}"):
        datasets.read(folder)
