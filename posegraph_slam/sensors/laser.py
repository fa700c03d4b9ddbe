"""Planar laser scans: ranges, beam geometry, mounting, and their points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, Float32Array, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaserScans:
    """Scans in recorded order: `stamps_s` (N,), `ranges_m` (N, B); beam k points at angle_min + k * increment.

    A range is a return only when it is finite and `range_min_m <= range < range_max_m`; everything else (dropouts,
    no-return values, NaN) is not. `T_base_lidar` (4, 4) mounts the sensor on the robot.
    """

    stamps_s: FloatArray
    ranges_m: Float32Array
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    T_base_lidar: FloatArray

    def __post_init__(self) -> None:
        stamps, ranges = read_only(self.stamps_s), read_only(self.ranges_m, np.float32)
        if ranges.ndim != 2 or stamps.shape != ranges.shape[:1]:
            raise InputError("laser scans", f"stamps {stamps.shape} do not fit ranges {ranges.shape} (scans, beams)")
        object.__setattr__(self, "stamps_s", stamps)
        object.__setattr__(self, "ranges_m", ranges)
        object.__setattr__(self, "T_base_lidar", read_only(self.T_base_lidar))

    def __len__(self) -> int:
        return int(self.stamps_s.shape[0])

    @property
    def beams(self) -> int:
        """Beams a scan."""
        return int(self.ranges_m.shape[1])

    @property
    def angles_rad(self) -> FloatArray:
        """Bearing of every beam (B,) in the lidar frame."""
        return np.asarray(self.angle_min_rad + self.angle_increment_rad * np.arange(self.beams), dtype=np.float64)

    def returns(self, index: slice | IntArray = slice(None)) -> BoolArray:
        """Which beams (n, B) of the scans at `index` hit something."""
        ranges = self.ranges_m[index]
        with np.errstate(invalid="ignore"):
            return np.asarray((ranges >= self.range_min_m) & (ranges < self.range_max_m))

    def points(self, scan: int) -> FloatArray:
        """Returns of one scan as points (n, 2) in the lidar frame, in beam order."""
        hit = self.returns(slice(scan, scan + 1))[0]
        ranges = self.ranges_m[scan, hit].astype(np.float64)
        angles = self.angles_rad[hit]
        return np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=1)

    def select(self, index: slice | IntArray) -> LaserScans:
        """Return the scans at `index`, in that order."""
        return LaserScans(
            stamps_s=self.stamps_s[index],
            ranges_m=self.ranges_m[index],
            angle_min_rad=self.angle_min_rad,
            angle_increment_rad=self.angle_increment_rad,
            range_min_m=self.range_min_m,
            range_max_m=self.range_max_m,
            T_base_lidar=self.T_base_lidar,
        )
