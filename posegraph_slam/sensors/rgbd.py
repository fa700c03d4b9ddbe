"""Depth and colour frames of an RGB-D camera, kept as files and read one at a time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DisparityCalibration:
    """From a disparity image to depth and to the colour pixel of each disparity pixel (eq. 21-22 of the report).

    dd = dd_offset + dd_slope * d; depth = depth_scale / dd; colour row i' = (row_scale i + row_offset + row_dd dd) / f,
    colour column j' = (row_scale j + column_offset) / f. Rows are u and columns v: cu belongs to the row.
    """

    focal_px: float = 585.05
    centre_row_px: float = 242.94
    centre_column_px: float = 315.84
    dd_offset: float = 3.31
    dd_slope: float = -0.00304
    depth_scale: float = 1.03
    colour_scale: float = 526.37
    colour_row_offset: float = 19276.0
    colour_row_dd: float = -7877.07
    colour_column_offset: float = 16662.0
    colour_divisor: float = 585.051


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdFrames:
    """Disparity and colour frames on two clocks: stamps (D,) and (C,), and the file of each frame (None if absent).

    `T_base_camera` (4, 4) mounts the camera in its regular frame: x ahead, y left, z up.
    """

    disparity_stamps_s: FloatArray
    colour_stamps_s: FloatArray
    disparity_files: tuple[Path | None, ...]
    colour_files: tuple[Path | None, ...]
    T_base_camera: FloatArray
    calibration: DisparityCalibration = field(default_factory=DisparityCalibration)

    def __post_init__(self) -> None:
        for name in ("disparity_stamps_s", "colour_stamps_s", "T_base_camera"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def has_images(self) -> bool:
        """Whether at least one disparity and one colour file exist."""
        return any(self.disparity_files) and any(self.colour_files)

    def nearest_colour(self, stamps_s: FloatArray) -> IntArray:
        """Index (n,) of the colour frame nearest in time to each stamp; raises InputError where there are none."""
        clock = self.colour_stamps_s
        if len(clock) == 0:
            raise InputError("rgbd", "has no colour frames", "the texture map needs colour images")
        after = np.clip(np.searchsorted(clock, stamps_s), min(1, len(clock) - 1), len(clock) - 1)
        before = np.maximum(after - 1, 0)
        earlier = stamps_s - clock[before] < clock[after] - stamps_s
        return np.asarray(np.where(earlier, before, after), dtype=np.int64)
