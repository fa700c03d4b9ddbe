"""The floor's texture: tiles in the corridors and a carpet of its own colour in each room."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import ByteArray, FloatArray, IntArray, read_only
from posegraph_slam.datasets.simulation.settings import WorldSettings
from posegraph_slam.datasets.simulation.world import World

TILE_M = 0.5
STRIPE_M = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloorTexture:
    """RGB colours (H, W, 3) of floor cells: row = +y, column = +x, `origin_m` (2,) the corner of cell (0, 0)."""

    colours: ByteArray
    origin_m: FloatArray
    resolution_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "colours", read_only(self.colours, np.uint8))
        object.__setattr__(self, "origin_m", read_only(self.origin_m))

    def colour_at(self, points_m: FloatArray) -> ByteArray:
        """Return the RGB colour (n, 3) of the cell under each point (n, 2); points outside take the nearest cell."""
        cells = np.floor((points_m - self.origin_m) / self.resolution_m).astype(np.int64)
        height, width = self.colours.shape[:2]
        colours = self.colours[np.clip(cells[:, 1], 0, height - 1), np.clip(cells[:, 0], 0, width - 1)]
        return np.asarray(colours, dtype=np.uint8)


def build_floor(world: World, settings: WorldSettings, resolution_m: float, rng: np.random.Generator) -> FloorTexture:
    """Paint the floor of `world` in cells of `resolution_m`; `rng` draws the colour of each room's carpet."""
    size = np.ceil((world.upper_m - world.lower_m) / resolution_m).astype(int)
    x = world.lower_m[0] + (np.arange(size[0]) + 0.5) * resolution_m
    y = world.lower_m[1] + (np.arange(size[1]) + 0.5) * resolution_m
    column, row = _rooms_along_x(world, settings, x), _rooms_along_y(world, settings, y)
    checks = (np.floor(y / TILE_M).astype(int)[:, None] + np.floor(x / TILE_M).astype(int)[None, :]) % 2
    tiles = np.array([[146, 142, 132], [108, 106, 100]], dtype=np.uint8)[checks]
    rooms = int(row.max()) + 1, int(column.max()) + 1
    carpets = rng.integers(50, 210, size=(*rooms, 3))
    stripes = np.where(np.floor(y / STRIPE_M).astype(int) % 2 == 0, 0, 30)
    carpet = (carpets[np.maximum(row, 0)[:, None], np.maximum(column, 0)[None, :]] + stripes[:, None, None]).astype(
        np.uint8
    )
    inside = (row >= 0)[:, None] & (column >= 0)[None, :]
    return FloorTexture(
        colours=np.where(inside[..., None], carpet, tiles), origin_m=world.lower_m, resolution_m=resolution_m
    )


def _rooms_along_x(world: World, settings: WorldSettings, x: FloatArray) -> IntArray:
    """Number of the room column at each x, -1 in a corridor."""
    start = world.plan.corridor_x[:-1] + settings.corridor_width_m / 2
    return _intervals(x, start, settings.rooms_across, settings.room_width_m)


def _rooms_along_y(world: World, settings: WorldSettings, y: FloatArray) -> IntArray:
    """Number of the room row at each y, -1 in a corridor."""
    return _intervals(y, world.plan.corridor_y[:-1] + settings.corridor_width_m / 2, 2, settings.room_depth_m)


def _intervals(values: FloatArray, starts: FloatArray, count: int, length: float) -> IntArray:
    """Number the `count` intervals of `length` after each start; -1 outside of all."""
    block = np.searchsorted(starts, values, side="right") - 1
    offset = np.floor((values - starts[np.maximum(block, 0)]) / length).astype(np.int64)
    inside = (block >= 0) & (offset >= 0) & (offset < count)
    return np.asarray(np.where(inside, block * count + offset, -1), dtype=np.int64)
