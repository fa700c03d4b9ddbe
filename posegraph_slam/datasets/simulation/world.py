"""The indoor world: blocks of rooms in a net of corridors, with doors, boxes, round pillars and tables.

On flat ground every obstacle stands from the floor to above all sensors, so that the plan view is the whole truth; on
terrain with ramps clutter has a height. The origin of the world frame is where the robot starts, on the lowest
corridor, heading along +x.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, ByteArray, FloatArray, read_only
from posegraph_slam.datasets.simulation.settings import WorldSettings
from posegraph_slam.datasets.simulation.terrain import Terrain, build_terrain

WALL_M = 0.12
"""Thickness of a wall."""
CLEARANCE_M = 0.58
"""No clutter nearer than this to a centre line that the robot may drive."""
TABLE_LEG_M = 0.03
WALL_COLOUR = (198, 196, 186)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloorPlan:
    """Centre lines of the corridors and doors, the net that the robot drives on.

    `corridor_x` (across + 1,) and `corridor_y` (up + 1,) are the centre lines; `door_x` (across, up, rooms) the doors
    of each pair of rooms, `passable` of the same shape whether a door joins the two rooms.
    """

    corridor_x: FloatArray
    corridor_y: FloatArray
    door_x: FloatArray
    passable: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """Obstacles in plan view: `segments` (S, 4) [xa, ya, xb, yb] and `circles` (C, 3) [x, y, radius], metres.

    `colours` (S + C, 3) are their RGB colours, segments first. `lower_m` and `upper_m` (2,) bound the world. `terrain`
    is None where the ground is flat.
    """

    segments: FloatArray
    circles: FloatArray
    colours: ByteArray
    lower_m: FloatArray
    upper_m: FloatArray
    plan: FloorPlan
    terrain: Terrain | None = None

    def __post_init__(self) -> None:
        for name in ("segments", "circles", "lower_m", "upper_m"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "colours", read_only(self.colours, np.uint8))


class _Obstacles:
    """Collects boxes [x, y, half x, half y, turn] and circles with their colours while a world is built."""

    def __init__(self) -> None:
        self.boxes: list[tuple[float, float, float, float, float]] = []
        self.circles: list[tuple[float, float, float]] = []
        self.box_colours: list[tuple[int, int, int]] = []
        self.circle_colours: list[tuple[int, int, int]] = []

    def box(self, x: float, y: float, half: tuple[float, float], colour: tuple[int, int, int], turn: float = 0) -> None:
        self.boxes.append((x, y, *half, turn))
        self.box_colours.append(colour)

    def circle(self, x: float, y: float, radius: float, colour: tuple[int, int, int]) -> None:
        self.circles.append((x, y, radius))
        self.circle_colours.append(colour)

    def wall_along_x(self, y: float, ends: tuple[float, float], doors: FloatArray, door_width: float) -> None:
        """Wall at `y` between the two ends of x, open at each door; it reaches half a thickness past its ends."""
        gaps = np.sort(np.asarray(doors))
        starts = np.concatenate([[ends[0] - WALL_M / 2], gaps + door_width / 2])
        stops = np.concatenate([gaps - door_width / 2, [ends[1] + WALL_M / 2]])
        for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
            self.box((start + stop) / 2, y, ((stop - start) / 2, WALL_M / 2), WALL_COLOUR)

    def wall_along_y(self, x: float, ends: tuple[float, float]) -> None:
        self.box(x, (ends[0] + ends[1]) / 2, (WALL_M / 2, (ends[1] - ends[0] + WALL_M) / 2), WALL_COLOUR)

    def segments(self) -> FloatArray:
        """Outlines (4 boxes, 4) of all boxes."""
        boxes = np.asarray(self.boxes).reshape(-1, 5)
        c, s = np.cos(boxes[:, 4, None]), np.sin(boxes[:, 4, None])
        u = boxes[:, 2, None] * np.array([-1.0, 1.0, 1.0, -1.0])
        v = boxes[:, 3, None] * np.array([-1.0, -1.0, 1.0, 1.0])
        corners = np.stack([boxes[:, 0, None] + c * u - s * v, boxes[:, 1, None] + s * u + c * v], axis=-1)
        return np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 4)

    def colours(self) -> ByteArray:
        """Colours (S + C, 3); the four sides of a box differ a little, as under a lamp."""
        boxes = np.asarray(self.box_colours, dtype=np.float64).reshape(-1, 1, 3)
        shades = np.array([0.80, 1.0, 0.88, 0.94])[None, :, None]
        circles = np.asarray(self.circle_colours, dtype=np.float64).reshape(-1, 3)
        return np.concatenate([(boxes * shades).reshape(-1, 3), circles]).astype(np.uint8)


def build_world(settings: WorldSettings, rng: np.random.Generator) -> World:
    """Build the floor: walls with doors around blocks two rooms deep, then clutter beside the driven lines.

    The origin is moved to the start of the drive, the first door on the lowest corridor. `rng` draws the places of
    the doors, which rooms can be crossed, and the clutter.
    """
    plan = _draw_plan(settings, rng)
    obstacles = _Obstacles()
    _add_walls(obstacles, plan, settings)
    _add_room_clutter(obstacles, plan, settings, rng)
    _add_corridor_clutter(obstacles, plan, settings, rng)
    margin = settings.corridor_width_m / 2 + WALL_M
    lower = np.array([plan.corridor_x[0], plan.corridor_y[0]]) - margin
    upper = np.array([plan.corridor_x[-1], plan.corridor_y[-1]]) + margin
    return World(
        segments=obstacles.segments(),
        circles=np.asarray(obstacles.circles).reshape(-1, 3),
        colours=obstacles.colours(),
        lower_m=lower,
        upper_m=upper,
        plan=plan,
        terrain=_draw_terrain(obstacles, plan, settings, rng) if settings.kind == "ramps" else None,
    )


def _draw_terrain(obstacles: _Obstacles, plan: FloorPlan, settings: WorldSettings, rng: np.random.Generator) -> Terrain:
    """Put the corridors on levels, and give clutter a height; walls reach the ceiling."""
    boxes = np.asarray(obstacles.boxes).reshape(-1, 5)
    wall = np.array([colour == WALL_COLOUR for colour in obstacles.box_colours])
    ramps = settings.ramps
    standing = rng.uniform(ramps.clutter_min_m, ramps.clutter_max_m, size=len(boxes) + len(obstacles.circles))
    standing[: len(boxes)][wall] = np.inf
    sides = np.repeat(np.arange(len(boxes)), 4)
    rows = np.concatenate([sides, np.arange(len(boxes), len(standing))])
    places = np.concatenate([boxes[:, :2], np.asarray(obstacles.circles).reshape(-1, 3)[:, :2]])
    return build_terrain(
        settings,
        corridor_x=plan.corridor_x,
        corridor_y=plan.corridor_y,
        obstacles=places[rows],
        standing=standing[rows],
        rng=rng,
    )


def _draw_plan(settings: WorldSettings, rng: np.random.Generator) -> FloorPlan:
    """Place the corridors, draw the doors, and move the origin to the first door of the lowest corridor."""
    across, up, rooms = settings.blocks_across, settings.blocks_up, settings.rooms_across
    x: FloatArray = np.arange(across + 1, dtype=np.float64) * (
        rooms * settings.room_width_m + settings.corridor_width_m
    )
    y: FloatArray = np.arange(up + 1, dtype=np.float64) * (2 * settings.room_depth_m + settings.corridor_width_m)
    free = max(settings.room_width_m / 2 - settings.door_width_m / 2 - 0.35, 0.0)
    centres = x[:-1, None, None] + settings.corridor_width_m / 2 + (np.arange(rooms) + 0.5) * settings.room_width_m
    doors = centres + rng.uniform(-free, free, size=(across, up, rooms))
    # rooms on two levels have no door between them
    passable = rng.random(doors.shape) < (settings.passable_fraction if settings.kind == "flat" else 0.0)
    return FloorPlan(corridor_x=x - doors[0, 0, 0], corridor_y=y, door_x=doors - doors[0, 0, 0], passable=passable)


def _add_walls(obstacles: _Obstacles, plan: FloorPlan, settings: WorldSettings) -> None:
    """Outer walls, the four walls of each block with its doors, and the walls between its rooms."""
    half, depth, width = settings.corridor_width_m / 2, settings.room_depth_m, settings.room_width_m
    left, right = float(plan.corridor_x[0]) - half, float(plan.corridor_x[-1]) + half
    bottom, top = float(plan.corridor_y[0]) - half, float(plan.corridor_y[-1]) + half
    for y in (bottom, top):
        obstacles.wall_along_x(y, (left, right), np.empty(0), settings.door_width_m)
    for x in (left, right):
        obstacles.wall_along_y(x, (bottom, top))
    for a, b in np.ndindex(plan.door_x.shape[:2]):
        x0, y0 = float(plan.corridor_x[a]) + half, float(plan.corridor_y[b]) + half
        ends = (x0, x0 + settings.rooms_across * width)
        doors, inner = plan.door_x[a, b], plan.door_x[a, b][plan.passable[a, b]]
        for y, openings in ((y0, doors), (y0 + depth, inner), (y0 + 2 * depth, doors)):
            obstacles.wall_along_x(y, ends, openings, settings.door_width_m)
        for k in range(settings.rooms_across + 1):
            obstacles.wall_along_y(x0 + k * width, (y0, y0 + 2 * depth))


def _add_room_clutter(
    obstacles: _Obstacles, plan: FloorPlan, settings: WorldSettings, rng: np.random.Generator
) -> None:
    """Put boxes, pillars and tables into every room, clear of the line through its doors."""
    half, depth, width = settings.corridor_width_m / 2, settings.room_depth_m, settings.room_width_m
    for a, b, k, row in np.ndindex(*plan.door_x.shape, 2):
        x0 = float(plan.corridor_x[a]) + half + k * width
        y0 = float(plan.corridor_y[b]) + half + row * depth
        line_x = float(plan.door_x[a, b, k]) if plan.passable[a, b, k] else np.inf
        for _ in range(rng.poisson(3.0 * settings.clutter)):
            _add_item(obstacles, (x0, y0, x0 + width, y0 + depth), line_x, rng)


def _add_item(
    obstacles: _Obstacles, room: tuple[float, float, float, float], line_x: float, rng: np.random.Generator
) -> None:
    """Put a drawn box, pillar or table into the room, clear of the line at `line_x` and of the walls, if one of
    twenty drawn places is free."""
    kind, turn = int(rng.integers(3)), rng.uniform(-0.6, 0.6)
    colour, half = _draw_colour(rng), (rng.uniform(0.12, 0.3), rng.uniform(0.12, 0.3))
    radius = (float(np.hypot(*half)), half[0], 1.5 * float(np.hypot(*half)) + TABLE_LEG_M)[kind]
    x, y = rng.uniform(room[0], room[2], size=20), rng.uniform(room[1], room[3], size=20)
    from_wall = np.min([x - room[0], room[2] - x, y - room[1], room[3] - y], axis=0)
    free = np.flatnonzero((np.abs(x - line_x) > CLEARANCE_M + radius) & (from_wall > WALL_M + radius))
    if len(free) == 0:
        return
    px, py = float(x[free[0]]), float(y[free[0]])
    if kind == 0:
        obstacles.box(px, py, half, colour, turn)
    elif kind == 1:
        obstacles.circle(px, py, radius, colour)
    else:  # a table shows its four legs
        c, s = np.cos(turn), np.sin(turn)
        for u, v in ((-1.5, -1.5), (-1.5, 1.5), (1.5, -1.5), (1.5, 1.5)):
            leg = (px + c * u * half[0] - s * v * half[1], py + s * u * half[0] + c * v * half[1])
            obstacles.circle(*leg, TABLE_LEG_M, colour)


def _draw_colour(rng: np.random.Generator) -> tuple[int, int, int]:
    return (int(rng.integers(40, 220)), int(rng.integers(40, 220)), int(rng.integers(40, 220)))


def _add_corridor_clutter(
    obstacles: _Obstacles, plan: FloorPlan, settings: WorldSettings, rng: np.random.Generator
) -> None:
    """Stand flat boxes and half-sunk pillars along the walls of the corridors, clear of doors and crossings."""
    half, door = settings.corridor_width_m / 2, settings.door_width_m
    wall = half - WALL_M / 2
    deepest = wall - CLEARANCE_M
    for vertical, lines, cross in ((False, plan.corridor_y, plan.corridor_x), (True, plan.corridor_x, plan.corridor_y)):
        for line, piece in np.ndindex(len(lines), len(cross) - 1):
            start, stop = float(cross[piece]) + half + 0.5, float(cross[piece + 1]) - half - 0.5
            for _ in range(rng.poisson(0.8 * settings.clutter * max(stop - start, 0.0))):
                along, side = rng.uniform(start, stop), float(rng.choice([-1.0, 1.0]))
                length, thick = rng.uniform(0.15, 0.4), rng.uniform(0.08, max(deepest, 0.09)) / 2
                colour, doors = _draw_colour(rng), plan.door_x[:, max(line - 1, 0) : line + 1]
                if deepest < 0.08 or (not vertical and np.abs(doors - along).min() < door / 2 + length + 0.1):
                    continue
                across = float(lines[line]) + side * (wall - thick)
                if rng.random() < 0.25:
                    centre = (along, float(lines[line]) + side * wall)
                    obstacles.circle(*(centre[::-1] if vertical else centre), 2 * thick, colour)
                else:
                    x, y, box = (across, along, (thick, length)) if vertical else (along, across, (length, thick))
                    obstacles.box(x, y, box, colour)
