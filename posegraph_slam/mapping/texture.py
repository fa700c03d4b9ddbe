"""The texture map: the floor's colours, fused over the frames of an RGB-D camera along a trajectory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from posegraph_slam.arrays import BoolArray, ByteArray, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress, split_range
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.colour_patches import Painter, Patches, PatchStore, exposure_samples, fuse, paint
from posegraph_slam.mapping.depth_frames import (
    FRAMES_A_PIECE,
    DepthFrames,
    Unreadable,
    require_readable,
    usable_frames,
)
from posegraph_slam.mapping.exposure import ExposureSamples, exposure_gains
from posegraph_slam.mapping.floor_labels import HeightBand
from posegraph_slam.mapping.floor_map import FloorLabeller
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.sensors import RgbdFrames
from posegraph_slam.settings import Settings


class TextureSettings(Settings):
    """How RGB-D frames become a texture map (course report, sections III.A.4 and III.E)."""

    resolution_m: float = Field(0.05, gt=0, le=10)
    """Side of a cell, where the map does not share the occupancy map's cells."""
    floor_height_m: float = Field(0.03, ge=-10, le=10)
    """Points below this height over the robot's base are floor. Where floor.method is set, its verdict on every pixel
    takes the place of heights and depths."""
    floor_tilt_rad: float = Field(0.026, ge=0, le=0.5)
    """Rise of that height with depth: floor seen from a robot that tilts by 1.5 degrees unnoticed is still floor."""
    floor_depth_m: float = Field(0.5, gt=0, le=100)
    """Points farther than this below the base's plane are taken for reflections and left out."""
    min_depth_m: float = Field(0.4, ge=0, le=100)
    """Smallest depth; the sensor sees nothing nearer, and a disparity of zero means 0.31 m."""
    max_depth_m: float = Field(4.0, gt=0, le=100)
    """Largest depth: one row of pixels covers 0.08 m of floor there, and that grows with the square."""
    weighting: Literal["view", "uniform"] = "view"
    """view: a pixel counts by the cosine of its viewing angle over its squared distance; uniform: all count alike."""
    min_pixels: int = Field(3, ge=1)
    """Pixels of a frame that a cell needs to take its colour: noise throws single ones behind walls."""
    even_exposure: bool = True
    """Solve a gain for every colour frame and channel over the cells that frames share, and divide by it."""
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
    """Fused RGB colour (R, C, 3) of the floor in every cell, and where it was seen (R, C); black elsewhere.

    `frames_used` disparity frames contributed; `frames_skipped` had no file, could not be read, or had no colour frame
    or pose near in time. `gains` (F, 3) are the exposures of the frames of numbers `frames` (F,), 1 on average.
    """

    geometry: GridGeometry
    colour: ByteArray
    observed: BoolArray
    frames_used: int
    frames_skipped: int
    frames: IntArray
    gains: FloatArray
    unreadable: Unreadable

    def __post_init__(self) -> None:
        colour, observed = read_only(self.colour, np.uint8), read_only(self.observed, np.bool_)
        if observed.shape != self.geometry.shape or colour.shape != (*self.geometry.shape, 3):
            raise InputError("texture map", f"colour {colour.shape} and observed {observed.shape} do not fit the grid")
        object.__setattr__(self, "colour", colour)
        object.__setattr__(self, "observed", observed)
        object.__setattr__(self, "frames", read_only(self.frames, np.int64))
        object.__setattr__(self, "gains", read_only(self.gains))


