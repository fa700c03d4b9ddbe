"""Speed of the floor methods and of the texture map, and the accuracy of the texture, on a simulated drive.

    python benchmarks/floor.py

Writes benchmarks/results/floor.json and the table in docs/benchmarks.md. Times are CPU seconds of one thread with
compiled kernels, the least of some repeats; images are 640 x 480 and every pixel is used.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray
from posegraph_slam.datasets import read
from posegraph_slam.datasets.simulation import KinectSettings, demo_settings, simulate
from posegraph_slam.files import replacing
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.depth_camera import DepthView, cell_coordinates, depth_image
from posegraph_slam.mapping.depth_frames import DepthFrames, each_disparity, usable_frames
from posegraph_slam.mapping.floor_map import FloorLabeller, add_labels, build_floor
from posegraph_slam.mapping.floor_settings import FloorMethod, FloorSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.texture import TextureMap, TextureSettings, build_texture
from posegraph_slam.sensors import RgbdFrames

RESULT = Path(__file__).parent / "results" / "floor.json"
PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"
BEGIN, END = "<!-- floor: begin -->", "<!-- floor: end -->"
METHODS = (FloorMethod.HEIGHT_RANGE, FloorMethod.PLANE, FloorMethod.GROUND)
REPEATS = 5
REPORTED = {FloorMethod.HEIGHT_RANGE: "5–8", FloorMethod.PLANE: "2–3", FloorMethod.GROUND: "–"}
"""Frames a second that the reports give, the first of them for images of fewer pixels."""


def cpu_ms(function: Callable[[], Any], frames: int) -> float:
    """Return the CPU milliseconds a frame of the fastest of some calls; the first one compiles and does not count."""
    function()
    fastest = np.inf
    for _ in range(REPEATS):
        started = time.process_time()
        function()
        fastest = min(fastest, time.process_time() - started)
    return 1e3 * fastest / frames


def label_all(
    labeller: FloorLabeller, work: DepthFrames, images: Iterable[tuple[int, Float32Array]], frames: RgbdFrames,
    geometry: GridGeometry,
) -> None:  # fmt: skip
    """Do with decoded frames what `build_floor` does: depth, labels, votes."""
    votes = np.zeros((*geometry.shape, 2), dtype=np.int64)
    for k, disparity in images:
        depth, view = depth_image(disparity, frames.calibration), DepthView.of(frames.calibration, disparity.shape)
        labels = labeller.labels(depth, view, work.T_map_camera[k], work.number[k])
        cells = cell_coordinates(view, work.T_map_camera[k], geometry.cells_from_map)
        add_labels(labels, depth, cells, farthest_m=labeller.farthest_m,
                   min_pixels=labeller.settings.min_pixels, votes=votes)  # fmt: skip


def speed(frames: RgbdFrames, path: Trajectory, geometry: GridGeometry) -> dict[str, Any]:
    """Measure each method with decoded images and from files, and the texture map from files."""
    work, _ = usable_frames(frames, path, max_gap_s=0.2, colour=False)
    images, count = list(each_disparity(work, [])), len(work)
    rows: dict[str, Any] = {}
    for method in METHODS:
        chosen = FloorSettings(method=method)
        labeller = FloorLabeller(settings=chosen, T_base_camera=frames.T_base_camera)
        kernel = cpu_ms(lambda labeller=labeller: label_all(labeller, work, images, frames, geometry), count)
        whole = cpu_ms(lambda chosen=chosen: build_floor(frames, path, chosen, geometry), count)
        rows[method] = {"decoded_ms": kernel, "from_files_ms": whole}
    pairs = len(usable_frames(frames, path, max_gap_s=0.2, colour=True)[0])
    for name, even in (("texture", True), ("texture, exposure as it is", False)):
        settings = TextureSettings(even_exposure=even)
        whole = cpu_ms(lambda s=settings: build_texture(frames, path, s, geometry=geometry), pairs)
        rows[name] = {"from_files_ms": whole}
    return {"frames": count, "rows": rows}


def true_colours(folder: Path, geometry: GridGeometry) -> FloatArray:
    """Mean colour (R, C, 3) of the floor image of a simulated log in every cell."""
    world = json.loads((folder / "world.json").read_text(encoding="utf-8"))["floor"]
    floor = cv2.imread(str(folder / "floor.png"))[::-1, :, ::-1].astype(np.float64)
    cells = np.stack(np.mgrid[: geometry.shape[0], : geometry.shape[1]], axis=-1)
    centre, total = geometry.cell_to_world(cells), np.zeros((*geometry.shape, 3))
    offset = ((np.arange(10) + 0.5) / 10 - 0.5) * geometry.resolution_m
    for dx in offset:
        for dy in offset:
            place = np.floor((centre + np.array([dx, dy]) - world["origin_m"]) / world["resolution_m"]).astype(np.int64)
            row, column = (np.clip(place[..., k], 0, floor.shape[1 - k] - 1) for k in (1, 0))
            total += floor[row, column]
    return total / 100


def accuracy(texture: TextureMap, truth: FloatArray) -> dict[str, float]:
    """Mean and high quantiles of the mean absolute error of the channels over the observed cells, to 255."""
    error = np.abs(texture.colour - truth).mean(axis=2)[texture.observed]
    low, high = (float(q) for q in np.percentile(error, [50, 98]))
    return {"cells": len(error), "mean": float(error.mean()), "median": low, "p98": high}


def measure() -> dict[str, Any]:
    """Simulate two drives, with steady and with changing exposure, and measure."""
    record: dict[str, Any] = {"accuracy": {}}
    with tempfile.TemporaryDirectory() as temporary:
        for change in (0.0, 0.2):
            folder = Path(temporary) / f"log{change}"
            simulate(demo_settings(kinect=KinectSettings(exposure_change=change)), folder)
            log = read(folder)
            assert log.rgbd is not None
            assert log.truth is not None
            geometry = GridGeometry.around(log.truth.positions[:, :2], resolution_m=0.05, margin_m=4.0)
            truth = true_colours(folder, geometry)
            for even in (True, False):
                texture = build_texture(log.rgbd, log.truth, TextureSettings(even_exposure=even), geometry=geometry)
                name = f"change {change:.0%}, {'evened out' if even else 'as it is'}"
                record["accuracy"][name] = accuracy(texture, truth)
            if not change:
                record["speed"] = speed(log.rgbd, log.truth, geometry)
    return record


def table(record: dict[str, Any]) -> str:
    """Return both tables in Markdown."""
    lines = [
        "| | decoded images: CPU ms a frame | frames/s | from files: CPU ms a frame | frames/s | report: frames/s |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in record["speed"]["rows"].items():
        cells = []
        for key in ("decoded_ms", "from_files_ms"):
            cells += [f"{row[key]:.1f}", f"{1000 / row[key]:.0f}"] if key in row else ["–", "–"]
        lines.append(f"| {name} | {' | '.join(cells)} | {REPORTED.get(name, '–')} |")
    lines += [
        "",
        "| exposure of the colour frames | observed cells | mean error, of 255 | median | 98 % |",
        "|---|---|---|---|---|",
    ]
    for name, row in record["accuracy"].items():
        lines.append(f"| {name} | {row['cells']} | {row['mean']:.2f} | {row['median']:.2f} | {row['p98']:.1f} |")
    return "\n".join(lines)


def main() -> int:
    """Measure, print and write."""
    record = measure()
    text = table(record)
    print(text)
    with replacing(RESULT) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    with replacing(PAGE) as temporary:
        temporary.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
