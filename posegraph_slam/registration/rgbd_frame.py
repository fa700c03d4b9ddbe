"""RGB-D frames prepared for direct alignment: image pyramids, and for a reference its points, normals and gradients.

Intensities are in [0, 255], depths in metres along the optical axis, 0 where nothing was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray, read_only
from posegraph_slam.jit import kernel

LEVELS = 4
"""Images of the pyramid: 640 x 480 goes down to 80 x 60."""
POINTS_ACROSS = 160
"""Reference points along a row of a level: finer levels are thinned to this, about 19,000 points in 4:3."""
JUMP = 0.03
"""Neighbouring depths that differ by a larger share do not lie on one surface."""
PLANE_RADIUS = 4
"""Half width in pixels of the window in which a plane is fitted, of the level's own pixels."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdFrame:
    """Pyramid of one frame, finest first: intensity and depth (h, w) float32, and [fx, fy, cx, cy] of every level."""

    intensity: tuple[Float32Array, ...]
    depth: tuple[Float32Array, ...]
    camera: tuple[FloatArray, ...]

    @property
    def levels(self) -> int:
        """Number of images in the pyramid."""
        return len(self.camera)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReferencePoints:
    """Points of one level of a reference frame, in its camera frame.

    `points` (n, 3); `normals` (n, 3) towards the camera, zero where no plane fits; `gradients` (n, 3), the change of
    intensity a metre of motion of the camera's view, zero at edges of objects; `intensity` (n,); `sigma_m` (n,) of
    depth.
    """

    points: FloatArray
    normals: FloatArray
    gradients: FloatArray
    intensity: FloatArray
    sigma_m: FloatArray

    def __post_init__(self) -> None:
        for name in ("points", "normals", "gradients", "intensity", "sigma_m"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        return int(self.points.shape[0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdReference:
    """A frame that others are aligned to: its pyramid and the points of each level, finest first."""

    frame: RgbdFrame
    points: tuple[ReferencePoints, ...]


def prepare_frame(
    colour: ByteArray, depth: npt.NDArray[np.uint16], camera: FloatArray, *, depth_units_per_m: float,
    max_depth_m: float, levels: int = LEVELS,
) -> RgbdFrame:  # fmt: skip
    """Build the pyramid of a frame from RGB or grey `colour` (h, w[, 3]) and raw `depth` (h, w).

    `camera` is [fx, fy, cx, cy] of the finest level. Depths beyond `max_depth_m` count as not measured.
    """
    grey = colour.reshape(*colour.shape[:2], -1)
    intensity, metres = to_grey_and_metres(grey, depth, 1.0 / depth_units_per_m, max_depth_m)
    images, depths, cameras = [intensity], [metres], [np.asarray(camera, dtype=np.float64)]
    while len(images) < levels and min(images[-1].shape) >= 40:
        halved, halved_depth = halve(images[-1], depths[-1])
        images.append(halved)
        depths.append(halved_depth)
        fx, fy, cx, cy = cameras[-1]
        cameras.append(np.array([fx / 2, fy / 2, (cx - 0.5) / 2, (cy - 0.5) / 2]))
    return RgbdFrame(intensity=tuple(images), depth=tuple(depths), camera=tuple(cameras))


def prepare_reference(frame: RgbdFrame) -> RgbdReference:
    """Choose the points of every level, with their planes and gradients."""
    points = []
    for image, depth, camera in zip(frame.intensity, frame.depth, frame.camera, strict=True):
        step = max(1, round(image.shape[1] / POINTS_ACROSS))
        p, n, g, value, sigma = reference_points(image, depth, camera, step)
        points.append(ReferencePoints(points=p, normals=n, gradients=g, intensity=value, sigma_m=sigma))
    return RgbdReference(frame=frame, points=tuple(points))


@kernel
def depth_sigma(z: float) -> float:
    """Standard deviation of a structured-light depth at z metres (Nguyen et al. 2012, eq. 5)."""
    return 0.0012 + 0.0019 * (z - 0.4) ** 2


@kernel
def to_grey_and_metres(
    colour: ByteArray, raw: npt.NDArray[np.uint16], metres_a_unit: float, max_depth: float
) -> tuple[Float32Array, Float32Array]:
    """Grey values (ITU-R BT.601 weights) and depth in metres, zero where there is none or too much of it."""
    height, width, channels = colour.shape
    grey, depth = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for i in range(height):
        for j in range(width):
            if channels >= 3:
                grey[i, j] = 0.299 * colour[i, j, 0] + 0.587 * colour[i, j, 1] + 0.114 * colour[i, j, 2]
            else:
                grey[i, j] = colour[i, j, 0]
            z = raw[i, j] * metres_a_unit
            depth[i, j] = z if z <= max_depth else 0.0
    return grey, depth


@kernel
def halve(image: Float32Array, depth: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Half-size images: the mean of four intensities, and the mean of those of four depths near the nearest one."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    small, small_depth = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for i in range(height):
        for j in range(width):
            small[i, j] = 0.25 * (
                image[2 * i, 2 * j] + image[2 * i, 2 * j + 1] + image[2 * i + 1, 2 * j] + image[2 * i + 1, 2 * j + 1]
            )
            nearest = np.inf
            for a in range(4):
                z = depth[2 * i + a // 2, 2 * j + a % 2]
                if 0.0 < z < nearest:
                    nearest = z
            total, count = 0.0, 0
            for a in range(4):
                z = depth[2 * i + a // 2, 2 * j + a % 2]
                if 0.0 < z <= nearest * (1.0 + JUMP):
                    total += z
                    count += 1
            small_depth[i, j] = total / count if count > 0 else 0.0
    return small, small_depth


@kernel
def fit_inverse_depth(depth: Float32Array, i: int, j: int, radius: int, plane: FloatArray) -> bool:
    """Fit 1/z = a dv + b du + c about pixel (i, j) to the depths of its surface; a plane has linear inverse depth.

    Writes a, b, c into `plane` (3,); False where fewer than half of the window lies on one surface that fits.
    """
    height, width = depth.shape
    w0 = 1.0 / depth[i, j]
    # moments of the offsets and of the inverse depth over the window
    m, mu, mv, muu, muv, mvv, mw, muw, mvw = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    squares = 0.0
    for di in range(-radius, radius + 1, 2):
        for dj in range(-radius, radius + 1, 2):
            r, c = i + di, j + dj
            if r < 0 or c < 0 or r >= height or c >= width:
                continue
            z = depth[r, c]
            if z <= 0.0:
                continue
            w = 1.0 / z - w0
            # a slanted surface may change by a jump at the rim of the window
            if abs(w) > (1.0 + 0.5 * max(abs(di), abs(dj))) * JUMP * w0:
                continue
            m += 1
            mu += dj
            mv += di
            muu += dj * dj
            muv += di * dj
            mvv += di * di
            mw += w
            muw += dj * w
            mvw += di * w
            squares += w * w
    if m < (radius + 1) * (radius + 1) // 2 + 1:
        return False
    a11, a12, a22 = muu - mu * mu / m, muv - mu * mv / m, mvv - mv * mv / m
    b1, b2 = muw - mu * mw / m, mvw - mv * mw / m
    det = a11 * a22 - a12 * a12
    if not det > 1e-3 * (a11 + a22) ** 2:
        return False
    slope_u, slope_v = (a22 * b1 - a12 * b2) / det, (a11 * b2 - a12 * b1) / det
    level = (mw - slope_u * mu - slope_v * mv) / m
    left = squares - mw * mw / m - slope_u * b1 - slope_v * b2
    # residual of the inverse depth against three deviations of the sensor: sigma(1/z) = sigma(z) / z^2
    allowed = 3.0 * (depth_sigma(1.0 / w0) + 0.002 / w0) * w0 * w0
    if max(left, 0.0) / max(m - 3, 1) > allowed * allowed:
        return False
    plane[0], plane[1], plane[2] = slope_v, slope_u, w0 + level
    return True


@kernel
def on_one_surface(depth: Float32Array, i: int, j: int) -> bool:
    """Whether the depth at (i, j) and all eight around it are measured and nearly equal."""
    z = depth[i, j]
    for di in range(-1, 2):
        for dj in range(-1, 2):
            if not abs(depth[i + di, j + dj] - z) < JUMP * z:
                return False
    return True


@kernel
def reference_points(
    image: Float32Array, depth: Float32Array, camera: FloatArray, step: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Choose in each block of `step` x `step` pixels the one of steepest intensity on a surface, else its first one.

    Returns points, normals, gradients (n, 3), intensity and sigma of depth (n,).
    """
    height, width = image.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    room = (height // step + 1) * (width // step + 1)
    points, normals, gradients = np.zeros((room, 3)), np.zeros((room, 3)), np.zeros((room, 3))
    intensity, sigma = np.zeros(room), np.zeros(room)
    plane = np.zeros(3)
    count = 0
    for block_i in range(0, height, step):
        for block_j in range(0, width, step):
            best, row, column = -1.0, -1, -1
            for i in range(max(block_i, 2), min(block_i + step, height - 2)):
                for j in range(max(block_j, 2), min(block_j + step, width - 2)):
                    if depth[i, j] <= 0.0:
                        continue
                    if not on_one_surface(depth, i, j):
                        if best < 0.0:
                            best, row, column = 0.0, i, j
                        continue
                    du, dv = image[i, j + 1] - image[i, j - 1], image[i + 1, j] - image[i - 1, j]
                    steep = 1.0 + du * du + dv * dv
                    if steep > best:
                        best, row, column = steep, i, j
            if row < 0:
                continue
            i, j = row, column
            z = float(depth[i, j])
            if fit_inverse_depth(depth, i, j, PLANE_RADIUS, plane) and plane[2] > 0.0:
                z = 1.0 / plane[2]
                a, b = plane[1], plane[0]
                nx, ny = a * fx, b * fy
                nz = plane[2] + a * (cx - j) + b * (cy - i)
                length = np.sqrt(nx * nx + ny * ny + nz * nz)
                normals[count, 0], normals[count, 1], normals[count, 2] = -nx / length, -ny / length, -nz / length
            elif best <= 0.0:
                continue
            x, y = (j - cx) / fx * z, (i - cy) / fy * z
            points[count, 0], points[count, 1], points[count, 2] = x, y, z
            if best > 0.0:
                # Scharr weights: nearly the same for every direction of an edge
                du = (
                    10.0 * (image[i, j + 1] - image[i, j - 1])
                    + 3.0 * (image[i - 1, j + 1] - image[i - 1, j - 1] + image[i + 1, j + 1] - image[i + 1, j - 1])
                ) / 32.0
                dv = (
                    10.0 * (image[i + 1, j] - image[i - 1, j])
                    + 3.0 * (image[i + 1, j - 1] - image[i - 1, j - 1] + image[i + 1, j + 1] - image[i - 1, j + 1])
                ) / 32.0
                gradients[count, 0], gradients[count, 1] = du * fx / z, dv * fy / z
                gradients[count, 2] = -(du * fx * x + dv * fy * y) / (z * z)
            intensity[count], sigma[count] = image[i, j], depth_sigma(z)
            count += 1
    return points[:count], normals[:count], gradients[:count], intensity[:count], sigma[:count]
