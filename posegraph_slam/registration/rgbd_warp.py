"""What the images of one RGB-D frame say of the points of another at a pose: depths and brightness that differ."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray
from posegraph_slam.jit import kernel

OUT, UNMEASURED, SEEN, OCCLUDED, INVADES = 0, 1, 2, 3, 4
"""What becomes of a reference point in the source frame: not in view, in view without depth, seen on its surface,
hidden behind something nearer, or in space that the source saw free."""

SHIFT_STRIDE = 7
"""Every so many points tell how far the views are apart."""


class Side(NamedTuple):
    """Points of one frame (see `ReferencePoints`) and the images of the other, [fx, fy, cx, cy] its camera."""

    points: FloatArray
    normals: FloatArray
    gradients: FloatArray
    intensity: FloatArray
    sigma: FloatArray
    image: Float32Array
    depth: Float32Array
    camera: FloatArray


@kernel
def into_source(points: FloatArray, k: int, T: FloatArray) -> tuple[float, float, float]:
    """Coordinates of a reference point in the source's camera frame, at T = T_target_source."""
    dx, dy, dz = points[k, 0] - T[0, 3], points[k, 1] - T[1, 3], points[k, 2] - T[2, 3]
    return (
        T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz,
        T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz,
        T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz,
    )


@kernel
def bilinear(image: Float32Array, i: int, j: int, a: float, b: float) -> float:
    """Interpolate between the pixels (i, j) and (i + 1, j + 1), `a` of the way along the row and `b` down."""
    upper = (1 - a) * image[i, j] + a * image[i, j + 1]
    return float((1 - b) * upper + b * ((1 - a) * image[i + 1, j] + a * image[i + 1, j + 1]))


@kernel
def surface_at(depth: Float32Array, i: int, j: int, a: float, b: float, gate: float) -> tuple[float, float]:
    """Depth between four pixels, 0 where it is not known or none of one surface, and the farthest of the four."""
    d00, d01, d10, d11 = depth[i, j], depth[i, j + 1], depth[i + 1, j], depth[i + 1, j + 1]
    low, high = min(min(d00, d01), min(d10, d11)), max(max(d00, d01), max(d10, d11))
    if low <= 0.0:
        return 0.0, 0.0
    if high - low >= 0.03 * low + 0.5 * gate:
        return 0.0, float(high)
    return bilinear(depth, i, j, a, b), float(high)


@kernel
def warp(
    side: Side, T: FloatArray, back: bool, offsets: FloatArray, gate: float, noise: float, across: FloatArray,
    brightness: FloatArray, spread: FloatArray, moved: FloatArray, levers: FloatArray, state: ByteArray,
) -> None:  # fmt: skip
    """Compare reference points with the source frame at T = T_target_source.

    The depth of a structured-light sensor errs smoothly over the image, alike in disparity, which is inverse depth, for
    near and far (Herrera et al. 2012, Teichman et al. 2013). Between two frames this is taken for a + b x/z + c y/z on
    the target's rays, source less target, with `offsets` (3,) for a, b, c. `back` says that `side` is the other way
    round: its points are the source's and its images the target's.

    Writes for every point its distance `across` (n,) of the source's surface from the plane of the reference, in
    deviations of depth (NaN where unknown) with its derivatives `levers` (n, 3) by the offsets, the difference of
    `brightness` (n,) (NaN where unknown), the surface point `moved` (n, 3) in the target frame, and its `state` (n,).
    Depths further apart than the larger of `gate` and six deviations are no match. `spread` (n,) is the deviation of
    the brightness over `noise`, that of an exact depth: an error of depth shifts the point along its epipolar line, and
    changes its brightness by the slope there (Engel et al. 2014, eq. 13).
    """
    points, normals, gradients, sigma, image = side.points, side.normals, side.gradients, side.sigma, side.image
    fx, fy, cx, cy = side.camera[0], side.camera[1], side.camera[2], side.camera[3]
    height, width = image.shape
    for k in range(len(points)):
        across[k], brightness[k], spread[k], state[k] = np.nan, np.nan, 1.0, OUT
        x, y, z = into_source(points, k, T)
        if z < 0.05:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (1.0 <= u < width - 2.0 and 1.0 <= v < height - 2.0):
            continue
        j, i = int(u), int(v)
        a, b = u - j, v - i
        state[k] = UNMEASURED
        allowed = max(gate, 6.0 * sigma[k])
        measured, high = surface_at(side.depth, i, j, a, b, gate)
        if measured > 0.0:
            if back:
                ray_x, ray_y, sign = (u - cx) / fx, (v - cy) / fy, -1.0
            else:
                ray_x, ray_y, sign = points[k, 0] / points[k, 2], points[k, 1] / points[k, 2], 1.0
            offset = sign * (offsets[0] + offsets[1] * ray_x + offsets[2] * ray_y)
            measured = 1.0 / max(1.0 / measured - offset, 0.02)
            if measured < z - allowed:
                state[k] = OCCLUDED
                continue
            if measured > z + allowed:
                state[k] = INVADES
                continue
            state[k] = SEEN
            sx, sy = (u - cx) / fx * measured, (v - cy) / fy * measured
            gap, lever = 0.0, 0.0
            for r in range(3):
                moved[k, r] = T[r, 0] * sx + T[r, 1] * sy + T[r, 2] * measured + T[r, 3]
                gap += normals[k, r] * (moved[k, r] - points[k, r])
                lever += normals[k, r] * (moved[k, r] - T[r, 3])
            if normals[k, 2] != 0.0:
                across[k] = gap / sigma[k]
                lever *= sign * measured / sigma[k]
                levers[k, 0], levers[k, 1], levers[k, 2] = lever, lever * ray_x, lever * ray_y
        elif high > 0.0:  # the edge of an object: compare with its nearer side only to tell what is hidden
            if z > high + allowed:
                state[k] = OCCLUDED
            continue
        if gradients[k, 0] != 0.0 or gradients[k, 1] != 0.0:
            brightness[k] = bilinear(image, i, j, a, b) - side.intensity[k]
            slope = 0.0
            for r in range(3):  # a point that moves along its ray is seen to move as the other camera does
                slope += gradients[k, r] * T[r, 3]
            spread[k] = np.sqrt(1.0 + (slope / points[k, 2] * sigma[k] / noise) ** 2)


@kernel
def view_shift(side: Side, T: FloatArray) -> float:
    """Shift of the points from one image to the other at T, root mean square, as a share of half the image's width."""
    fx, fy, cx, cy = side.camera[0], side.camera[1], side.camera[2], side.camera[3]
    height, width = side.image.shape
    total, count = 0.0, 0
    for k in range(0, len(side.points), SHIFT_STRIDE):
        x, y, z = into_source(side.points, k, T)
        if z < 0.05:
            continue
        du, dv = fx * x / z, fy * y / z
        if 0.0 <= du + cx < width and 0.0 <= dv + cy < height:
            pz = side.points[k, 2]
            total += (du - fx * side.points[k, 0] / pz) ** 2 + (dv - fy * side.points[k, 1] / pz) ** 2
            count += 1
    return float(np.sqrt(total / max(count, 1)) / (0.5 * width))
