"""The simulated robot, that of the ECE276A logs: the laser scanner's and the cameras' own figures."""

from __future__ import annotations

from posegraph_slam.arrays import read_only
from posegraph_slam.datasets.ece276a import METRES_PER_TICK, T_BASE_CAMERA, T_BASE_LIDAR, TRACK_WIDTH_M

LIDAR_ANGLE_MIN_RAD = -2.356194490192345
"""The fan reaches 135 degrees to either side."""
LIDAR_RANGE_MIN_M, LIDAR_RANGE_MAX_M = 0.1, 30.0
LIDAR_DROPOUT_M, LIDAR_NO_RETURN_M = 0.001, 60.0
IMAGE_SHAPE = (480, 640)
ANTENNAE = read_only([[-0.1, 0.22, 0.015], [-0.1, -0.22, 0.015]])
"""Two posts [x, y, radius] in the plane of the scanner, left and right behind it."""

__all__ = [
    "ANTENNAE",
    "IMAGE_SHAPE",
    "LIDAR_ANGLE_MIN_RAD",
    "LIDAR_DROPOUT_M",
    "LIDAR_NO_RETURN_M",
    "LIDAR_RANGE_MAX_M",
    "LIDAR_RANGE_MIN_M",
    "METRES_PER_TICK",
    "TRACK_WIDTH_M",
    "T_BASE_CAMERA",
    "T_BASE_LIDAR",
]
