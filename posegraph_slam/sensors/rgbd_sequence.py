"""Registered pairs of colour and depth images, as most RGB-D cameras and data sets give them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class PinholeCamera:
    """A pinhole camera without distortion: u = fx x/z + cx, v = fy y/z + cy, pixel centres at whole numbers.

    A stored depth of `depth_units_per_m` is one metre along the optical axis; zero means that nothing was measured.
    """

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    depth_units_per_m: float = 1000.0

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InputError("camera", f"an image of {self.width} x {self.height} pixels", "give width and height")
        if not all(np.isfinite(value) and value > 0 for value in (self.fx_px, self.fy_px, self.depth_units_per_m)):
            raise InputError(
                "camera",
                f"fx {self.fx_px:g}, fy {self.fy_px:g} and depth unit {self.depth_units_per_m:g} are not all positive",
                "give focal lengths in pixels and depth units a metre",
            )
        if not (np.isfinite(self.cx_px) and np.isfinite(self.cy_px)):
            raise InputError("camera", "its centre is not finite", "give cx and cy in pixels")

    def vector(self) -> FloatArray:
        """Return [fx, fy, cx, cy] (4,) in pixels."""
        return np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px])

    def describe(self) -> str:
        """Return the numbers as one phrase."""
        return (
            f"fx {self.fx_px:g}, fy {self.fy_px:g}, cx {self.cx_px:g}, cy {self.cy_px:g} px for "
            f"{self.width} x {self.height}, depth / {self.depth_units_per_m:g} = m"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdSequence:
    """Pairs of image files, the depth registered to the colour image pixel by pixel.

    The colour image was taken at `stamps_s` (N,), the depth `depth_lag_s` (N,) later; unset, at the same time. The body
    that moves is the camera itself in its optical frame: x to the right, y down, z ahead.
    """

    stamps_s: FloatArray
    colour_files: tuple[Path, ...]
    depth_files: tuple[Path, ...]
    camera: PinholeCamera
    depth_lag_s: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        lag_s = self.depth_lag_s if len(self.depth_lag_s) else np.zeros(len(self.stamps_s))
        object.__setattr__(self, "stamps_s", read_only(self.stamps_s))
        object.__setattr__(self, "depth_lag_s", read_only(lag_s))
        if len(self.depth_lag_s) != len(self.stamps_s):
            raise InputError("rgbd", f"{len(self.depth_lag_s)} lags of depth for {len(self.stamps_s)} frames")
        if not len(self.stamps_s) == len(self.colour_files) == len(self.depth_files):
            raise InputError("rgbd", "stamps, colour and depth files differ in number")

    def __len__(self) -> int:
        return int(self.stamps_s.shape[0])
