"""A coloured cloud fused from RGB-D frames: the mean of all points and colours in every voxel, in bounded memory.

Sums are whole numbers, so that the cloud depends neither on the order of the frames nor on the workers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from pydantic import Field

from posegraph_slam.arrays import ByteArray, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress, split_range
from posegraph_slam.jit import kernel
from posegraph_slam.settings import Settings

FRAMES_A_PIECE = 16
"""Frames that a worker fuses before its sums are added to the cloud."""
AXIS_BITS = 20
HALF_RANGE = 1 << (AXIS_BITS - 1)
"""Voxels on either side of the origin along an axis: 5 km of centimetres."""
SUBDIVISIONS = 1 << 10
"""Positions within a voxel are rounded to this share of it before they are summed."""
SUMS = 8
"""Columns of the sums: x, y, z, red, green, blue, weight, count."""

FIRST_SLOTS = 1 << 16

ColourDepth = tuple[ByteArray, npt.NDArray[np.uint16]]
ImageSource = Callable[[int], ColourDepth]
"""Gives the colour (h, w, 3) and raw depth (h, w) of frame k."""


class ColourCloudSettings(Settings):
    """How frames are fused into a coloured cloud."""

    voxel_m: float = Field(default=0.01, gt=0, le=1)
    """Side of a voxel; each gives one point."""
    max_depth_m: float = Field(default=4.0, gt=0)
    """Points further away are left out: depth errs by 2.6 cm there, and by the square beyond."""
    points_min: int = Field(default=3, ge=1)
    """Points that a voxel needs: single ones are mostly noise at the edges of objects."""
    voxels_max: int = Field(default=8_000_000, ge=1000)
    """Most voxels in memory; where more would be needed, their side is doubled."""
    frame_stride: int = Field(default=1, ge=1)
    """Fuse every n-th frame."""
    slant_min: float = Field(default=0.2, ge=0, lt=1)
    """Surfaces whose normal makes a smaller cosine than this with the ray are left out: their depth is a guess."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ColourCloud:
    """Points (n, 3) in the map frame, RGB `colours` (n, 3), and how many measurements (n,) each is the mean of.

    `voxel_m` is the side of a voxel in the end, larger than asked for where memory was short.
    """

    points: FloatArray
    colours: ByteArray
    counts: IntArray
    voxel_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", read_only(self.points))
        object.__setattr__(self, "colours", read_only(self.colours, np.uint8))
        object.__setattr__(self, "counts", read_only(self.counts, np.int64))

    def __len__(self) -> int:
        return int(self.points.shape[0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Voxels:
    """Sorted keys (m,), sums (m, 8) of the voxels, and how often their side was doubled."""

    keys: IntArray
    sums: IntArray
    doublings: int


def fuse_cloud(
    images: ImageSource,
    T_map_camera: FloatArray,
    camera: FloatArray,
    settings: ColourCloudSettings,
    *,
    depth_units_per_m: float,
    frames: IntArray | None = None,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
) -> ColourCloud:
    """Fuse the frames taken at poses (N, 4, 4) by a camera [fx, fy, cx, cy] into one cloud.

    `frames` (m,) are the numbers of those to fuse, all where None. Pixels at jumps of depth and on surfaces seen at a
    grazing angle are left out; the rest counts by the inverse of its depth's variance. Raises InputError where no voxel
    gets enough points.
    """
    executor = executor or SerialExecutor()
    chosen = (np.arange(len(T_map_camera)) if frames is None else frames)[:: settings.frame_stride]
    work = [chosen[a:b] for a, b in split_range(len(chosen), FRAMES_A_PIECE)]
    fuse = partial(
        _fuse_piece, images=images, poses=T_map_camera, camera=camera, settings=settings, units=depth_units_per_m
    )
    cloud = _Voxels(keys=np.zeros(0, np.int64), sums=np.zeros((0, SUMS), np.int64), doublings=0)
    step = max(executor.workers, 1)
    for start in range(0, len(work), step):  # as many pieces at a time as there are workers: memory stays bounded
        for part in executor.map(fuse, work[start : start + step]):
            cloud = _merged(cloud, part, settings.voxels_max)
        progress("fusing", min(start + step, len(work)), len(work))
    return _cloud_of(cloud, settings)


def _fuse_piece(
    frames: IntArray, images: ImageSource, poses: FloatArray, camera: FloatArray, settings: ColourCloudSettings,
    units: float,
) -> _Voxels:  # fmt: skip
    """Sum up some frames."""
    slots, sums = np.full(FIRST_SLOTS, -1, dtype=np.int64), np.zeros((FIRST_SLOTS, SUMS), dtype=np.int64)
    for k in frames.tolist():
        colour, depth = images(k)
        slots, sums = add_frame(
            np.ascontiguousarray(colour), depth, 1.0 / units, poses[k], camera, settings.voxel_m,
            settings.max_depth_m, settings.slant_min, slots, sums,
        )  # fmt: skip
    used = np.flatnonzero(slots >= 0)
    used = used[np.argsort(slots[used])]
    return _Voxels(keys=slots[used], sums=sums[used], doublings=0)


def _summed(keys: IntArray, sums: IntArray) -> tuple[IntArray, IntArray]:
    """Add up the rows of equal keys; keys come out sorted."""
    if len(keys) == 0:
        return keys, sums
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    first = np.flatnonzero(np.concatenate([[True], np.diff(ordered) != 0]))
    return ordered[first], np.add.reduceat(sums[order], first, axis=0)


def _merged(cloud: _Voxels, part: _Voxels, most: int) -> _Voxels:
    """Add a part to the cloud, whose sums change in place; double the side of all voxels until they are few enough.

    Voxels that both know are added to, the others put between: the cloud is copied once, and never sorted again.
    """
    while part.doublings < cloud.doublings:
        part = _doubled(part)
    place = np.searchsorted(cloud.keys, part.keys)
    known = place < len(cloud.keys)
    known[known] = cloud.keys[place[known]] == part.keys[known]
    cloud.sums[place[known]] += part.sums[known]
    keys = np.insert(cloud.keys, place[~known], part.keys[~known])
    sums = np.insert(cloud.sums, place[~known], part.sums[~known], axis=0)
    merged = _Voxels(keys=keys, sums=sums, doublings=cloud.doublings)
    while len(merged.keys) > most and merged.doublings < AXIS_BITS - 1:
        merged = _doubled(merged)
    return merged


def _doubled(voxels: _Voxels) -> _Voxels:
    """Merge voxels two by two along each axis; sums are kept in absolute places, so that nothing is lost."""
    mask = (1 << AXIS_BITS) - 1
    key = np.zeros_like(voxels.keys)
    for shift in (2 * AXIS_BITS, AXIS_BITS, 0):
        part = ((voxels.keys >> shift) & mask) - HALF_RANGE
        key |= ((part >> 1) + HALF_RANGE) << shift
    keys, sums = _summed(key, voxels.sums)
    return _Voxels(keys=keys, sums=sums, doublings=voxels.doublings + 1)


def _cloud_of(voxels: _Voxels, settings: ColourCloudSettings) -> ColourCloud:
    enough = voxels.sums[:, 7] >= settings.points_min
    if not enough.any():
        raise InputError(
            "fused cloud", "no voxel holds enough points", "check max_depth_m, voxel_m and points_min of rgbd.cloud"
        )
    sums = voxels.sums[enough].astype(np.float64)
    weight = sums[:, 6:7]
    return ColourCloud(
        points=sums[:, :3] / weight * (settings.voxel_m / SUBDIVISIONS),
        colours=np.clip(np.rint(sums[:, 3:6] / weight), 0, 255).astype(np.uint8),
        counts=voxels.sums[enough, 7],
        voxel_m=settings.voxel_m * 2.0**voxels.doublings,
    )


@kernel
def add_frame(
    colour: ByteArray, raw: npt.NDArray[np.uint16], metres_a_unit: float, T: FloatArray, camera: FloatArray,
    voxel: float, farthest: float, slant_min: float, slots: IntArray, sums: IntArray,
) -> tuple[IntArray, IntArray]:  # fmt: skip
    """Add every usable pixel of a frame to the weighted sums (h, 8) of its voxel, whose key is in `slots` (h,).

    Returns both, larger where they would have been more than half full.
    """
    height, width = raw.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    count = 0
    for slot in range(len(slots)):
        count += slots[slot] >= 0
    point = np.zeros(3)
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            z = raw[i, j] * metres_a_unit
            if z <= 0.0 or z > farthest:
                continue
            left, right = raw[i, j - 1] * metres_a_unit, raw[i, j + 1] * metres_a_unit
            up, down = raw[i - 1, j] * metres_a_unit, raw[i + 1, j] * metres_a_unit
            if left <= 0.0 or right <= 0.0 or up <= 0.0 or down <= 0.0:
                continue
            x, y = (j - cx) / fx, (i - cy) / fy
            # slope of the surface z(u, v), against the noise of one step of the sensor
            noise = 0.0012 + 0.0019 * (z - 0.4) ** 2
            du, dv = 0.5 * (right - left) * fx / z, 0.5 * (down - up) * fy / z
            bend = max(abs(right + left - 2.0 * z), abs(up + down - 2.0 * z))
            if bend > 0.01 * z + 4.0 * noise:
                continue
            # normal (-du, -dv, 1 + x du + y dv) of the surface against the ray (x, y, 1)
            tilt = 1.0 + x * du + y * dv
            length = np.sqrt(du * du + dv * dv + tilt * tilt)
            if length * np.sqrt(x * x + y * y + 1.0) * slant_min > 1.0 + 4.0 * noise * fx / z:
                continue
            inside = True
            key = np.int64(0)
            for a in range(3):
                point[a] = (T[a, 0] * x * z + T[a, 1] * y * z + T[a, 2] * z + T[a, 3]) / voxel
                cell = np.int64(np.floor(point[a]))
                if not -HALF_RANGE <= cell < HALF_RANGE:
                    inside = False
                    break
                key = (key << AXIS_BITS) | (cell + HALF_RANGE)
            if not inside:
                continue
            weight = max(np.int64(1), np.int64(np.rint(1024.0 * (0.0012 / noise) ** 2)))
            if 2 * count >= len(slots):
                slots, sums = doubled_table(slots, sums)
            slot = slot_of_key(int(key), slots)
            if slots[slot] < 0:
                slots[slot] = key
                count += 1
            for a in range(3):
                sums[slot, a] += weight * np.int64(np.rint(point[a] * SUBDIVISIONS))
                sums[slot, 3 + a] += weight * colour[i, j, a]
            sums[slot, 6] += weight
            sums[slot, 7] += 1
    return slots, sums


@kernel
def slot_of_key(key: int, slots: IntArray) -> int:
    """Slot that holds a key, or the free one (-1) where it belongs; the size of the table is a power of two."""
    slot = ((key * np.int64(-7046029254386353131)) >> np.int64(20)) & np.int64(len(slots) - 1)
    while slots[slot] >= 0 and slots[slot] != key:
        slot = (slot + 1) & (len(slots) - 1)
    return int(slot)


@kernel
def doubled_table(slots: IntArray, sums: IntArray) -> tuple[IntArray, IntArray]:
    """The same table with twice the slots."""
    larger, moved = np.full(2 * len(slots), -1, np.int64), np.zeros((2 * len(slots), SUMS), np.int64)
    for slot in range(len(slots)):
        if slots[slot] >= 0:
            place = slot_of_key(int(slots[slot]), larger)
            larger[place] = slots[slot]
            moved[place] = sums[slot]
    return larger, moved
