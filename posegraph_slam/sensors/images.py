"""A camera's images by stamp, left where they were recorded and read one at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError

Image = npt.NDArray[Any]
"""(H, W, 3) RGB uint8, or (H, W) grey uint8 or uint16, or depth: uint16 millimetres or float32 metres."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraCalibration:
    """Pinhole matrix `K` (3, 3) in pixels and coefficients (n,) of the distortion `model` (plumb_bob, equidistant)."""

    width: int
    height: int
    K: FloatArray
    distortion: FloatArray
    model: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", read_only(self.K))
        object.__setattr__(self, "distortion", read_only(self.distortion))
        if self.K.shape != (3, 3):
            raise InputError("camera", f"its matrix K has shape {self.K.shape}, not (3, 3)")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageStream:
    """The images of one camera: stamps (N,) and `load`, which reads those at an index; no pixel is held in memory.

    `T_base_camera` (4, 4) mounts the optical frame `frame` (z ahead, x right, y down), where that is known.
    """

    name: str
    stamps_s: FloatArray
    frame: str
    load: Callable[[IntArray], Iterator[Image]]
    calibration: CameraCalibration | None = None
    T_base_camera: FloatArray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "stamps_s", read_only(self.stamps_s))
        if self.T_base_camera is not None:
            object.__setattr__(self, "T_base_camera", read_only(self.T_base_camera))

    def __len__(self) -> int:
        return int(self.stamps_s.shape[0])

    def images(self, index: IntArray | None = None) -> Iterator[Image]:
        """Read the images at `index` (n,) one after another, all of them without it; InputError for a damaged one."""
        chosen = np.arange(len(self)) if index is None else np.asarray(index, dtype=np.int64)
        if len(chosen) and not (chosen.min() >= 0 and chosen.max() < len(self)):
            raise InputError(self.name, f"has {len(self)} images, from 0 on", "choose an index within them")
        return self.load(chosen)
