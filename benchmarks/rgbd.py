"""RGB-D odometry and loop closure: accuracy, drift and speed, beside Open3D's RGB-D odometry where it is installed.

    PSG_DATA=folder python benchmarks/rgbd.py

Writes benchmarks/results/rgbd.json and the table in docs/benchmarks.md. Open3D's hybrid odometry (Park et al. 2017)
goes from frame to frame with its defaults and starts from rest, as its own reconstruction system uses it; where it is
not installed its rows are left out. Speed is of one core: CPU seconds of reading, preparing and aligning frames.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets import read
from posegraph_slam.datasets.simulation.rgbd_room import furnished_room, loop_through_room, small_camera, write_rgbd_log
from posegraph_slam.files import replacing
from posegraph_slam.geometry import SE3
from posegraph_slam.odometry.rgbd_odometry import track_rgbd
from posegraph_slam.pipeline.configuration import Configuration, load_configuration
from posegraph_slam.pipeline.optimize_rgbd import optimize_rgbd
from posegraph_slam.pipeline.rgbd_frames import FrameImages, PreparedFrames, chosen_camera
from posegraph_slam.registration.rgbd_alignment import align_frames
from posegraph_slam.registration.rgbd_frame import prepare_reference
from posegraph_slam.sensors import RgbdSequence, RobotLog

RESULT = Path(__file__).parent / "results" / "rgbd.json"
PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"
BEGIN, END = "<!-- rgbd: begin -->", "<!-- rgbd: end -->"
FIVE_FRAMES = {"fx_px": 518.0, "fy_px": 519.0, "cx_px": 325.5, "cy_px": 253.5}
ROOM_FRAMES, ROOM_TURNS = 120, 1.1
BEND = 0.003
"""Error of inverse depth (1/m) at the borders of a bent depth image: one unit of disparity."""
TRUSTED = {"inverse_depth_sigma": 0.0}
"""What the rows "depth trusted" set for all alignments."""
SPEED_FRAMES = 40
"""Frames on which the speed of odometry is measured."""


def open3d_module() -> Any:
    """Import Open3D, or say why its rows are left out."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        print(f"Open3D's rows are left out: {error} (pip install open3d-cpu, apt-get install libusb-1.0-0)")
        return None
    return open3d


def open3d_path(o3d: Any, sequence: RgbdSequence) -> FloatArray:
    """Chain Open3D's hybrid odometry from frame to frame; poses (N, 4, 4) in the first frame."""
    c = sequence.camera
    intrinsic = o3d.camera.PinholeCameraIntrinsic(c.width, c.height, c.fx_px, c.fy_px, c.cx_px, c.cy_px)
    option = o3d.pipelines.odometry.OdometryOption()
    option.depth_max = 10.0
    jacobian, images = o3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm(), FrameImages(sequence=sequence)

    def image(k: int) -> Any:
        colour, depth = images(k)  # Open3D itself reads no PGM
        return o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(colour), o3d.geometry.Image(np.array(depth)),
            depth_scale=c.depth_units_per_m, depth_trunc=10.0, convert_rgb_to_intensity=True,
        )  # fmt: skip

    poses, target = [np.eye(4)], image(0)
    for k in range(1, len(sequence)):
        source = image(k)
        found, T, _ = o3d.pipelines.odometry.compute_rgbd_odometry(
            source, target, intrinsic, np.eye(4), jacobian, option
        )
        poses.append(poses[-1] @ (np.asarray(T) if found else np.eye(4)))
        target = source
    return np.stack(poses)


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """Return what a function returns, and the CPU seconds that it took."""
    started = time.process_time()
    return function(), time.process_time() - started


def against_truth(poses: FloatArray, truth: FloatArray) -> dict[str, float]:
    """Largest deviation from the truth relative to the first frame, and of the steps from frame to frame."""
    E = SE3.inverse(SE3.between(truth[:1], truth)) @ SE3.between(poses[:1], poses)
    S = SE3.inverse(SE3.between(truth[:-1], truth[1:])) @ SE3.between(poses[:-1], poses[1:])
    from_first, steps = SE3.log(E), SE3.log(S)
    return {
        "from_first_max_m": float(np.linalg.norm(E[:, :3, 3], axis=1).max()),
        "from_first_max_deg": float(np.rad2deg(np.linalg.norm(from_first[:, :3], axis=1).max())),
        "step_max_m": float(np.linalg.norm(S[:, :3, 3], axis=1).max()),
        "step_max_deg": float(np.rad2deg(np.linalg.norm(steps[:, :3], axis=1).max())),
    }


def first_to_last(frames: PreparedFrames, poses: FloatArray, guess: FloatArray) -> dict[str, float]:
    """What a path misses of the direct alignment of the last frame to the first, begun at `guess`; empty if none."""
    last = len(poses) - 1
    settings = Configuration().rgbd.loops.alignment
    found = align_frames(prepare_reference(frames(0)), prepare_reference(frames(last)), guess, settings)
    if not found.usable:
        return {}
    gap = SE3.local(SE3.between(poses[0], poses[last]), found.T_target_source)
    return {
        "first_to_last_m": float(np.linalg.norm(gap[3:])),
        "first_to_last_deg": float(np.rad2deg(np.linalg.norm(gap[:3]))),
    }


