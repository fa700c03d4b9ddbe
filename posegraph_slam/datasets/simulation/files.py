"""Write a simulated run as a folder in the ECE276A layout, with its truth."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import ByteArray
from posegraph_slam.datasets.simulation import camera, robot, streams
from posegraph_slam.datasets.simulation.floor import FloorTexture, build_floor
from posegraph_slam.datasets.simulation.run import SimulatedRun, generator, simulate_run
from posegraph_slam.datasets.simulation.settings import SimulationSettings
from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.files import name_target
from posegraph_slam.sensors import DisparityCalibration

FAST_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)


def simulate(
    settings: SimulationSettings,
    folder: str | Path,
    *,
    overwrite: bool = False,
    progress: Progress = silent_progress,
) -> Path:
    """Simulate a run and write it into `folder` in the ECE276A layout, with `truth{n}.tum`; return the folder.

    Also written: `world.json` (obstacles in the frame of the truth) and, with images, `floor.png` (its texture). All is
    written beside the folder first and moved into place at the end. The same settings give the same bytes. Raises
    `InputError` if `folder` is a file, or holds anything and `overwrite` is not set or it is no simulated log.
    """
    folder = Path(folder).absolute()
    _check_target(folder, overwrite)
    unfinished = folder.with_name(f".{folder.name}.{os.getpid()}")
    try:
        unfinished.mkdir(parents=True)
        run = simulate_run(settings, progress)
        _write_streams(run, unfinished)
        floor = _write_images(run, unfinished, progress) if settings.kinect.images else None
        _write_world(run, floor, unfinished)
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(unfinished, folder)
    except OSError as error:
        name_target(error, unfinished, folder)
        raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return folder


def _check_target(folder: Path, overwrite: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "is a file", "name a new folder")
    if not overwrite and folder.exists() and any(folder.iterdir()):
        raise InputError(folder, "exists and is not empty", "name a new folder or allow to overwrite it")
    if folder.exists() and any(folder.iterdir()) and not (folder / "world.json").is_file():
        raise InputError(folder, "holds other things than a simulated log", "name a new folder; it is not overwritten")


def _write_streams(run: SimulatedRun, folder: Path) -> None:
    """Write the four .npz files and the truth; numpy dates the members of an archive 1980, so bytes are equal."""
    n = run.settings.number
    np.savez(
        folder / f"Encoders{n}.npz",
        counts=np.asfortranarray(run.counts.T.astype(np.int16)),
        time_stamps=run.stamps(run.encoder_times_s),
    )
    np.savez(
        folder / f"Imu{n}.npz",
        angular_velocity=run.angular_velocity.T,
        linear_acceleration=run.acceleration_g.T,
        time_stamps=run.stamps(run.imu_times_s),
    )
    np.savez(
        folder / f"Hokuyo{n}.npz",
        angle_min=np.array(robot.LIDAR_ANGLE_MIN_RAD),
        angle_max=np.array(-robot.LIDAR_ANGLE_MIN_RAD),
        angle_increment=np.array([[streams.lidar_increment(run.settings.lidar)]]),
        range_min=np.array(robot.LIDAR_RANGE_MIN_M),
        range_max=np.array(robot.LIDAR_RANGE_MAX_M),
        ranges=run.ranges_m.T,
        time_stamps=run.stamps(run.lidar_times_s),
    )
    np.savez(
        folder / f"Kinect{n}.npz",
        disparity_time_stamps=run.stamps(run.disparity_times_s),
        rgb_time_stamps=run.stamps(run.colour_times_s),
    )
    write_tum(run.truth(), folder / f"truth{n}.tum")


def _write_images(run: SimulatedRun, folder: Path, progress: Progress) -> FloorTexture:
    """Render and write every disparity and colour frame; return the floor that they show."""
    settings, n, calibration = run.settings.kinect, run.settings.number, DisparityCalibration()
    rng = generator(run.settings, "images")
    floor = build_floor(run.world, run.settings.world, settings.floor_resolution_m, generator(run.settings, "floor"))
    for name in (f"Disparity{n}", f"RGB{n}"):
        (folder / "dataRGBD" / name).mkdir(parents=True)
    total = len(run.disparity_times_s) + len(run.colour_times_s)
    view = camera.disparity_view(calibration)
    for k, xyt in enumerate(run.motion.xyt_at(run.disparity_times_s), start=1):
        depth, _ = camera.render_depth(view, run.world, xyt)
        disparity = camera.disparity_image(depth, calibration, settings, rng)
        _write_png(folder / "dataRGBD" / f"Disparity{n}" / f"disparity{n}_{k}.png", disparity)
        progress("frames", k, total)
    view = camera.colour_view(calibration)
    change = generator(run.settings, "exposure").uniform(-1.0, 1.0, size=len(run.colour_times_s))
    for k, xyt in enumerate(run.motion.xyt_at(run.colour_times_s), start=1):
        colours = camera.render_colour(view, run.world, floor, xyt)
        colours = camera.expose(colours, 1.0 + settings.exposure_change * change[k - 1])
        _write_png(folder / "dataRGBD" / f"RGB{n}" / f"rgb{n}_{k}.png", colours[..., ::-1])
        progress("frames", len(run.disparity_times_s) + k, total)
    return floor


def _write_png(path: Path, image: ByteArray | npt.NDArray[np.uint16]) -> None:
    """Write a grey 16-bit or BGR 8-bit image."""
    if not cv2.imwrite(str(path), np.ascontiguousarray(image), FAST_PNG):
        raise InputError(path, "cannot be written", "check the disk and the permissions")


def _write_world(run: SimulatedRun, floor: FloorTexture | None, folder: Path) -> None:
    """Write `world.json`, and `floor.png` with +y up, as maps are drawn: its last row lies at the origin."""
    content = {
        "frame": "ref: the robot starts at the origin and heads along +x; metres",
        "lower_m": run.world.lower_m.tolist(),
        "upper_m": run.world.upper_m.tolist(),
        "segments_xa_ya_xb_yb": np.round(run.world.segments, 6).tolist(),
        "circles_x_y_radius": np.round(run.world.circles, 6).tolist(),
        "settings": run.settings.model_dump(mode="json"),
    }
    if run.world.terrain is not None:
        terrain = run.world.terrain
        content["ground_xa_xb_ya_yb_z_rise"] = np.round(terrain.patches, 6).tolist()
        content["obstacles_top_m"] = np.round(terrain.spans_m[:, 1], 6).tolist()
        content["ceiling_m"] = terrain.ceiling_m
    if floor is not None:
        content["floor"] = {
            "file": "floor.png",
            "origin_m": floor.origin_m.tolist(),
            "resolution_m": floor.resolution_m,
            "rows": "from high y to low y; the origin is the outer corner of the pixel in the last row, first column",
        }
        _write_png(folder / "floor.png", floor.colours[::-1, :, ::-1])
    (folder / "world.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
