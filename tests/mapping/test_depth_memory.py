"""Long logs: memory does not grow with the frames, and patches come back from their file as they went in."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from posegraph_slam.datasets.ece276a import T_BASE_CAMERA
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.colour_patches import PATCH, Patches, PatchStore
from posegraph_slam.mapping.depth_frames import Unreadable
from posegraph_slam.mapping.floor_map import build_floor
from posegraph_slam.mapping.floor_settings import FloorMethod, FloorSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.texture import build_texture
from posegraph_slam.sensors import RgbdFrames

GRID = GridGeometry.square(10.0, resolution_m=0.05)


def standing(count: int, folder: Path) -> tuple[RgbdFrames, Trajectory]:
    """A robot that stands before a floor of one colour for `count` frames, all of them the same two files."""
    rows = (526.37 * np.arange(480) + 19276) / 585.051
    dd = 1.03 * np.sin(0.36 + np.arctan((rows - 242.94) / 585.05)) / 0.36  # roughly a floor 0.36 m below
    disparity = np.clip((3.31 - np.maximum(dd, 0.05)) / 0.00304, 1, 2000)
    cv2.imwrite(str(folder / "d.png"), np.tile(disparity[:, None], (1, 640)).astype(np.uint16))
    cv2.imwrite(str(folder / "c.png"), np.full((480, 640, 3), 120, dtype=np.uint8))
    stamps = np.arange(count, dtype=float)
    frames = RgbdFrames(
        disparity_stamps_s=stamps, colour_stamps_s=stamps, disparity_files=(folder / "d.png",) * count,
        colour_files=(folder / "c.png",) * count, T_base_camera=T_BASE_CAMERA,
    )  # fmt: skip
    poses = np.tile(np.eye(4), (count, 1, 1))
    return frames, Trajectory(stamps_s=stamps, poses=poses, parent="map", child="base")


def peak_bytes(function) -> int:
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kind", ["floor", "texture"])
def test_memory_does_not_grow_with_the_frames(kind, tmp_path, monkeypatch):
    for module in ("floor_map", "texture"):
        monkeypatch.setattr(f"posegraph_slam.mapping.{module}.FRAMES_A_PIECE", 4)
    chosen = FloorSettings(method=FloorMethod.GROUND)

    def build(count: int) -> None:
        frames, path = standing(count, tmp_path)
        if kind == "floor":
            assert build_floor(frames, path, chosen, GRID).frames_used == count
        else:
            assert build_texture(frames, path, geometry=GRID).observed.any()

    build(4)
    few, many = (peak_bytes(lambda count=count: build(count)) for count in (8, 48))
    image = 480 * 640 * 7  # depth in 4 bytes, colour in 3
    assert many - few < 40 * image / 10  # a tenth of what keeping the images would take


def test_patches_come_back_as_they_went_in():
    rng = np.random.default_rng(0)
    parts = []
    for size in (5, 0, 17):
        records = np.zeros(size, dtype=PATCH)
        for name in ("frame", "cell"):
            records[name] = rng.integers(0, 1000, size)
        records["colour"], records["weights"] = rng.integers(0, 65281, (size, 3)), rng.integers(0, 2**32, (size, 2))
        records["sound"] = rng.random(size) < 0.5
        parts.append(Patches(records=records, unreadable=Unreadable()))
    with PatchStore() as store:
        assert not list(store)
        for part in parts:
            store.append(part)
        for _ in range(2):
            back = list(store)
            assert [part.records.tobytes() for part in back] == [part.records.tobytes() for part in parts]