def trusting(configuration: Configuration) -> Configuration:
    """Return the configuration with depth trusted in every alignment: its smooth error is not estimated."""
    rgbd = configuration.rgbd
    odometry = rgbd.odometry.model_copy(update={"alignment": rgbd.odometry.alignment.model_copy(update=TRUSTED)})
    loops = rgbd.loops.model_copy(update={"alignment": rgbd.loops.alignment.model_copy(update=TRUSTED)})
    return configuration.model_copy(update={"rgbd": rgbd.model_copy(update={"odometry": odometry, "loops": loops})})


def measure(log: RobotLog, configuration: Configuration, o3d: Any) -> dict[str, Any]:
    """Measure odometry, loop closure and Open3D on one log."""
    assert log.rgbd_sequence is not None
    settings = configuration.rgbd
    camera, _ = chosen_camera(log.rgbd_sequence.camera, settings.camera)
    given = log.rgbd_sequence
    sequence = RgbdSequence(
        stamps_s=given.stamps_s, colour_files=given.colour_files, depth_files=given.depth_files, camera=camera
    )
    frames = PreparedFrames(images=FrameImages(sequence=sequence), max_depth_m=settings.max_depth_m)
    track_rgbd(frames, sequence.stamps_s[:3], settings.odometry)  # compile before the clock runs
    stamps = sequence.stamps_s[:SPEED_FRAMES]
    _, seconds = timed(lambda: track_rgbd(frames, stamps, settings.odometry))
    result = optimize_rgbd(log, configuration)
    optimised = result.trajectory.poses
    paths = {"odometry": result.stages["odometry"].poses, "optimised": optimised}
    paths["optimised, depth trusted"] = optimize_rgbd(log, trusting(configuration)).trajectory.poses
    rates = {"odometry": len(stamps) / seconds}
    if o3d is not None:
        paths["Open3D odometry"], seconds = timed(lambda: open3d_path(o3d, sequence))
        rates["Open3D odometry"] = len(sequence) / seconds
    guess = SE3.between(optimised[0], optimised[-1])
    rows = {}
    for name, poses in paths.items():
        row: dict[str, Any] = {"frames_per_cpu_s": rates.get(name)}
        row |= against_truth(poses, log.truth.poses) if log.truth is not None else {}
        rows[name] = row | (first_to_last(frames, poses, guess) if log.truth is None else {})
    return {
        "frames": len(sequence),
        "keyframes": len(result.keyframes),
        "loops_accepted": result.metrics["loops_accepted"],
        "thickness_m": result.metrics["images"].get("thickness of surfaces, median"),
        "methods": rows,
    }


def table(results: dict[str, Any]) -> str:
    """Return the Markdown table of all logs."""
    lines = [
        "| log | method | from first frame, max | a step, max | first to last frame | frames/CPU s |",
        "|---|---|---|---|---|---|",
    ]

    def pair(row: dict[str, Any], name: str) -> str:
        if f"{name}_m" not in row:
            return "–"
        return f"{1000 * row[f'{name}_m']:.1f} mm, {row[f'{name}_deg']:.3f}°"

    for log, result in results.items():
        for method, row in result["methods"].items():
            rate = row["frames_per_cpu_s"]
            lines.append(
                f"| {log} ({result['frames']} frames) | {method} | {pair(row, 'from_first_max')} | "
                f"{pair(row, 'step_max')} | {pair(row, 'first_to_last')} | {f'{rate:.0f}' if rate else '–'} |"
            )
    return "\n".join(lines)


def save(results: dict[str, Any]) -> None:
    """Write the results so far, and their table into the page."""
    text = table(results)
    with replacing(RESULT) as part:
        part.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8")
    if BEGIN in page and END in page:
        before, after = page.split(BEGIN)[0], page.split(END)[1]
        PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


def main() -> int:
    """Measure all logs that are there; write the results and the table."""
    o3d, results = open3d_module(), {}
    base = ["maps=false", "workers=1"]
    for name, bend in (("simulated room", 0.0), ("simulated room, bent depth", BEND)):
        with tempfile.TemporaryDirectory() as temporary:
            room = Path(temporary) / "room"
            poses = loop_through_room(ROOM_FRAMES, turns=ROOM_TURNS)
            write_rgbd_log(room, furnished_room(seed=3), small_camera(320, 240), poses, bend=bend)
            results[name] = measure(read(room), load_configuration([], base), o3d)
        save(results)
    data = Path(os.environ["PSG_DATA"]) / "rgbd" if os.environ.get("PSG_DATA") else None
    if data is None:
        print("the real logs are left out: set PSG_DATA to their folder")
    else:
        results["living_room"] = measure(read(data / "living_room"), load_configuration([], base), o3d)
        save(results)
        camera = [f"rgbd.camera.{name}={value}" for name, value in FIVE_FRAMES.items()]
        results["five_frames"] = measure(read(data / "five_frames"), load_configuration([], [*base, *camera]), o3d)
    save(results)
    print(table(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
