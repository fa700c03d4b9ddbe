"""The depth frames of a log that can be mapped: their files and the poses of the camera, read one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.execution import split_range
from posegraph_slam.geometry import Trajectory, interpolate
from posegraph_slam.mapping.images import read_image
from posegraph_slam.sensors import RgbdFrames

FRAMES_A_PIECE = 64
"""Frames that a worker takes at a time; results do not depend on it, since whole numbers are summed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthFrames:
    """Some disparity frames: number in the log (n,), file, and pose T_map_camera (n, 4, 4) of the colour camera then.

    Where colours are wanted, `colour` holds the file of the nearest colour frame and `T_map_colour` (n, 4, 4) the
    camera's pose when that was taken.
    """

    number: tuple[int, ...]
    disparity: tuple[Path, ...]
    T_map_camera: FloatArray
    colour: tuple[Path, ...] = ()
    T_map_colour: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.disparity)

    def pieces(self, size: int) -> list[DepthFrames]:
        """Split into consecutive pieces of at most `size` frames."""
        return [self._part(slice(start, stop)) for start, stop in split_range(len(self), size)]

    def _part(self, part: slice) -> DepthFrames:
        return DepthFrames(
            number=self.number[part],
            disparity=self.disparity[part],
            T_map_camera=self.T_map_camera[part],
            colour=self.colour[part],
            T_map_colour=None if self.T_map_colour is None else self.T_map_colour[part],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Unreadable:
    """Files that could not be used as images: how many, and what was wrong with the first one."""

    count: int = 0
    first: str = ""

    def __add__(self, other: Unreadable) -> Unreadable:
        return Unreadable(count=self.count + other.count, first=self.first or other.first)


def usable_frames(
    frames: RgbdFrames, trajectory: Trajectory, *, max_gap_s: float, stride: int = 1, colour: bool
) -> tuple[DepthFrames, int]:
    """Return every `stride`-th disparity frame with a file and a pose near in time, and how many there were to choose.

    The pose is interpolated at the frame's stamp; `max_gap_s` is how far outside the trajectory (T_map_base) it may
    lie. With `colour` the colour frame nearest in time must be as near, and comes with its own pose. Raises InputError
    where no frame is left.
    """
    if not (frames.has_images if colour else any(frames.disparity_files)):
        wanted = "disparity and colour PNGs" if colour else "disparity PNGs"
        raise InputError("RGB-D frames", "no image files", f"the map needs {wanted}")
    chosen = np.arange(0, len(frames.disparity_stamps_s), stride)
    stamps = frames.disparity_stamps_s[chosen]
    near = stamps >= trajectory.stamps_s.min(initial=np.inf) - max_gap_s
    near &= stamps <= trajectory.stamps_s.max(initial=-np.inf) + max_gap_s
    near &= [frames.disparity_files[i] is not None for i in chosen]
    if colour:
        nearest = np.clip(frames.nearest_colour(stamps), 0, len(frames.colour_stamps_s) - 1)
        near &= np.abs(frames.colour_stamps_s[nearest] - stamps) <= max_gap_s
        near &= [frames.colour_files[k] is not None for k in nearest]
    used = np.flatnonzero(near)
    if len(used) == 0:
        wanted = "a colour frame and a pose" if colour else "a file and a pose"
        raise InputError(
            "RGB-D frames",
            f"none of {len(chosen)} disparity frames has {wanted} within {max_gap_s} s",
            "check that the images belong to this log, or raise max_gap_s",
        )
    return DepthFrames(
        number=tuple(chosen[used].tolist()),
        disparity=tuple(path for i in chosen[used] if (path := frames.disparity_files[i])),
        T_map_camera=_camera_poses(frames, trajectory, stamps[used]),
        colour=tuple(path for k in nearest[used] if (path := frames.colour_files[k])) if colour else (),
        T_map_colour=_camera_poses(frames, trajectory, frames.colour_stamps_s[nearest[used]]) if colour else None,
    ), len(chosen)


def _camera_poses(frames: RgbdFrames, trajectory: Trajectory, stamps_s: FloatArray) -> FloatArray:
    """T_map_camera (n, 4, 4) at some stamps, a little outside the trajectory too."""
    return np.ascontiguousarray(interpolate(trajectory, stamps_s).spatial().poses @ frames.T_base_camera)


def read_disparity(path: Path) -> Float32Array:
    """Read a disparity image (H, W) as float32; raises InputError where it has several channels or none."""
    image = read_image(path)
    if image.ndim != 2:
        raise InputError(path, f"is an image of shape {image.shape}, not a disparity image", "it must have one channel")
    return image.astype(np.float32)


def read_colour(path: Path) -> ByteArray:
    """Read a colour image (H, W, 3) RGB; raises InputError where it is grey or not of 8 bits."""
    image = read_image(path)
    if image.ndim != 3 or image.dtype != np.uint8:
        raise InputError(path, f"is an image of shape {image.shape} and type {image.dtype}, not 8-bit colour")
    return np.ascontiguousarray(image[..., :3])


def each_disparity(frames: DepthFrames, unreadable: list[str]) -> Iterator[tuple[int, Float32Array]]:
    """Yield place and disparity (H, W) of each frame; what cannot be read is told in `unreadable`."""
    for k, path in enumerate(frames.disparity):
        try:
            disparity = read_disparity(path)
        except InputError as error:
            unreadable.append(str(error))
            continue
        yield k, disparity


def each_pair(frames: DepthFrames, unreadable: list[str]) -> Iterator[tuple[int, Float32Array, ByteArray]]:
    """Yield place, disparity (H, W) and colour (H', W', 3) of each frame whose two files can be read."""
    for k, disparity in each_disparity(frames, unreadable):
        try:
            colour = read_colour(frames.colour[k])
        except InputError as error:
            unreadable.append(str(error))
            continue
        yield k, disparity, colour


def require_readable(frames: int, unreadable: Unreadable) -> None:
    """Raise InputError with the first problem where not one of `frames` frames could be read."""
    if unreadable.count >= frames:
        raise InputError("RGB-D frames", f"none of {frames} can be read; the first: {unreadable.first}")