def build_texture(
    frames: RgbdFrames,
    trajectory: Trajectory,
    settings: TextureSettings | None = None,
    *,
    geometry: GridGeometry | None = None,
    labeller: FloorLabeller | None = None,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
) -> TextureMap:
    """Return the floor's colours seen by `frames` from `trajectory` (T_map_base), on the cells of `geometry` if given.

    Poses are interpolated at the stamps of both images; the colour image is the nearest in time on its own clock, and
    each point is looked up where the camera of that moment saw it. `labeller` tells the floor pixel by pixel, else
    heights do; a cell is observed where floor outweighs the rest. Files that are absent or cannot be read are skipped
    and counted; InputError where none is left. Images are read once and one at a time; until the gains are known, the
    colours of each frame's cells wait in a temporary file. Whole numbers are summed, so that the result does not
    depend on the workers.
    """
    settings, executor = settings or TextureSettings(), executor or SerialExecutor()
    work, offered = usable_frames(
        frames, trajectory, max_gap_s=settings.max_gap_s, stride=settings.frame_stride, colour=True
    )
    geometry = geometry or _geometry(work.T_map_camera, settings)
    painter = Painter(
        geometry=geometry,
        calibration=frames.calibration,
        labels=labeller or _heights(settings, frames),
        uniform=settings.weighting == "uniform",
        stride=settings.pixel_stride,
        min_pixels=settings.min_pixels,
    )
    sums, gains, unreadable = np.zeros((*geometry.shape, 5), dtype=np.int64), np.ones((len(work), 3)), Unreadable()
    with PatchStore() as store:
        samples = []
        for patches in _patches(work, painter, executor, progress):
            unreadable += patches.unreadable
            if settings.even_exposure:
                store.append(patches)
                samples.append(exposure_samples(patches, geometry))
            else:
                fuse(patches, gains, sums)
        if settings.even_exposure:
            gains = exposure_gains(ExposureSamples.joined(samples), len(work))
            for patches in store:
                fuse(patches, gains, sums)
    require_readable(len(work), unreadable)
    return _texture_map(geometry, sums, work, offered, gains=gains, unreadable=unreadable)


def texture_pixels(texture: TextureMap) -> ByteArray:
    """Return the map as RGBA pixels (R, C, 4), top row first; cells never seen are transparent."""
    alpha = np.where(texture.observed, 255, 0).astype(np.uint8)
    return np.concatenate([texture.colour, alpha[..., None]], axis=2)[::-1]


def _texture_map(
    geometry: GridGeometry,
    sums: IntArray,
    work: DepthFrames,
    offered: int,
    *,
    gains: FloatArray,
    unreadable: Unreadable,
) -> TextureMap:
    """Divide the sums (R, C, 5) [red, green, blue, weight of floor, weight of the rest] where floor prevails."""
    weight = sums[..., 3]
    observed = weight > sums[..., 4]
    mean = (sums[..., :3] + weight[..., None] // 2) // np.maximum(weight, 1)[..., None]  # rounded, half up
    return TextureMap(
        geometry=geometry,
        colour=np.where(observed[..., None], np.minimum(mean, 255), 0),
        observed=observed,
        frames_used=len(work) - unreadable.count,
        frames_skipped=offered - len(work) + unreadable.count,
        frames=np.array(work.number),
        gains=gains,
        unreadable=unreadable,
    )


def _heights(settings: TextureSettings, frames: RgbdFrames) -> HeightBand:
    return HeightBand(
        T_base_camera=frames.T_base_camera,
        depths_m=(settings.min_depth_m, settings.max_depth_m),
        heights_m=(-settings.floor_depth_m, settings.floor_height_m),
        tilt_rad=settings.floor_tilt_rad,
    )


def _geometry(T_map_camera: FloatArray, settings: TextureSettings) -> GridGeometry:
    """A grid that holds every floor point within reach: no pixel looks farther aside than its depth."""
    reach = 1.5 * settings.max_depth_m
    return GridGeometry.around(T_map_camera[:, :2, 3], resolution_m=settings.resolution_m, margin_m=reach)


def _patches(work: DepthFrames, painter: Painter, executor: Executor, progress: Progress) -> Iterator[Patches]:
    """Yield the colours of the cells of every frame, some frames at a time, in order."""
    pieces = list(zip(range(0, len(work), FRAMES_A_PIECE), work.pieces(FRAMES_A_PIECE), strict=True))
    for start, stop in split_range(len(pieces), max(1, executor.workers)):
        yield from executor.map(partial(paint, painter=painter), pieces[start:stop])
        progress("texture map", min(stop * FRAMES_A_PIECE, len(work)), len(work))
