"""Point clouds of a 3D LiDAR as planar scans: the points about its horizon, the nearest on each bearing."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray, in_range
from posegraph_slam.datasets.rosbag.frames import bare
from posegraph_slam.datasets.rosbag.growing import GrowingRows
from posegraph_slam.errors import InputError

BEAMS = 720
"""Half a degree each: a spinning LiDAR measures every 0.2 to 0.4 degrees."""
HALF_HEIGHT_M = 0.2
HALF_ANGLE_RAD = np.deg2rad(2.0)
"""Points within 0.2 m of the sensor's height, or within 2 degrees of its horizon: a LiDAR of 16 rings has none at 0."""
GROUND_CLEARANCE_M = 0.1
"""Points nearer to the floor that the robot stands on are the floor."""
RANGE_LIMITS_M = (0.3, 100.0)
"""Nearer points are the robot itself."""
FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


@dataclass(slots=True)
class CloudCollector:
    """Takes PointCloud2 messages one by one and keeps a planar scan of each; `T_base_lidar` (4, 4) mounts the sensor.

    Scans are seen from the sensor but level with the base: beam k points at -pi + k * 2 pi / BEAMS about the base's z.
    """

    topic: str
    T_base_lidar: FloatArray
    frame: str = ""
    _rows: GrowingRows = field(default_factory=lambda: GrowingRows((BEAMS,), np.float32))
    _times: GrowingRows = field(default_factory=lambda: GrowingRows((2,)))

    def add(self, message: Any, recorded_ns: int) -> None:
        """Take one cloud."""
        stamp = message.header.stamp
        self.frame = self.frame or bare(message.header.frame_id)
        points = cloud_points(message, self.topic)
        self._rows.append(planar_slice(points, self.T_base_lidar))
        self._times.append((stamp.sec + 1e-9 * stamp.nanosec, 1e-9 * recorded_ns))

    def finish(self) -> tuple[FloatArray, FloatArray, Float32Array]:
        """Return header stamps (N,), times of recording (N,) and ranges (N, BEAMS) in the order of recording."""
        times = self._times.take()
        return times[:, 0], times[:, 1], self._rows.take()


def cloud_points(message: Any, topic: str) -> FloatArray:
    """Return the finite points (n, 3) of a PointCloud2 in the sensor's frame."""
    fields = {each.name: each for each in message.fields}
    if not {"x", "y", "z"} <= fields.keys():
        raise InputError(topic, f"its clouds have the fields {', '.join(fields)}", "they must have x, y and z")
    order = ">" if message.is_bigendian else "<"
    try:
        layout = np.dtype(
            {
                "names": ["x", "y", "z"],
                "formats": [order + FIELD_TYPES[fields[axis].datatype] for axis in "xyz"],
                "offsets": [fields[axis].offset for axis in "xyz"],
                "itemsize": message.point_step,
            }
        )
        rows = np.asarray(message.data, dtype=np.uint8)
        if message.row_step > message.width * message.point_step and message.height:  # padded rows
            padded = rows[: message.height * message.row_step].reshape(message.height, message.row_step)
            rows = padded[:, : message.width * message.point_step].reshape(-1)
        values = np.frombuffer(rows.tobytes(), layout, count=message.width * message.height)
    except (KeyError, ValueError) as error:
        raise InputError(topic, f"a cloud does not hold what its header says ({error})", "record it again") from error
    points = np.column_stack([values[axis].astype(np.float64) for axis in "xyz"])
    return points[in_range(points).all(axis=1)]


def planar_slice(points: FloatArray, T_base_lidar: FloatArray) -> Float32Array:
    """Return the range (BEAMS,) of the nearest point about the horizon on each bearing, infinity where there is none.

    Points (n, 3) are in the sensor's frame; they are levelled by the rotation of `T_base_lidar`. Where its height
    over the base is known (it is above the clearance), points that near to the floor are left out.
    """
    level = points @ T_base_lidar[:3, :3].T
    distance = np.hypot(level[:, 0], level[:, 1])
    near = np.abs(level[:, 2]) <= np.maximum(HALF_HEIGHT_M, np.tan(HALF_ANGLE_RAD) * distance)
    height = float(T_base_lidar[2, 3])
    if height > GROUND_CLEARANCE_M:
        near &= level[:, 2] + height > GROUND_CLEARANCE_M
    near &= (distance >= RANGE_LIMITS_M[0]) & (distance < RANGE_LIMITS_M[1])
    bearing = np.arctan2(level[near, 1], level[near, 0])
    beam = np.rint((bearing + np.pi) * (BEAMS / (2 * np.pi))).astype(np.int64) % BEAMS
    ranges = np.full(BEAMS, np.inf, dtype=np.float32)
    np.minimum.at(ranges, beam, distance[near].astype(np.float32))
    return ranges
