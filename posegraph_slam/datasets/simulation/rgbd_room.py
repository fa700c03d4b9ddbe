"""A furnished room seen by a moving RGB-D camera: boxes with painted sides, cast ray by ray, with known poses."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from posegraph_slam.arrays import ByteArray, FloatArray, read_only
from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory
from posegraph_slam.jit import kernel
from posegraph_slam.sensors import PinholeCamera

TEXELS_A_M = 40
"""Painted squares a metre on the finest of three scales."""
DEPTH_UNITS_PER_M = 5000.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdRoom:
    """Boxes (n, 6) [least x, y, z, largest x, y, z] in metres, z up; the first is the room itself, seen from inside."""

    boxes: FloatArray
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "boxes", read_only(self.boxes))


def furnished_room(
    size_m: tuple[float, float, float] = (6.0, 5.0, 2.6), *, pieces: int = 12, seed: int = 0
) -> RgbdRoom:
    """Return a room with furniture along its walls; the middle stays free."""
    rng = np.random.default_rng(seed)
    boxes = [np.array([0.0, 0.0, 0.0, *size_m])]
    for k in range(pieces):
        width, depth, height = rng.uniform(0.4, 1.2), rng.uniform(0.25, 0.7), rng.uniform(0.3, 1.9)
        side, along = k % 4, rng.uniform(0.1, 0.9)
        length = size_m[0] if side % 2 == 0 else size_m[1]
        a = np.clip(along * length - width / 2, 0.0, length - width)
        low_high = {
            0: (a, 0.0, a + width, depth),
            1: (size_m[0] - depth, a, size_m[0], a + width),
            2: (a, size_m[1] - depth, a + width, size_m[1]),
            3: (0.0, a, depth, a + width),
        }[side]
        boxes.append(np.array([low_high[0], low_high[1], 0.0, low_high[2], low_high[3], height]))
    return RgbdRoom(boxes=np.stack(boxes), seed=seed)


def loop_through_room(frames: int, *, size_m: tuple[float, float] = (6.0, 5.0), turns: float = 1.0) -> FloatArray:
    """Return poses T_world_camera (N, 4, 4): round the middle of the room, looking outwards, nodding a little.

    The camera's frame is optical: x to the right, y down, z ahead.
    """
    angle = 2 * np.pi * turns * np.arange(frames) / max(frames - 1, 1)
    middle = np.array([size_m[0] / 2, size_m[1] / 2])
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = middle[0] + 0.8 * np.cos(angle)
    poses[:, 1, 3] = middle[1] + 0.6 * np.sin(angle)
    poses[:, 2, 3] = 1.2 + 0.1 * np.sin(2 * angle)
    pitch = -0.15 + 0.1 * np.sin(3 * angle)
    ahead = np.stack([np.cos(pitch) * np.cos(angle), np.cos(pitch) * np.sin(angle), np.sin(pitch)], axis=1)
    right = np.stack([np.sin(angle), -np.cos(angle), np.zeros_like(angle)], axis=1)
    poses[:, :3, 0], poses[:, :3, 2] = right, ahead
    poses[:, :3, 1] = np.cross(ahead, right)
    return poses


def small_camera(width: int = 160, height: int = 120, *, focal: float = 0.82) -> PinholeCamera:
    """Return a camera with a focal length of `focal` image widths."""
    return PinholeCamera(
        width=width, height=height, fx_px=focal * width, fy_px=focal * width, cx_px=(width - 1) / 2,
        cy_px=(height - 1) / 2, depth_units_per_m=DEPTH_UNITS_PER_M,
    )  # fmt: skip


def render_rgbd(room: RgbdRoom, camera: PinholeCamera, T_world_camera: FloatArray) -> tuple[ByteArray, FloatArray]:
    """Render the RGB image (h, w, 3) and the depth (h, w) in metres along the optical axis."""
    colour = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    depth = np.zeros((camera.height, camera.width))
    cast_boxes(room.boxes, camera.vector(), np.asarray(T_world_camera), room.seed, colour, depth)
    return colour, depth


def noisy_depth(depth_m: FloatArray, units_per_m: float, rng: np.random.Generator, *, noise: float = 1.0) -> np.ndarray:
    """Turn depth (h, w) into 16-bit units with `noise` times the deviation of a structured-light sensor.

    The error is that of Nguyen et al. 2012 (eq. 5), in patches of 2 x 2 pixels; depths beyond 8 m are 0.
    """
    height, width = depth_m.shape
    coarse = rng.standard_normal(((height + 1) // 2, (width + 1) // 2))
    error = np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)[:height, :width]
    measured = depth_m + noise * (0.0012 + 0.0019 * (depth_m - 0.4) ** 2) * error
    units = np.where((depth_m > 0.3) & (depth_m < 8.0), np.rint(measured * units_per_m), 0)
    return np.asarray(np.clip(units, 0, 65535), dtype=np.uint16)


def bent_depth(depth_m: FloatArray, bend: float) -> FloatArray:
    """Let inverse depth (h, w) err by -`bend` (1/m) at the left border to `bend` at the right one, as calibration may.

    A unit of disparity of a structured-light sensor, an eighth of a pixel, is 0.003 / m.
    """
    error = bend * np.linspace(-1, 1, depth_m.shape[1])
    return np.asarray(np.where(depth_m > 0, 1 / (1 / np.maximum(depth_m, 0.1) + error), 0.0))


def write_rgbd_log(
    folder: Path,
    room: RgbdRoom,
    camera: PinholeCamera,
    poses: FloatArray,
    *,
    noise: float = 1.0,
    colour_noise: float = 2.0,
    bend: float = 0.0,
    rate_hz: float = 30.0,
) -> Path:
    """Write the frames seen from poses T_world_camera (N, 4, 4): color/, depth/, camera.json and groundtruth.txt.

    `noise` scales that of `noisy_depth`, `bend` is that of `bent_depth`, `colour_noise` a deviation of 255.
    """
    rng = np.random.default_rng(room.seed + 1)
    for k, T in enumerate(poses):
        colour, depth = render_rgbd(room, camera, T)
        grainy = np.rint(colour + colour_noise * rng.standard_normal(colour.shape))
        units = noisy_depth(bent_depth(depth, bend), camera.depth_units_per_m, rng, noise=noise)
        _write_png(np.asarray(np.clip(grainy, 0, 255), dtype=np.uint8)[..., ::-1], folder / "color" / f"{k:05d}.png")
        _write_png(units, folder / "depth" / f"{k:05d}.png")
    intrinsics = {
        "width": camera.width, "height": camera.height, "fx": camera.fx_px, "fy": camera.fy_px, "cx": camera.cx_px,
        "cy": camera.cy_px, "depth_units_per_m": camera.depth_units_per_m,
    }  # fmt: skip
    (folder / "camera.json").write_text(json.dumps(intrinsics, indent=2) + "\n", encoding="utf-8")
    stamps = np.arange(len(poses)) / rate_hz
    write_tum(Trajectory(stamps_s=stamps, poses=poses, parent="ref", child="camera"), folder / "groundtruth.txt")
    return folder


def _write_png(image: np.ndarray, path: Path) -> None:
    """Write grey or BGR pixels, quickly rather than small."""
    path.parent.mkdir(parents=True, exist_ok=True)
    written, content = cv2.imencode(".png", np.ascontiguousarray(image), (cv2.IMWRITE_PNG_COMPRESSION, 1))
    if not written:
        raise InputError(path, f"pixels {image.shape} cannot be encoded as PNG")
    path.write_bytes(content.tobytes())


@kernel
def cell_value(i: int, j: int, face: int, seed: int) -> float:
    """Pseudo-random number in [0, 1) of a painted cell (a hash, the same on every machine)."""
    h = (i * 73856093) ^ (j * 19349663) ^ (face * 83492791) ^ (seed * 2654435761)
    h = (h ^ (h >> 13)) * 1274126177
    h = h ^ (h >> 16)
    return (h & 0xFFFF) / 65536.0


@kernel
def paint(s: float, t: float, face: int, channel: int, seed: int) -> float:
    """Colour of a face at s, t metres: three scales of painted squares, smooth between cells."""
    value = 0.0
    for octave in range(3):
        scale = TEXELS_A_M / 4.0**octave
        x, y = s * scale, t * scale
        i, j = int(np.floor(x)), int(np.floor(y))
        a, b = x - i, y - j
        a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
        key = face * 16 + octave * 4 + (channel if octave == 2 else 0)
        low = (1 - a) * cell_value(i, j, key, seed) + a * cell_value(i + 1, j, key, seed)
        high = (1 - a) * cell_value(i, j + 1, key, seed) + a * cell_value(i + 1, j + 1, key, seed)
        value += ((1 - b) * low + b * high) * (0.25 if octave == 0 else 0.375)
    return value


@kernel
def cast_boxes(
    boxes: FloatArray, camera: FloatArray, T: FloatArray, seed: int, colour: ByteArray, depth: FloatArray
) -> None:
    """Fill colour (h, w, 3) and depth (h, w) with the nearest face that the ray through every pixel meets."""
    height, width = depth.shape
    direction, origin = np.zeros(3), T[:3, 3]
    for i in range(height):
        for j in range(width):
            x, y = (j - camera[2]) / camera[0], (i - camera[3]) / camera[1]
            for r in range(3):
                direction[r] = T[r, 0] * x + T[r, 1] * y + T[r, 2]
            nearest, face = np.inf, -1
            for k in range(len(boxes)):
                enter, leave, enter_axis, leave_axis = -np.inf, np.inf, 0, 0
                for r in range(3):
                    d = direction[r] if abs(direction[r]) > 1e-12 else 1e-12
                    first, second = (boxes[k, r] - origin[r]) / d, (boxes[k, 3 + r] - origin[r]) / d
                    if first > second:
                        first, second = second, first
                    if first > enter:
                        enter, enter_axis = first, r
                    if second < leave:
                        leave, leave_axis = second, r
                if enter > leave or leave <= 0:
                    continue
                distance, axis = (leave, leave_axis) if k == 0 else (enter, enter_axis)
                if 0.0 < distance < nearest:
                    nearest, face = distance, k * 6 + axis * 2 + (1 if direction[axis] > 0 else 0)
            if face < 0:
                continue
            depth[i, j] = nearest
            axis = (face % 6) // 2
            s = origin[(axis + 1) % 3] + nearest * direction[(axis + 1) % 3]
            t = origin[(axis + 2) % 3] + nearest * direction[(axis + 2) % 3]
            for channel in range(3):
                colour[i, j, channel] = np.uint8(30 + 200 * paint(s, t, face, channel, seed))
