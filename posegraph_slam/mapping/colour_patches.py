"""The colours that single frames give to cells of the texture map, kept in a file until exposures are known."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import IO, Protocol, Self

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray, read_only
from posegraph_slam.mapping.colouring import add_colours, add_patches
from posegraph_slam.mapping.depth_camera import DepthView, cell_coordinates, depth_image
from posegraph_slam.mapping.depth_frames import DepthFrames, Unreadable, each_pair
from posegraph_slam.mapping.exposure import ExposureSamples
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.sensors import DisparityCalibration

PATCH = np.dtype([("frame", "<i4"), ("cell", "<i4"), ("colour", "<u2", (3,)), ("weights", "<u4", (2,)), ("sound", "?")])
"""One cell in one frame, 23 bytes: colour in 1 / 256, weights of floor and of the rest, and whether it is whole and not
saturated, so that it may tell the exposure."""

SAMPLE_SPACING_M = 0.1
"""Exposures are compared in one cell every so often: about 700 a frame, 20 kB."""
SAMPLE_RANGE = 4.0, 250.0
"""Colours with a channel outside are too dark or too near saturation to tell the exposure."""


class Labels(Protocol):
    """Tells which pixels of a frame are floor; `farthest_m` is the largest depth that gets a label."""

    @property
    def farthest_m(self) -> float: ...

    def labels(self, depth_m: Float32Array, view: DepthView, T_map_camera: FloatArray, number: int) -> ByteArray: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Painter:
    """What turns frames into patches: the grid, the camera, how floor is told from the rest, and how pixels weigh."""

    geometry: GridGeometry
    calibration: DisparityCalibration
    labels: Labels
    uniform: bool = False
    stride: int = 1
    min_pixels: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patches:
    """Records of type `PATCH` (n,): cells by their number in the grid, frames by their place among the usable ones."""

    records: npt.NDArray[np.void]
    unreadable: Unreadable

    def __post_init__(self) -> None:
        object.__setattr__(self, "records", read_only(self.records, PATCH))


def paint(part: tuple[int, DepthFrames], *, painter: Painter) -> Patches:
    """Return the patches of some frames; the first of them has the place `part[0]` among the usable ones."""
    first, piece = part
    unreadable: list[str] = []
    found = [np.empty(0, dtype=PATCH)]
    for k, disparity, colour in each_pair(piece, unreadable):
        found.append(_frame_patches(piece, k, disparity, colour, painter=painter))
        found[-1]["frame"] = first + k
    return Patches(
        records=np.concatenate(found),
        unreadable=Unreadable(count=len(unreadable), first=unreadable[0] if unreadable else ""),
    )


def _frame_patches(
    piece: DepthFrames, k: int, disparity: Float32Array, colour: ByteArray, *, painter: Painter
) -> npt.NDArray[np.void]:
    """Patches of frame k of a piece."""
    grid, calibration, T_map_camera = painter.geometry, painter.calibration, piece.T_map_camera[k]
    depth, view = depth_image(disparity, calibration), DepthView.of(calibration, disparity.shape)
    labels = painter.labels.labels(depth, view, T_map_camera, piece.number[k])
    cells = cell_coordinates(view, T_map_camera, grid.cells_from_map)
    corner, size = cells.window_on(grid.shape, painter.labels.farthest_m)
    sums = np.zeros((*size, 7), dtype=np.int64)
    assert piece.T_map_colour is not None
    seen = view.coordinates((np.linalg.inv(piece.T_map_colour[k]) @ T_map_camera)[:3])
    pinhole = calibration.focal_px, calibration.centre_row_px, calibration.centre_column_px
    add_colours(
        depth, labels, colour, cells, seen, pinhole, grid.resolution_m, painter.uniform, painter.stride, corner, sums
    )
    r, c = np.nonzero((sums[..., 6] >= painter.min_pixels) & sums[..., 3:5].any(axis=2))
    sound = _inside(sums[..., 3] > sums[..., 4])[r, c]
    sums = sums[r, c]
    patches = np.empty(len(r), dtype=PATCH)
    patches["cell"] = (r + corner[0]) * grid.shape[1] + c + corner[1]
    patches["colour"] = np.rint(256 * sums[:, :3] / np.maximum(sums[:, 3:4], 1))
    patches["weights"] = np.minimum(sums[:, 3:5], np.iinfo(np.uint32).max)
    patches["sound"] = sound & (sums[:, 5] == 0)
    return patches


def _inside(cells: BoolArray) -> BoolArray:
    """Cells (R, C) whose eight neighbours are set too: none of them is seen in part only, at the border of a frame."""
    padded = np.pad(cells, 1)
    across = padded[:, :-2] & padded[:, 1:-1] & padded[:, 2:]
    return np.asarray(across[:-2] & across[1:-1] & across[2:])


def fuse(patches: Patches, gains: FloatArray, sums: IntArray) -> None:
    """Add patches to `sums` (R, C, 5) [red, green, blue, weight of floor, of the rest], divided by gains (F, 3)."""
    records = patches.records
    frame, cell, colour, weights = (
        np.ascontiguousarray(records[name], dtype=np.int64) for name in ("frame", "cell", "colour", "weights")
    )
    add_patches(frame, cell, colour, weights, gains, sums.reshape(-1, 5))


def exposure_samples(patches: Patches, geometry: GridGeometry) -> ExposureSamples:
    """Return the colours that tell exposures: whole cells of floor on a lattice, neither dark nor saturated."""
    spacing = max(1, round(SAMPLE_SPACING_M / geometry.resolution_m))
    records = patches.records
    row, column = np.divmod(records["cell"], geometry.shape[1])
    colour = records["colour"] / 256.0
    low, high = SAMPLE_RANGE
    use = (row % spacing == 0) & (column % spacing == 0) & records["sound"]
    use &= (colour.min(axis=1) >= low) & (colour.max(axis=1) <= high)
    return ExposureSamples(frame=records["frame"][use], cell=records["cell"][use], colour=colour[use])


class PatchStore:
    """Keeps patches in a temporary file, about 0.1 MB a frame, and gives them back in order; used with `with`."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._sizes: list[int] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()

    def append(self, patches: Patches) -> None:
        """Write patches behind those that are there."""
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="posegraph_slam-")  # noqa: SIM115 - closed on leaving
        self._file.write(patches.records.tobytes())
        self._sizes.append(len(patches.records))

    def __iter__(self) -> Iterator[Patches]:
        if self._file is None:
            return
        self._file.seek(0)
        for size in self._sizes:
            records = np.frombuffer(self._file.read(size * PATCH.itemsize), dtype=PATCH)
            yield Patches(records=records, unreadable=Unreadable())
