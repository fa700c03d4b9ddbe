"""The figures of a run: trajectories of the stages, occupancy map with loop edges, texture map."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patheffects import withStroke

from posegraph_slam.arrays import BoolArray, ByteArray, FloatArray
from posegraph_slam.geometry import Trajectory, align_points, interpolate
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints
from posegraph_slam.report.canvas import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, page
from posegraph_slam.report.view import View, bounds_around

STAGE_STYLES: tuple[dict[str, Any], ...] = (
    {"color": ORANGE, "linestyle": (0, (4, 1.5)), "linewidth": 1.1},
    {"color": SKY, "linestyle": "-", "linewidth": 1.3},
    {"color": BLUE, "linestyle": "-", "linewidth": 1.6},
)
"""Least to most refined; the last one drawn is the optimised trajectory."""

KIND_COLOURS = {
    ConstraintKind.FIXED_INTERVAL: SKY,
    ConstraintKind.PROXIMITY: GREEN,
    ConstraintKind.START_END: PURPLE,
    ConstraintKind.GLOBAL: VERMILLION,
    ConstraintKind.OVERLAP: ORANGE,
    ConstraintKind.EXTERNAL: BLACK,
    ConstraintKind.MANUAL: VERMILLION,
}

UNKNOWN_GREY = 0.85
WALL_GREY = (60, 60, 60)
FLOOR_GREEN, OBSTACLE_RED = (176, 214, 178), (213, 94, 0)
PIXELS: dict[str, Any] = {"interpolation": "nearest"}


def draw_trajectories(
    stages: Mapping[str, Trajectory], path: Path, *, truth: Trajectory | None = None, title: str = ""
) -> None:
    """Draw the trajectories of up to three stages, named in order of refinement, into one PNG.

    `truth`, where known, is laid over the last stage by the rigid alignment of the poses that both have stamps for;
    the start of the last stage is a circle, its end a square.
    """
    lines = {name: trajectory.positions[:, :2] for name, trajectory in stages.items()}
    last = list(stages.values())[-1]
    aligned = None if truth is None or len(truth) < 2 else align_truth(truth, last)
    everything = [*lines.values(), *([aligned] if aligned is not None else [])]
    with page(path, bounds_around(np.concatenate(everything)), title=title) as axes:
        axes.grid(color="0.92", linewidth=0.6)
        axes.set_axisbelow(True)
        for (name, xy), style in zip(lines.items(), STAGE_STYLES[-len(lines) :], strict=True):
            axes.plot(xy[:, 0], xy[:, 1], label=name, **style)
        if aligned is not None:
            label = f"truth (aligned to {list(stages)[-1]})"
            axes.plot(aligned[:, 0], aligned[:, 1], color=BLACK, linewidth=0.8, linestyle=":", label=label, zorder=4)
        mark_ends(axes, last.positions[:, :2])


def align_truth(truth: Trajectory, estimate: Trajectory) -> FloatArray:
    """Return the positions (N, 2) of `truth` in the frame of `estimate`, aligned at the stamps that lie in both."""
    start = max(truth.stamps_s.min(), estimate.stamps_s.min())
    end = min(truth.stamps_s.max(), estimate.stamps_s.max())
    common = truth.select(np.flatnonzero((truth.stamps_s >= start) & (truth.stamps_s <= end)))
    source, xy = common.positions[:, :2], truth.positions[:, :2]
    if len(common) < 2:
        return xy
    T_estimate_truth, _, _ = align_points(source, interpolate(estimate, common.stamps_s).positions[:, :2])
    return np.asarray(xy @ T_estimate_truth[:2, :2].T + T_estimate_truth[:2, 2])


def draw_path(axes: Axes, trajectory: Trajectory) -> None:
    """Draw a trajectory over a picture: a blue line with a white rim, and its ends."""
    xy = trajectory.positions[:, :2]
    rim = [withStroke(linewidth=2.2, foreground="white")]
    axes.plot(xy[:, 0], xy[:, 1], color=BLUE, linewidth=1.0, path_effects=rim, label="trajectory", zorder=3)
    mark_ends(axes, xy)


def mark_ends(axes: Axes, xy: FloatArray) -> None:
    """Mark the first position by a circle, and the last one by a square that fits into it."""
    for label, marker, size, position in (("start", "o", 64, xy[:1]), ("end", "s", 16, xy[-1:])):
        axes.scatter(
            position[:, 0], position[:, 1], marker=marker, s=size, c="white", edgecolors=BLACK, label=label, zorder=8
        )


def draw_map(
    grid: OccupancyGrid,
    path: Path,
    *,
    trajectory: Trajectory | None = None,
    loops: Mapping[ConstraintKind, FloatArray] | None = None,
    rejected: FloatArray | None = None,
    title: str = "",
) -> None:
    """Draw an occupancy map (rows, columns) with the trajectory and the loop edges over it into a PNG.

    `loops` holds segments (E, 2 ends, 2) by kind, `rejected` those of refused candidates, drawn thin and grey.
    White is free, black occupied, grey never seen; only the part of the map that was seen is shown.
    """
    view = View.of(grid.geometry, grid.observed)
    peaks = view.peaks(np.where(grid.observed, grid.log_odds, -np.inf))
    # a free cell is white and not nearly so: log-odds are shown as probabilities, 0.5 apart from "never seen"
    brightness = np.where(np.isfinite(peaks), 1 / (1 + np.exp(np.clip(peaks, -50, 50))), UNKNOWN_GREY)
    with page(path, view.extent_m, title=title) as axes:
        axes.imshow(brightness, cmap="gray", vmin=0, vmax=1, origin="lower", extent=view.extent_m, **PIXELS)
        if rejected is not None and len(rejected):
            label = f"rejected ({len(rejected)})"
            axes.add_collection(LineCollection(list(rejected), colors=GREY, linewidths=0.4, alpha=0.6, label=label))
        for kind, segments in (loops or {}).items():
            draw_segments(axes, segments, kind)
        if trajectory is not None:
            draw_path(axes, trajectory)


def draw_segments(axes: Axes, segments: FloatArray, kind: ConstraintKind) -> None:
    """Draw edges (E, 2 ends, 2) as lines with a dot at both ends, so that even the shortest are seen.

    Many edges are drawn thinner, so that the map stays visible.
    Edges of a fixed interval follow the trajectory: they are a broad band under it, the others lie over it.
    """
    if len(segments) == 0:
        return
    along = kind is ConstraintKind.FIXED_INTERVAL
    label = f"{kind.name.lower().replace('_', ' ')} loops ({len(segments)})"
    crowding = math.sqrt(150 / max(len(segments), 150))
    width, height = (3.0, 2.0) if along else (1.1 * crowding, 4.0)
    lines = LineCollection(list(segments), colors=KIND_COLOURS[kind], linewidths=width, label=label, zorder=height)
    axes.add_collection(lines)
    if not along:
        ends = segments.reshape(-1, 2)
        axes.scatter(ends[:, 0], ends[:, 1], s=5 * crowding, color=KIND_COLOURS[kind], linewidths=0, zorder=5)


def loop_segments(positions: FloatArray, constraints: Constraints) -> dict[ConstraintKind, FloatArray]:
    """Return the ends (E, 2, 2) of the loop constraints of each kind between node `positions` (N, >= 2)."""
    xy = positions[:, :2]
    ends = np.stack([xy[constraints.i], xy[constraints.j]], axis=1)
    return {kind: ends[constraints.kind == kind] for kind in KIND_COLOURS if bool((constraints.kind == kind).any())}


def draw_texture(
    geometry: GridGeometry,
    colours: ByteArray,
    covered: BoolArray,
    path: Path,
    *,
    trajectory: Trajectory | None = None,
    occupied: BoolArray | None = None,
    title: str = "",
) -> None:
    """Draw a texture map, `colours` (rows, columns, 3) where `covered`, into a PNG.

    `occupied` (rows, columns) draws the walls of the occupancy map over it in dark grey.
    """
    walls = np.zeros_like(covered) if occupied is None else occupied
    picture = np.full((*covered.shape, 3), int(UNKNOWN_GREY * 255), dtype=np.uint8)
    picture[covered] = colours[covered]
    picture[walls] = WALL_GREY
    view = View.of(geometry, covered | walls)
    with page(path, view.extent_m, title=title) as axes:
        axes.imshow(view.samples(picture), origin="lower", extent=view.extent_m, **PIXELS)
        if trajectory is not None:
            draw_path(axes, trajectory)
        if occupied is not None:
            axes.plot([], [], color="0.24", linewidth=4, label="walls")


def draw_floor(
    floor: OccupancyGrid,
    path: Path,
    *,
    trajectory: Trajectory | None = None,
    occupied: BoolArray | None = None,
    title: str = "",
) -> None:
    """Draw what a depth camera says of the floor into a PNG: floor green, obstacles red, undecided cells white.

    `occupied` (rows, columns) draws the walls of the laser's map under the obstacles in dark grey.
    """
    layers: list[tuple[str, BoolArray, tuple[int, int, int]]] = [
        ("floor", floor.free, FLOOR_GREEN),
        ("undecided", floor.observed & ~floor.free & ~floor.occupied, (255, 255, 255)),
        *([("walls seen by the laser", occupied, WALL_GREY)] if occupied is not None else []),
        ("obstacle", floor.occupied, OBSTACLE_RED),
    ]
    picture = np.full((*floor.observed.shape, 3), int(UNKNOWN_GREY * 255), dtype=np.uint8)
    for _, cells, colour in layers:
        picture[cells] = colour
    view = View.of(floor.geometry, floor.observed if occupied is None else floor.observed | occupied)
    with page(path, view.extent_m, title=title) as axes:
        axes.imshow(view.samples(picture), origin="lower", extent=view.extent_m, **PIXELS)
        if trajectory is not None:
            draw_path(axes, trajectory)
        for name, cells, colour in layers:
            if cells.any():
                square = axes.plot([], [], "s", color=[c / 255 for c in colour], label=name)[0]
                square.set_markeredgecolor("0.5")
