"""The texture map: the floor's colours, averaged over the frames of an RGB-D camera along a trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator

from posegraph_slam.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress, split_range
from posegraph_slam.geometry import Trajectory, interpolate
from posegraph_slam.mapping.depth_camera import Calibration, FloorLimits, add_floor
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.images import read_image
from posegraph_slam.sensors import RgbdFrames
from posegraph_slam.settings import Settings

FRAMES_A_PIECE = 64
"""Frames that a worker takes at a time; the result does not depend on it, since whole numbers are summed."""


class TextureSettings(Settings):
    """How RGB-D frames become a texture map (course report, sections III.A.4 and III.E)."""

    resolution_m: float = Field(0.05, gt=0, le=10)
    """Side of a cell, where the map does not share the occupancy map's cells."""
    floor_height_m: float = Field(0.15, ge=-10, le=10)
    """Points below this height in the map frame are floor: a tilt of 1.5 degrees seen at 5 m still is, a box is not."""
    floor_depth_m: float = Field(0.5, gt=0, le=100)
    """Points farther than this below the map's plane are taken for reflections and left out."""
    min_depth_m: float = Field(0.4, ge=0, le=100)
    """Smallest depth; the sensor sees nothing nearer, and a disparity of zero means 0.31 m."""
    max_depth_m: float = Field(5.0, gt=0, le=100)
    """Largest depth: one step of disparity is 0.07 m there and grows with the square."""
    max_gap_s: float = Field(0.2, gt=0)
    """Frames without a colour frame, or a pose, so near in time are skipped."""
    frame_stride: int = Field(1, ge=1)
    """Use every k-th disparity frame."""
    pixel_stride: int = Field(1, ge=1)
    """Use every k-th row and column of a disparity frame."""

    @model_validator(mode="after")
    def _check_limits(self) -> TextureSettings:
        if self.min_depth_m >= self.max_depth_m:
            raise ValueError(f"min_depth_m {self.min_depth_m} must be below max_depth_m {self.max_depth_m}")
        if -self.floor_depth_m >= self.floor_height_m:
            raise ValueError(f"floor_height_m {self.floor_height_m} must be above -floor_depth_m {-self.floor_depth_m}")
        return self


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TextureMap:
    """Mean RGB colour (R, C, 3) of the floor in every cell, and where it was seen (R, C); black elsewhere.

    `frames_used` disparity frames contributed; `frames_skipped` had no file, no colour frame or no pose near in time.
    """

    geometry: GridGeometry
    colour: ByteArray
    observed: BoolArray
    frames_used: int
    frames_skipped: int

    def __post_init__(self) -> None:
        colour, observed = read_only(self.colour, np.uint8), read_only(self.observed, np.bool_)
        if observed.shape != self.geometry.shape or colour.shape != (*self.geometry.shape, 3):
            raise InputError("texture map", f"colour {colour.shape} and observed {observed.shape} do not fit the grid")
        object.__setattr__(self, "colour", colour)
        object.__setattr__(self, "observed", observed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Piece:
    """What a worker needs for some frames: files, and poses (n, 4, 4) of the camera in the map."""

    disparity: tuple[Path, ...]
    colour: tuple[Path, ...]
    T_map_camera: FloatArray


def build_texture(
    frames: RgbdFrames,
    trajectory: Trajectory,
    settings: TextureSettings | None = None,
    *,
    geometry: GridGeometry | None = None,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
) -> TextureMap:
    """Return the floor's colours seen by `frames` from `trajectory` (T_map_base), on the cells of `geometry` if given.

    The pose is interpolated at the disparity stamp, the colour frame is the nearest in time on its own clock. Frames
    whose file is None are skipped and counted; a file that is missing or cannot be decoded raises InputError. Frames
    are read one at a time, so that memory does not grow with the log; whole numbers are summed, so that neither does
    the result depend on the workers.
    """
    settings, executor = settings or TextureSettings(), executor or SerialExecutor()
    work, offered = _usable_frames(frames, trajectory, settings)
    geometry = geometry or _geometry(work.T_map_camera, settings)
    add = partial(_add_piece, geometry=geometry, calibration=Calibration.of(frames.calibration), settings=settings)
    sums = np.zeros((*geometry.shape, 4), dtype=np.int64)
    count = len(work.disparity)
    pieces = [_slice(work, start, stop) for start, stop in split_range(count, FRAMES_A_PIECE)]
    for start, stop in split_range(len(pieces), max(1, executor.workers)):
        for part in executor.map(add, pieces[start:stop]):
            sums += part
        progress("texture map", min(stop * FRAMES_A_PIECE, count), count)
    seen = sums[..., 3]
    mean = (sums[..., :3] + seen[..., None] // 2) // np.maximum(seen, 1)[..., None]  # rounded, half up
    return TextureMap(
        geometry=geometry,
        colour=mean.astype(np.uint8),
        observed=seen > 0,
        frames_used=count,
        frames_skipped=offered - count,
    )


def texture_pixels(texture: TextureMap) -> ByteArray:
    """Return the map as RGBA pixels (R, C, 4), top row first; cells never seen are transparent."""
    alpha = np.where(texture.observed, 255, 0).astype(np.uint8)
    return np.concatenate([texture.colour, alpha[..., None]], axis=2)[::-1]


def _usable_frames(frames: RgbdFrames, trajectory: Trajectory, settings: TextureSettings) -> tuple[_Piece, int]:
    """The disparity frames with a colour frame and a pose near in time, and how many there were to choose from."""
    if not frames.has_images:
        raise InputError("RGB-D frames", "no image files", "the texture map needs disparity and colour PNGs")
    chosen = np.arange(0, len(frames.disparity_stamps_s), settings.frame_stride)
    stamps = frames.disparity_stamps_s[chosen]
    nearest = np.clip(frames.nearest_colour(stamps), 0, len(frames.colour_stamps_s) - 1)
    near = np.abs(frames.colour_stamps_s[nearest] - stamps) <= settings.max_gap_s
    near &= stamps >= trajectory.stamps_s.min(initial=np.inf) - settings.max_gap_s
    near &= stamps <= trajectory.stamps_s.max(initial=-np.inf) + settings.max_gap_s
    present = [
        bool(ok) and frames.disparity_files[i] is not None and frames.colour_files[k] is not None
        for i, k, ok in zip(chosen, nearest, near, strict=True)
    ]
    used = np.flatnonzero(present)
    if len(used) == 0:
        raise InputError(
            "RGB-D frames",
            f"none of {len(chosen)} disparity frames has a colour frame and a pose within {settings.max_gap_s} s",
            "check that the images belong to this log, or raise max_gap_s",
        )
    poses = interpolate(trajectory, stamps[used]).spatial().poses @ frames.T_base_camera
    disparity = tuple(path for i in chosen[used] if (path := frames.disparity_files[i]))
    colour = tuple(path for k in nearest[used] if (path := frames.colour_files[k]))
    return _Piece(disparity=disparity, colour=colour, T_map_camera=poses), len(chosen)


def _geometry(T_map_camera: FloatArray, settings: TextureSettings) -> GridGeometry:
    """A grid that holds every floor point within reach: no pixel looks farther aside than its depth."""
    reach = 1.5 * settings.max_depth_m
    return GridGeometry.around(T_map_camera[:, :2, 3], resolution_m=settings.resolution_m, margin_m=reach)


def _slice(work: _Piece, start: int, stop: int) -> _Piece:
    part = slice(start, stop)
    return _Piece(disparity=work.disparity[part], colour=work.colour[part], T_map_camera=work.T_map_camera[part])


def _add_piece(
    piece: _Piece, *, geometry: GridGeometry, calibration: Calibration, settings: TextureSettings
) -> IntArray:
    """Sums (R, C, 4) of the floor's colours and counts over some frames."""
    sums = np.zeros((*geometry.shape, 4), dtype=np.int64)
    limits = FloorLimits(settings.min_depth_m, settings.max_depth_m, -settings.floor_depth_m, settings.floor_height_m)
    for disparity, colour, T_map_camera in zip(piece.disparity, piece.colour, piece.T_map_camera, strict=True):
        add_floor(
            _read_disparity(disparity), _read_colour(colour), np.ascontiguousarray(T_map_camera),
            geometry.cells_from_map, calibration, limits, settings.pixel_stride, sums,
        )  # fmt: skip
    return sums


def _read_disparity(path: Path) -> Float32Array:
    image = read_image(path)
    if image.ndim != 2:
        raise InputError(path, f"is an image of shape {image.shape}, not a disparity image", "it must have one channel")
    return image.astype(np.float32)


def _read_colour(path: Path) -> ByteArray:
    image = read_image(path)
    if image.ndim != 3 or image.dtype != np.uint8:
        raise InputError(path, f"is an image of shape {image.shape} and type {image.dtype}, not 8-bit colour")
    return np.ascontiguousarray(image[..., :3])
