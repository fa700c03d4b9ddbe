"""What the disparity and the colour camera see of the world, pixel by pixel.

The pixel of the colour image that belongs to a disparity pixel moves with 1/depth, by a shift along the rows alone. So
the disparity image is exactly a pinhole image too, with the centre shifted along the rows' axis; both images are cast
through the same code, each from its own centre, and occlusions are right in both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import ByteArray, FloatArray, IntArray, read_only
from posegraph_slam.datasets.simulation import robot
from posegraph_slam.datasets.simulation.floor import FloorTexture
from posegraph_slam.datasets.simulation.raycast import cast_fan
from posegraph_slam.datasets.simulation.settings import KinectSettings
from posegraph_slam.datasets.simulation.world import World
from posegraph_slam.jit import kernel
from posegraph_slam.sensors import DisparityCalibration

FAN_RAYS = 4096
"""Rays of the plan view that tell which obstacle a pixel sees: six for each column of pixels."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A pinhole on the robot: `centre_m` (3,) and a direction (H, W, 3) for each pixel in the base frame.

    A point seen is centre + depth * direction. `fan` is [first bearing, increment] of the rays in the plan view that
    cover all directions, and `ray` (H, W) the place of each pixel among them.
    """

    centre_m: FloatArray
    directions: FloatArray
    fan: FloatArray
    ray: FloatArray

    def __post_init__(self) -> None:
        for name in ("centre_m", "directions", "fan", "ray"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def colour_view(calibration: DisparityCalibration) -> View:
    """Return the view of the colour camera: row u, column v, focal length and centre of `calibration`."""
    rows, columns = (np.arange(n, dtype=np.float64) for n in robot.IMAGE_SHAPE)
    return _view(rows, columns, 0.0, calibration)


def disparity_view(calibration: DisparityCalibration) -> View:
    """Return the view of the disparity camera, through the formulas for the colour pixel of a disparity pixel.

    Row: u = (scale i + offset + row_dd dd) / divisor with dd = depth_scale / depth; times depth, the last term is a
    constant shift of the centre.
    """
    c = calibration
    rows, columns = (np.arange(n, dtype=np.float64) for n in robot.IMAGE_SHAPE)
    u = (c.colour_scale * rows + c.colour_row_offset) / c.colour_divisor
    v = (c.colour_scale * columns + c.colour_column_offset) / c.colour_divisor
    return _view(u, v, c.colour_row_dd * c.depth_scale / (c.colour_divisor * c.focal_px), c)


def _view(rows: FloatArray, columns: FloatArray, shift_down_m: float, calibration: DisparityCalibration) -> View:
    """View through pixel rows (H,) and columns (W,) of the pinhole, its centre moved down in the optical frame."""
    T_base_camera = robot.T_BASE_CAMERA
    down = (rows - calibration.centre_row_px) / calibration.focal_px
    right = (columns - calibration.centre_column_px) / calibration.focal_px
    directions = np.empty((len(rows), len(columns), 3))
    directions[..., 0], directions[..., 1], directions[..., 2] = 1.0, -right[None, :], -down[:, None]
    directions = directions @ T_base_camera[:3, :3].T
    bearing = np.arctan2(directions[..., 1], directions[..., 0])
    low, high = float(bearing.min()), float(bearing.max())
    increment = (high - low) / (FAN_RAYS - 2)
    centre = T_base_camera[:3, 3] + T_base_camera[:3, :3] @ np.array([0.0, 0.0, -shift_down_m])
    return View(centre_m=centre, directions=directions, fan=np.array([low, increment]), ray=(bearing - low) / increment)


@kernel
def _distance(dx: float, dy: float, hit: int, segments: FloatArray, circles: FloatArray) -> float:
    """Multiple of (dx, dy) at which the ray from the origin meets one obstacle; infinite if it does not."""
    if hit < 0:
        return np.inf
    if hit < segments.shape[0]:
        ax, ay, bx, by = segments[hit, 0], segments[hit, 1], segments[hit, 2], segments[hit, 3]
        slope = dx * (by - ay) - dy * (bx - ax)
        along = (ax * dy - ay * dx) / slope
        distance = (ax * by - ay * bx) / slope
        return distance if distance > 0.0 and -1e-12 <= along <= 1.0 + 1e-12 else np.inf
    c = hit - segments.shape[0]
    cx, cy, radius = circles[c, 0], circles[c, 1], circles[c, 2]
    square, nearest = dx * dx + dy * dy, cx * dx + cy * dy
    root = nearest * nearest - square * (cx * cx + cy * cy - radius * radius)
    distance = (nearest - np.sqrt(max(root, 0.0))) / square
    return distance if root >= 0.0 and distance > 0.0 else np.inf


@kernel
def _nearest(
    dx: float, dy: float, left: int, right: int, segments: FloatArray, circles: FloatArray
) -> tuple[float, int]:
    """Nearer of two obstacles on a ray, or the nearest of all where the ray misses both, in the gap between them."""
    nearest, hit = _distance(dx, dy, left, segments, circles), left
    if right != left:
        distance = _distance(dx, dy, right, segments, circles)
        if distance < nearest:
            nearest, hit = distance, right
    if nearest == np.inf:
        for candidate in range(segments.shape[0] + circles.shape[0]):
            distance = _distance(dx, dy, candidate, segments, circles)
            if distance < nearest:
                nearest, hit = distance, candidate
    return nearest, hit


@kernel
def _render(
    centre: FloatArray,
    directions: FloatArray,
    fan: FloatArray,
    ray: FloatArray,
    segments: FloatArray,
    circles: FloatArray,
    depth: FloatArray,
    seen: IntArray,
) -> None:
    """Fill depth (H, W) and the obstacle seen (H, W), -1 for the floor; obstacles are given in the base frame about
    the centre. A pixel tests the obstacles of the two rays of the plan view beside it."""
    ranges, hits = np.empty(FAN_RAYS), np.empty(FAN_RAYS, dtype=np.int64)
    cast_fan(0.0, 0.0, fan[0], fan[1], segments, circles, ranges, hits)
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            dx, dy, dz = directions[i, j, 0], directions[i, j, 1], directions[i, j, 2]
            depth[i, j] = -centre[2] / dz if dz < 0.0 else np.inf
            seen[i, j] = -1
            k = min(int(ray[i, j]), FAN_RAYS - 2)
            nearest, hit = _nearest(dx, dy, hits[k], hits[k + 1], segments, circles)
            if nearest < depth[i, j]:
                depth[i, j], seen[i, j] = nearest, hit


@kernel
def _paint(
    xyt: FloatArray,
    centre: FloatArray,
    directions: FloatArray,
    depth: FloatArray,
    seen: IntArray,
    colours: ByteArray,
    floor: ByteArray,
    floor_frame: FloatArray,
    image: ByteArray,
) -> None:
    """Fill the RGB image (H, W, 3) with the colour of the obstacle or floor cell seen, black where neither is."""
    c, s = np.cos(xyt[2]), np.sin(xyt[2])
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            if seen[i, j] >= 0:
                for channel in range(3):
                    image[i, j, channel] = colours[seen[i, j], channel]
                continue
            if not np.isfinite(depth[i, j]):
                image[i, j] = 0
                continue
            px, py = centre[0] + depth[i, j] * directions[i, j, 0], centre[1] + depth[i, j] * directions[i, j, 1]
            column = np.floor((xyt[0] + c * px - s * py - floor_frame[0]) / floor_frame[2])
            row = np.floor((xyt[1] + s * px + c * py - floor_frame[1]) / floor_frame[2])
            m, n = int(min(max(row, 0.0), floor.shape[0] - 1.0)), int(min(max(column, 0.0), floor.shape[1] - 1.0))
            for channel in range(3):
                image[i, j, channel] = floor[m, n, channel]


def render_depth(view: View, world: World, xyt: FloatArray) -> tuple[FloatArray, IntArray]:
    """Render depth (H, W) along the optical axis and the obstacle seen (H, W; -1: floor) from robot pose `xyt` (3,)."""
    c, s = np.cos(xyt[2]), np.sin(xyt[2])
    R_base_world = np.array([[c, s], [-s, c]])
    ends = (world.segments.reshape(-1, 2) - xyt[:2]) @ R_base_world.T - view.centre_m[:2]
    circles = world.circles.copy()
    circles[:, :2] = (world.circles[:, :2] - xyt[:2]) @ R_base_world.T - view.centre_m[:2]
    depth, seen = np.empty(robot.IMAGE_SHAPE), np.empty(robot.IMAGE_SHAPE, dtype=np.int64)
    _render(
        view.centre_m, view.directions, view.fan, view.ray, np.ascontiguousarray(ends).reshape(-1, 4), circles,
        depth, seen,
    )  # fmt: skip
    return depth, seen


def render_colour(view: View, world: World, floor: FloorTexture, xyt: FloatArray) -> ByteArray:
    """Render the RGB image (H, W, 3) that the colour camera takes from robot pose `xyt` (3,)."""
    depth, seen = render_depth(view, world, xyt)
    image = np.empty((*robot.IMAGE_SHAPE, 3), dtype=np.uint8)
    frame = np.array([*floor.origin_m, floor.resolution_m])
    _paint(xyt, view.centre_m, view.directions, depth, seen, world.colours, floor.colours, frame, image)
    return image


def expose(image: ByteArray, gain: float) -> ByteArray:
    """Return an RGB image as it comes out with another exposure; bright colours saturate at 255."""
    return np.asarray(np.minimum(np.rint(image * gain), 255), dtype=np.uint8)


def disparity_image(
    depth: FloatArray, calibration: DisparityCalibration, settings: KinectSettings, rng: np.random.Generator
) -> npt.NDArray[np.uint16]:
    """Turn depth (H, W) into the disparity image: d = (dd - offset) / slope, noisy, whole; 0 outside the range."""
    disparity = (calibration.depth_scale / depth - calibration.dd_offset) / calibration.dd_slope
    disparity += settings.sigma_disparity * rng.standard_normal(depth.shape)
    inside = (depth >= settings.range_min_m) & (depth < settings.range_max_m)
    return np.asarray(np.where(inside, np.clip(np.round(disparity), 1, 65535), 0), dtype=np.uint16)
