"""Where the robot goes: a walk over the net of corridors and doors, rounded into a smooth path."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.datasets.simulation.settings import DriveSettings
from posegraph_slam.datasets.simulation.terrain import Terrain
from posegraph_slam.datasets.simulation.world import FloorPlan
from posegraph_slam.geometry import SO3

Node = tuple[int, int]
STEP_M = 0.01
"""Sampling of a path."""
ROUNDING_M = 0.45
"""Standard deviation of the Gaussian that rounds corners: the smallest radius is about 0.4 m."""
WANDER_LENGTH_M = 1.2
RUN_IN_M, RUN_OUT_M = 1.0, 2.0
"""Straight pieces before and after the drive while it is shaped: kept until the end, and cut after rounding."""
STOP_SHORT_M = 0.35
"""The drive ends this far before its start."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path:
    """Samples of a smooth path: travelled distance (P,), position (P, 2) and unwrapped heading (P,) of its tangent.

    `height_m` (P,) and `gradient` (P, 2) are the ground's, zero where it is flat; distance runs along the ground.
    `turn_rad` (P,) is the turn about the robot's own vertical axis, on flat ground the heading.
    """

    distance_m: FloatArray
    position_m: FloatArray
    heading_rad: FloatArray
    height_m: FloatArray
    gradient: FloatArray
    turn_rad: FloatArray

    def __post_init__(self) -> None:
        for name in ("distance_m", "position_m", "heading_rad", "height_m", "gradient", "turn_rad"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Net:
    """Crossings (column, row) of the lines that can be driven: place of each, neighbours, and which edges are doors."""

    place: dict[Node, tuple[float, float]]
    neighbours: dict[Node, list[Node]]
    doors: frozenset[frozenset[Node]]
    corridor_length_m: float

    def length(self, a: Node, b: Node) -> float:
        """Distance of two neighbours."""
        (xa, ya), (xb, yb) = self.place[a], self.place[b]
        return abs(xa - xb) + abs(ya - yb)


def build_net(plan: FloorPlan) -> Net:
    """Join corridors and passable doors into a net; a node is (place along its corridor, corridor).

    Places are numbered along x on every horizontal corridor; vertical corridors and pairs of rooms with a common
    door join one line to the next.
    """
    crossings, lines = plan.corridor_x.tolist(), plan.corridor_y.tolist()
    place: dict[Node, tuple[float, float]] = {}
    column_of: dict[tuple[int, float], Node] = {}
    edges: list[tuple[Node, Node]] = []
    doors: set[frozenset[Node]] = set()
    for row, y in enumerate(lines):
        beside = plan.door_x[:, max(row - 1, 0) : row + 1][plan.passable[:, max(row - 1, 0) : row + 1]]
        stops = sorted({*crossings, *beside.tolist(), 0.0} if row == 0 else {*crossings, *beside.tolist()})
        for column, x in enumerate(stops):
            place[column, row] = (x, y)
            column_of[row, x] = (column, row)
        edges += [((column, row), (column + 1, row)) for column in range(len(stops) - 1)]
    for row in range(len(lines) - 1):
        edges += [(column_of[row, x], column_of[row + 1, x]) for x in crossings]
        for x in plan.door_x[:, row][plan.passable[:, row]].tolist():
            edges.append((column_of[row, x], column_of[row + 1, x]))
            doors.add(frozenset(edges[-1]))
    neighbours: dict[Node, list[Node]] = {node: [] for node in place}
    for a, b in edges:
        neighbours[a].append(b)
        neighbours[b].append(a)
    corridors = [(a, b) for a, b in edges if frozenset((a, b)) not in doors]
    length = sum(abs(place[a][0] - place[b][0]) + abs(place[a][1] - place[b][1]) for a, b in corridors)
    return Net(place=place, neighbours=neighbours, doors=frozenset(doors), corridor_length_m=length)


def walk(net: Net, length_m: float, rng: np.random.Generator) -> list[Node]:
    """Walk the net from the origin heading +x without turning back, always along the least used edge, then go home.

    Doors count half a use more than corridors, so that the first lap goes round. The walk turns home once it is
    `length_m` long and comes in at the origin as it left, heading +x.
    """
    home = next(node for node, where in net.place.items() if where == (0.0, 0.0))
    before = (home[0] - 1, 0)
    nodes, used, travelled = [home, (home[0] + 1, 0)], dict[frozenset[Node], float](), 0.0
    used[frozenset(nodes)] = 1.0
    travelled = net.length(*nodes)
    while travelled < length_m - _home_length(net, nodes, before, home):
        onward = [node for node in net.neighbours[nodes[-1]] if node != nodes[-2]]
        cost = [used.get(e, 0.5 if e in net.doors else 0.0) for e in (frozenset((nodes[-1], n)) for n in onward)]
        chosen = onward[int(np.argmin(np.asarray(cost) + 0.1 * rng.random(len(cost))))]
        edge = frozenset((nodes[-1], chosen))
        used[edge] = used.get(edge, 0.5 if edge in net.doors else 0.0) + 1.0
        travelled += net.length(nodes[-1], chosen)
        nodes.append(chosen)
    return nodes + _way_home(net, nodes, before, home)


def _home_length(net: Net, nodes: list[Node], before: Node, home: Node) -> float:
    way = [nodes[-1], *_way_home(net, nodes, before, home)]
    return sum(net.length(a, b) for a, b in pairwise(way))


def _way_home(net: Net, nodes: list[Node], before: Node, home: Node) -> list[Node]:
    """Fewest edges from the last node, without turning back, to `home` coming from `before` (breadth first)."""
    start = (nodes[-2], nodes[-1])
    if start == (before, home):
        return []
    came_from = {start: start}
    queue = deque([start])
    while (before, home) not in came_from:
        previous, current = state = queue.popleft()
        for onward in net.neighbours[current]:
            if onward != previous and (current, onward) not in came_from:
                came_from[current, onward] = state
                queue.append((current, onward))
    way, state = [home], came_from[before, home]
    while state != start:
        way.append(state[1])
        state = came_from[state]
    return way[::-1]


def smooth_path(corners: FloatArray, settings: DriveSettings, rng: np.random.Generator) -> Path:
    """Round the corners of a polyline (n, 2), let it wander about its line, and end it short of the last corner.

    The path starts exactly at the first corner with the heading of the first piece. Rounding is a Gaussian filter
    over the positions, so that curvature and its slope are continuous.
    """
    first, last = corners[1] - corners[0], corners[-1] - corners[-2]
    reach = RUN_IN_M + RUN_OUT_M
    corners = np.concatenate([corners[:1] - reach * first / np.linalg.norm(first), corners[1:-1],
                              corners[-1:] + reach * last / np.linalg.norm(last)])  # fmt: skip
    cut = round(RUN_OUT_M / STEP_M)  # beyond the reach of the filter's treatment of the ends
    rounded = gaussian_filter1d(_resample(corners), ROUNDING_M / STEP_M, axis=0, mode="nearest")[cut:-cut]
    position = rounded + _wander(rounded, settings, rng)[:, None] * _normals(rounded)
    distance = _travelled(position) - RUN_IN_M
    slope = np.gradient(position, axis=0)
    heading = np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))
    at = np.arange(0.0, distance[-1] - RUN_IN_M - STOP_SHORT_M, STEP_M)
    columns = [np.interp(at, distance, values) for values in (position[:, 0], position[:, 1], heading)]
    return Path(
        distance_m=at,
        position_m=np.stack(columns[:2], axis=1),
        heading_rad=columns[2],
        height_m=np.zeros(len(at)),
        gradient=np.zeros((len(at), 2)),
        turn_rad=columns[2],
    )


