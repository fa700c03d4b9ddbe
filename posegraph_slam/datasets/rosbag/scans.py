"""Laser scans of a bag: messages of one geometry to arrays, those of another resampled onto it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import Float32Array, FloatArray, IntArray
from posegraph_slam.datasets.rosbag.frames import bare
from posegraph_slam.datasets.rosbag.growing import GrowingRows
from posegraph_slam.sensors import LaserScans

DECIDING_MESSAGES = 32
"""The commonest geometry among the first so many messages is that of the stream."""
DROPOUT_M = 0.02
"""No laser measures under 2 cm; drivers that state a range_min of 0 write 0 for a beam without return."""
Geometry = tuple[int, float, float]
"""Beams, angle_min, angle_increment."""


@dataclass(slots=True)
class ScanCollector:
    """Takes LaserScan and MultiEchoLaserScan messages one by one; `finish` gives the scans."""

    topic: str
    frame: str = ""
    geometry: Geometry | None = None
    range_limits_m: tuple[float, float] = (0.0, 0.0)
    resampled: int = 0
    empty: int = 0
    _waiting: list[tuple[float, float, Geometry, Float32Array, tuple[float, float]]] = field(default_factory=list)
    _rows: GrowingRows | None = None
    _times: GrowingRows = field(default_factory=lambda: GrowingRows((2,)))
    _maps: dict[Geometry, IntArray] = field(default_factory=dict)

    def add(self, message: Any, recorded_ns: int) -> None:
        """Take one message; one without beams is counted and left out."""
        ranges = first_echoes(message)
        self.frame = self.frame or bare(message.header.frame_id)
        if not len(ranges) or message.angle_increment == 0:
            self.empty += 1
            return
        stamp = message.header.stamp
        geometry = (len(ranges), float(message.angle_min), float(message.angle_increment))
        limits = (float(message.range_min), float(message.range_max))
        row = (stamp.sec + 1e-9 * stamp.nanosec, 1e-9 * recorded_ns, geometry, ranges, limits)
        if self._rows is not None:
            self._store(*row[:4])
            return
        self._waiting.append(row)
        if len(self._waiting) == DECIDING_MESSAGES:
            self._decide()

    def _decide(self) -> None:
        """Settle the geometry, and store what waited for it."""
        self.geometry = Counter(row[2] for row in self._waiting).most_common(1)[0][0]
        self.range_limits_m = Counter(row[4] for row in self._waiting).most_common(1)[0][0]
        self._rows = GrowingRows((self.geometry[0],), np.float32)
        for row in self._waiting:
            self._store(*row[:4])
        self._waiting.clear()

    def _store(self, stamp_s: float, recorded_s: float, geometry: Geometry, ranges: Float32Array) -> None:
        assert self._rows is not None
        assert self.geometry is not None
        if geometry != self.geometry:
            index = self._maps.get(geometry)
            if index is None:
                index = self._maps[geometry] = nearest_beams(self.geometry, geometry)
                if len(self._maps) > 10_000:  # a driver that measures its own speed has a geometry a scan
                    self._maps.clear()
            ranges = np.where(index >= 0, ranges[index], np.float32(np.inf))
            self.resampled += 1
        self._rows.append(ranges)
        self._times.append((stamp_s, recorded_s))

    def finish(self) -> tuple[FloatArray, FloatArray, Float32Array]:
        """Return header stamps (N,), times of recording (N,) and ranges (N, B) in the order of recording."""
        if self._rows is None and self._waiting:
            self._decide()
        times = self._times.take()
        ranges = self._rows.take() if self._rows is not None else np.empty((0, 0), dtype=np.float32)
        return times[:, 0], times[:, 1], ranges

    def remarks(self) -> list[str]:
        """Say what was left out or changed."""
        found = []
        if self.empty:
            found.append(f"{self.empty} messages of {self.topic} have no beams and are left out")
        if self.resampled and self.geometry is not None:
            found.append(
                f"{self.resampled} scans of {self.topic} have other beam angles than the rest: "
                f"they are put on its {self.geometry[0]} beams, nearest beam each"
            )
        return found


def first_echoes(message: Any) -> Float32Array:
    """Return the ranges (B,) of a scan; of a beam with several echoes the first, infinity where it has none."""
    ranges = message.ranges
    if isinstance(ranges, np.ndarray):
        return np.asarray(ranges, dtype=np.float32)
    return np.array([each.echoes[0] if len(each.echoes) else np.inf for each in ranges], dtype=np.float32)


def nearest_beams(target: Geometry, source: Geometry) -> IntArray:
    """Index (B,) of the source beam nearest to each target beam; -1 where none is within a step of the wider fan."""
    angles = target[1] + target[2] * np.arange(target[0])
    position = (angles - source[1]) / source[2]
    # a bearing may be told a turn away
    turn = 2 * np.pi / abs(source[2])
    position = np.where(position < -0.5, position + turn, position)
    position = np.where(position > source[0] - 0.5, position - turn, position)
    index = np.rint(position).astype(np.int64)
    reach = max(abs(target[2] / source[2]), 1.0) / 2 + 1e-6
    near = (np.abs(np.clip(index, 0, source[0] - 1) - position) <= reach) & (index >= -1) & (index <= source[0])
    return np.where(near, np.clip(index, 0, source[0] - 1), -1)


def upright(scans: LaserScans) -> LaserScans:
    """Return the scans of a laser that hangs upside down as one that stands: beams in reverse order, turned mounting.

    Beam k of the hanging laser points at angle a_k about its z axis, which points down: seen from above it is -a_k.
    """
    if scans.T_base_lidar[2, 2] >= 0:
        return scans
    flip = np.eye(4)
    flip[:3, :3] = Rotation.from_euler("x", np.pi).as_matrix()
    last = scans.angle_min_rad + (scans.beams - 1) * scans.angle_increment_rad
    return LaserScans(
        stamps_s=scans.stamps_s,
        ranges_m=np.ascontiguousarray(scans.ranges_m[:, ::-1]),
        angle_min_rad=-last,
        angle_increment_rad=scans.angle_increment_rad,
        range_min_m=scans.range_min_m,
        range_max_m=scans.range_max_m,
        T_base_lidar=np.round(scans.T_base_lidar @ flip, 15),
    )
