"""Telling the floor from obstacles in one depth image: by height range, by RANSAC plane, by the known ground plane.

Each function takes depth (H, W) in metres with 0 where there is none, the camera's `DepthView`, and a pose of the
camera; it returns labels (H, W) uint8: 0 says nothing, 1 floor, 2 obstacle, 3 neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray, read_only
from posegraph_slam.mapping.depth_camera import DepthView
from posegraph_slam.mapping.floor_kernels import (
    FLOOR,
    OBSTACLE,
    OTHER,
    UNLABELLED,
    best_plane,
    bottom_points,
    label_by_distance,
    label_by_range,
    plane_sums,
)
from posegraph_slam.mapping.floor_settings import GroundSettings, HeightRangeSettings, PlaneSettings

__all__ = [
    "FLOOR",
    "OBSTACLE",
    "OTHER",
    "UNLABELLED",
    "HeightBand",
    "PlaneLabels",
    "label_ground",
    "label_height_range",
    "label_plane",
    "pitched_camera",
]

SAMPLES = 4000
"""Pixels on which planes are compared: a share of inliers is known to 1 %."""
REFITS = 2
"""Least-squares fits to the inliers, of the bottom first and then of the whole image: the bottom is a strip of 0.2 m,
on which many planes have all inliers, and only their mean points far enough ahead to tell what is floor there."""
EVERYWHERE = 1e9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaneLabels:
    """Labels (H, W) of a frame, and the plane (4,) they come from: plane[:3] . X + plane[3] is the height above it.

    X is in the camera's regular frame. `plane` is None, and no pixel labelled, where no plausible floor was found.
    `inliers` is the share of the bottom's points on the plane.
    """

    labels: ByteArray
    plane: FloatArray | None
    inliers: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "labels", read_only(self.labels, np.uint8))
        if self.plane is not None:
            object.__setattr__(self, "plane", read_only(self.plane))


def label_height_range(
    depth_m: Float32Array,
    view: DepthView,
    T_map_camera: FloatArray,
    settings: HeightRangeSettings | None = None,
    *,
    highest_m: float = EVERYWHERE,
) -> ByteArray:
    """Label pixels by the range of heights in the cell of the map that they fall into, within this frame.

    Obstacle from `obstacle_range_m` on, floor up to `floor_range_m`, neither between; cells with fewer than
    `min_points` points say nothing. Points higher than `highest_m` in the map are left out.
    Source: report of ESE 650 project 3, section III.A; the number of points is an addition.
    """
    settings = settings or HeightRangeSettings()
    cells = view.coordinates(T_map_camera[:3] / np.array([[settings.cell_m], [settings.cell_m], [1.0]]))
    corner, size = cells.window(settings.max_depth_m)
    labels = np.empty(depth_m.shape, dtype=np.uint8)
    low, high = np.full(size, np.inf, dtype=np.float32), np.full(size, -np.inf, dtype=np.float32)
    label_by_range(
        depth_m, *cells, (settings.min_depth_m, settings.max_depth_m), highest_m,
        (settings.floor_range_m, settings.obstacle_range_m), settings.min_points, corner,
        low, high, np.zeros(size, dtype=np.int64), labels,
    )  # fmt: skip
    return labels


def label_plane(
    depth_m: Float32Array,
    view: DepthView,
    T_base_camera: FloatArray,
    settings: PlaneSettings | None = None,
    *,
    rng: np.random.Generator,
    clearance_m: float = EVERYWHERE,
) -> PlaneLabels:
    """Label pixels by a plane that RANSAC finds in the lower part of the image, in the frame of the image.

    A plane of the world is a plane in [1 / depth, column, row] exactly, while it is bent in [depth, column, row]; so
    the bottom tells of the whole image. Inliers everywhere are floor; outliers above the plane are obstacles in the
    bottom and neither elsewhere. The plane is refitted to the inliers of the whole image.
    Source: report of ESE 650 project 3, section III.B; 1 / depth, the refit and the check of tilt and height are ours.
    """
    settings = settings or PlaneSettings()
    limits = settings.min_depth_m, settings.max_depth_m
    first_row = depth_m.shape[0] - round(settings.bottom_fraction * depth_m.shape[0])
    points = _points(depth_m, view, limits, first_row)
    labels = np.zeros(depth_m.shape, dtype=np.uint8)
    if len(points) < 3:
        return PlaneLabels(labels=labels, plane=None, inliers=0.0)
    flat = np.zeros(3)
    triples = rng.integers(0, len(points), size=(settings.trials, 3))
    share = best_plane(points, triples, settings.inlier_m, flat) / len(points)
    flat = _refitted(flat, points, settings.inlier_m)
    flat = _refitted(flat, _points(depth_m, view, limits, 0), settings.inlier_m)
    plane = _above(flat, view)
    if share < settings.min_inliers or not _is_floor(plane, T_base_camera, settings):
        return PlaneLabels(labels=labels, plane=None, inliers=share)
    heights = -settings.inlier_m, settings.inlier_m, clearance_m
    _label_by_plane(depth_m, view, plane, limits, heights, first_row, labels)
    return PlaneLabels(labels=labels, plane=plane, inliers=share)


def label_ground(
    depth_m: Float32Array,
    view: DepthView,
    T_base_camera: FloatArray,
    settings: GroundSettings | None = None,
    *,
    clearance_m: float = EVERYWHERE,
) -> ByteArray:
    """Label pixels by their distance from the plane z = 0 of the base, which pitch and height of the camera give.

    Floor within `max_distance_m` of it, obstacle above, neither below; depths outside the limits say nothing.
    `pitched_camera` makes the pose (4, 4) of a camera in a head that pitches.
    Source: report of ESE 650 project 4 (humanoid), section III.C: |a . X + a_3| <= 0.1, depth 0.5 to 5 m.
    """
    settings = settings or GroundSettings()
    labels = np.empty(depth_m.shape, dtype=np.uint8)
    limits = settings.min_depth_m, settings.max_depth_m
    heights = -settings.max_distance_m, settings.max_distance_m, clearance_m
    _label_by_plane(depth_m, view, T_base_camera[2], limits, heights, 0, labels)
    return labels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeightBand:
    """Labels as floor the pixels between two heights over the base and two depths; higher ones are obstacles.

    `T_base_camera` (4, 4) mounts the camera, so that the floor rises with the robot where its path has a third
    dimension. `tilt_rad` lifts both heights in proportion to the depth, for a robot that tilts unnoticed.
    Source: course report, section III.E, which colours everything below 0.3 m.
    """

    T_base_camera: FloatArray
    depths_m: tuple[float, float]
    heights_m: tuple[float, float]
    tilt_rad: float = 0.0

    @property
    def farthest_m(self) -> float:
        """Largest depth that gets a label."""
        return self.depths_m[1]

    def labels(self, depth_m: Float32Array, view: DepthView, T_map_camera: FloatArray, number: int) -> ByteArray:
        """Return the labels (H, W) of a frame; its number and its pose do not matter."""
        labels = np.empty(depth_m.shape, dtype=np.uint8)
        heights = *self.heights_m, EVERYWHERE
        _label_by_plane(depth_m, view, self.T_base_camera[2], self.depths_m, heights, 0, labels, self.tilt_rad)
        return labels


def pitched_camera(pitch_rad: FloatArray, head_height_m: float, camera_above_head_m: float) -> FloatArray:
    """Return T_base_camera (N, 4, 4) of a camera in a head that pitches by (N,), positive downwards.

    The camera stands `camera_above_head_m` above the head's axis along the head; base is the ground below. The plane
    is that of the report: normal Rotx(pitch) (0, 1, 0) in the optical frame and a_3 = -h - d cos(pitch).
    """
    pitch = np.atleast_1d(np.asarray(pitch_rad, dtype=np.float64))
    c, s = np.cos(pitch), np.sin(pitch)
    poses = np.tile(np.eye(4), (len(pitch), 1, 1))
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 2, 0], poses[:, 2, 2] = c, s, -s, c
    poses[:, :3, 3] = camera_above_head_m * poses[:, :3, 2]
    poses[:, 2, 3] += head_height_m
    return poses


def _points(depth_m: Float32Array, view: DepthView, limits: tuple[float, float], first_row: int) -> FloatArray:
    """About `SAMPLES` pixels (N, 3) [1 / depth, right, down] on a lattice from `first_row` on."""
    rows, columns = depth_m.shape[0] - first_row, depth_m.shape[1]
    stride = max(1, round((rows * columns / SAMPLES) ** 0.5))
    points = np.empty((-(-rows // stride) * -(-columns // stride), 3))
    return points[: bottom_points(depth_m, view.down, view.right, limits, first_row, stride, points)]


def _refitted(flat: FloatArray, points: FloatArray, inlier_m: float) -> FloatArray:
    """The plane (3,) after least-squares fits to its inliers; as it was where they do not span one."""
    sums = np.empty((3, 4))
    for _ in range(REFITS):
        if plane_sums(points, flat, inlier_m, sums) < 3 or np.linalg.cond(sums[:, :3]) > 1e12:
            return flat
        flat = np.asarray(np.linalg.solve(sums[:, :3], sums[:, 3]), dtype=np.float64)
    return flat


def _above(flat: FloatArray, view: DepthView) -> FloatArray:
    """Plane (4,) of heights in the camera's frame, from 1 / depth = flat . [1, right, down].

    X = z (1, -right, -down) from the depth camera's centre, so that n = (flat_0, -flat_1, -flat_2) and n . X = 1 on
    the plane; the camera itself, at 0, has a positive height.
    """
    length = float(np.linalg.norm(flat))
    if length < 1e-12:
        return np.array([0.0, 0.0, 0.0, 1.0])
    normal = -np.array([flat[0], -flat[1], -flat[2]]) / length
    return np.append(normal, 1.0 / length + normal[2] * view.shift_m)


def _is_floor(plane: FloatArray, T_base_camera: FloatArray, settings: PlaneSettings) -> bool:
    """Whether a plane is level enough and passes near the origin of the base."""
    up = T_base_camera[:3, :3] @ plane[:3]
    height_of_base = plane[3] - float(up @ T_base_camera[:3, 3])  # X = -R^T t is the base in the camera's frame
    return bool(up[2] >= np.cos(settings.max_tilt_rad) and abs(height_of_base) <= settings.max_step_m)


def _label_by_plane(
    depth_m: Float32Array,
    view: DepthView,
    plane: FloatArray,
    limits: tuple[float, float],
    heights: tuple[float, float, float],
    first_row: int,
    labels: ByteArray,
    tilt_rad: float = 0.0,
) -> None:
    """Label pixels by their height over a plane: `heights` are lowest and highest of the floor, highest obstacle."""
    rows, columns, constant = view.coordinates(plane[None])
    rows = rows - np.tan(tilt_rad)
    label_by_distance(depth_m, np.ascontiguousarray(rows[:, 0]), np.ascontiguousarray(columns[:, 0]),
                      float(constant[0]), limits, heights, first_row, labels)  # fmt: skip