def lift_path(path: Path, terrain: Terrain) -> Path:
    """Lay a planar path onto the ground, sampled anew every `STEP_M` along it."""
    height, _ = terrain.ground(path.position_m)
    distance = _travelled(np.column_stack([path.position_m, height]))
    at = np.arange(0.0, distance[-1], STEP_M)
    x, y, heading = (np.interp(at, distance, column) for column in (*path.position_m.T, path.heading_rad))
    position = np.stack([x, y], axis=1)
    height, gradient = terrain.ground(position)
    R = rotation_on_ground(heading, gradient)
    turn = SO3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:])[:, 2]
    return Path(
        distance_m=at,
        position_m=position,
        heading_rad=heading,
        height_m=height,
        gradient=gradient,
        turn_rad=heading[0] + np.concatenate([[0.0], np.cumsum(turn)]),
    )


def rotation_on_ground(heading_rad: FloatArray, gradient: FloatArray) -> FloatArray:
    """Rotation (n, 3, 3) of a robot on ground of `gradient` (n, 2) whose x axis lies above its heading (n,)."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    x = np.stack([c, s, gradient[:, 0] * c + gradient[:, 1] * s], axis=1)
    z = np.column_stack([-gradient, np.ones(len(gradient))])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _normals(positions: FloatArray) -> FloatArray:
    """Unit vectors (n, 2) to the left of a sampled path."""
    tangent = np.gradient(positions, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)


def _wander(positions: FloatArray, settings: DriveSettings, rng: np.random.Generator) -> FloatArray:
    """Smooth random offset (n,) to the left, none at the start of the drive up to its third derivative."""
    sigma = WANDER_LENGTH_M / STEP_M
    noise = gaussian_filter1d(rng.normal(size=len(positions)), sigma, mode="wrap") * np.sqrt(2 * np.sqrt(np.pi) * sigma)
    driven = np.maximum(_travelled(positions) - RUN_IN_M, 0.0)
    return np.asarray(np.clip(settings.wander_m * noise, -0.15, 0.15) * (1 - np.exp(-((driven / 1.5) ** 4))))


def _travelled(positions: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])


def _resample(positions: FloatArray) -> FloatArray:
    """Sample a polyline every `STEP_M` of its length."""
    travelled = _travelled(positions)
    at = np.arange(0.0, travelled[-1], STEP_M)
    return np.stack([np.interp(at, travelled, positions[:, k]) for k in range(2)], axis=1)


def plan_path(plan: FloorPlan, settings: DriveSettings, rng: np.random.Generator) -> Path:
    """Draw a walk of `settings.laps` times the length of all corridors and smooth it into a path."""
    net = build_net(plan)
    nodes = walk(net, settings.laps * net.corridor_length_m, rng)
    return smooth_path(np.array([net.place[node] for node in nodes]), settings, rng)
