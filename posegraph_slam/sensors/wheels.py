"""Wheel encoders of a differential-drive robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WheelEncoders:
    """Ticks since the previous stamp: `stamps_s` (N,), `ticks_left` and `ticks_right` (N, wheels of that side)."""

    stamps_s: FloatArray
    ticks_left: IntArray
    ticks_right: IntArray
    metres_per_tick: float
    track_width_m: float
    """Distance between the left and right wheels, effective when turning; used where no gyro covers the time."""

    def __post_init__(self) -> None:
        stamps = read_only(self.stamps_s)
        object.__setattr__(self, "stamps_s", stamps)
        for name in ("ticks_left", "ticks_right"):
            ticks = read_only(getattr(self, name), np.int64)
            if ticks.ndim != 2 or ticks.shape[0] != stamps.shape[0]:
                raise InputError("wheel encoders", f"{name} {ticks.shape} does not fit {stamps.shape[0]} stamps")
            object.__setattr__(self, name, ticks)

    def __len__(self) -> int:
        return int(self.stamps_s.shape[0])

    @property
    def travel_m(self) -> FloatArray:
        """Distance (N, 2) that the left and right side rolled since the previous stamp (wheels of a side averaged)."""
        return self.metres_per_tick * np.stack([self.ticks_left.mean(axis=1), self.ticks_right.mean(axis=1)], axis=1)
