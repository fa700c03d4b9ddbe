"""RGB-D folders in the TUM layout written from the colour and depth images of a log, one image at a time."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np

from posegraph_slam.errors import InputError
from posegraph_slam.files import name_target
from posegraph_slam.sensors import RobotLog
from posegraph_slam.sensors.images import Image, ImageStream

DEPTH_UNITS_PER_M = 1000.0
"""Depth images are written in millimetres, as most cameras give them."""
DEEPEST_M = 65.0


def write_rgbd(log: RobotLog, folder: Path) -> tuple[int, list[str]]:
    """Write rgb/, depth/, their lists and camera.json into `folder`; return how many depth images, and remarks.

    The depth stream is the one whose name says depth (aligned or registered to colour before others), the colour stream
    the one in the same frame, else the longest. Depth is taken as registered to colour, pixel by pixel.
    Raises InputError where a stream or the calibration is missing. The folder appears when it is complete.
    """
    colour, depth = chosen_streams(log)
    camera = depth.calibration or colour.calibration
    if camera is None:
        raise InputError(log.path, f"has no CameraInfo for {depth.name}", "record the camera's calibration with it")
    remarks = [f"colour {colour.name} ({len(colour)} images), depth {depth.name} ({len(depth)} images)"]
    if np.any(camera.distortion):
        remarks.append(f"the lens distortion of {depth.name} ({camera.model}) is not undone")
    if colour.frame != depth.frame:
        remarks.append(f"colour is of frame {colour.frame}, depth of {depth.frame}: taken as registered")
    unfinished = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        for name, stream in (("rgb", colour), ("depth", depth)):
            (unfinished / name).mkdir(parents=True)
            rows = [f"# timestamp filename, from {stream.name}"]
            for stamp, image in zip(stream.stamps_s.tolist(), stream.images(), strict=True):
                file = f"{name}/{stamp:.6f}.png"
                _write_image(image if name == "rgb" else millimetres(image, stream.name), unfinished / file)
                rows.append(f"{stamp:.6f} {file}")
            (unfinished / f"{name}.txt").write_text("\n".join(rows) + "\n", encoding="ascii", errors="replace")
        fx, fy, cx, cy = (float(camera.K[index]) for index in ((0, 0), (1, 1), (0, 2), (1, 2)))
        known = {"width": camera.width, "height": camera.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
        text = json.dumps({**known, "depth_units_per_m": DEPTH_UNITS_PER_M}, indent=1)
        (unfinished / "camera.json").write_text(text + "\n", encoding="utf-8")
        if folder.exists():
            shutil.rmtree(folder)
        unfinished.rename(folder)
    except OSError as error:
        name_target(error, unfinished, folder)
        raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return len(depth), remarks


def chosen_streams(log: RobotLog) -> tuple[ImageStream, ImageStream]:
    """Return the colour and the depth stream of a log; InputError naming the streams where one is missing."""
    depths = [stream for stream in log.images if "depth" in stream.name.lower()]
    colours = [stream for stream in log.images if stream not in depths]
    if not depths or not colours:
        names = ", ".join(stream.name for stream in log.images) or "none"
        raise InputError(log.path, f"has no pair of colour and depth images (its images: {names})", "record both")
    registered = ("aligned", "registered", "to_color", "to_rgb")
    depth = min(depths, key=lambda stream: (not any(word in stream.name for word in registered), -len(stream)))
    return min(colours, key=lambda stream: (stream.frame != depth.frame, -len(stream))), depth


def millimetres(image: Image, name: str) -> Image:
    """Return a depth image (H, W) in millimetres, uint16, 0 where nothing was measured; metres are float32."""
    if image.ndim != 2 or image.dtype not in (np.uint16, np.float32):
        raise InputError(
            name, f"an image of {image.dtype} and shape {image.shape} is no depth", "it must be 16UC1 or 32FC1"
        )
    if image.dtype == np.uint16:
        return image
    known = np.isfinite(image) & (image > 0) & (image < DEEPEST_M)
    return np.where(known, np.rint(np.where(known, image, 0) * DEPTH_UNITS_PER_M), 0).astype(np.uint16)


def _write_image(image: Image, path: Path) -> None:
    pixels = image[..., ::-1] if image.ndim == 3 else image
    if not cv2.imwrite(str(path), np.ascontiguousarray(pixels)):
        raise InputError(path, "cannot be written", "check the disk and the permissions")
