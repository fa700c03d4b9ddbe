"""Figures of an evaluation: where a trajectory is wrong, when, and how far it drifts; and of several runs at once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from posegraph_slam.evaluation.ape import AlignedPaths
from posegraph_slam.evaluation.rpe import RelativePoseError
from posegraph_slam.files import replacing
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.report.canvas import BLACK, BLUE, DPI, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, page
from posegraph_slam.report.figures import PIXELS, UNKNOWN_GREY
from posegraph_slam.report.view import View, bounds_around

RUN_COLOURS = (BLUE, ORANGE, GREEN, VERMILLION, PURPLE, SKY, BLACK, GREY)
PANELS_A_ROW = 3


def draw_error_map(paths: AlignedPaths, path: Path, *, title: str = "") -> None:
    """Draw the true path, and over it the estimate coloured by its distance from the truth, into a PNG."""
    true, xy, error = paths.true[:, :2, -1], paths.estimate[:, :2, -1], paths.translation_m
    with page(path, bounds_around(np.concatenate([true, xy])), title=title) as axes:
        axes.plot(true[:, 0], true[:, 1], color=GREY, linewidth=0.9, label="truth", zorder=1)
        segments = np.stack([xy[:-1], xy[1:]], axis=1)
        lines = LineCollection(list(segments), cmap="viridis", linewidths=2.0, zorder=2)
        lines.set_array((error[:-1] + error[1:]) / 2)
        lines.set_clim(0, float(max(error.max(), 1e-9)))
        axes.add_collection(lines)
        axes.figure.colorbar(lines, ax=axes, shrink=0.7, label="distance from the truth [m]")


def draw_errors(paths: AlignedPaths, rpe: RelativePoseError | None, path: Path, *, title: str = "") -> None:
    """Draw position and rotation error over time, and the drift over each distance, into a PNG."""
    drifts = [error for error in (rpe.over_distance if rpe else ()) if error.translation_m and error.rotation_deg]
    with matplotlib.style.context("default"):
        figure = Figure(figsize=(9.0, 7.0 if drifts else 4.5), dpi=DPI * 2 // 3, layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(3 if drifts else 2, 2)
        seconds = paths.stamps_s - paths.stamps_s.min() if len(paths.stamps_s) else paths.stamps_s
        order = np.argsort(seconds, kind="stable")
        for row, (values, name, colour) in enumerate(
            ((paths.translation_m, "position [m]", BLUE), (paths.rotation_deg, "rotation [deg]", VERMILLION))
        ):
            axes = figure.add_subplot(grid[row, :])
            axes.plot(seconds[order], values[order], color=colour, linewidth=0.9)
            rmse = float(np.sqrt(np.mean(values**2)))
            axes.axhline(rmse, color=BLACK, linewidth=0.7, linestyle="--", label=f"RMSE {rmse:.3g}")
            axes.set_ylabel(f"error of {name}")
            axes.set_ylim(bottom=0)
            axes.grid(visible=True, linewidth=0.3)
            axes.legend(loc="best", frameon=False, fontsize=9)
            if row == 0:
                axes.set_title(title)
            else:
                axes.set_xlabel("time [s]")
        for column, (part, unit, colour) in enumerate(
            (("translation_m", "m", BLUE), ("rotation_deg", "deg", VERMILLION)) if drifts else ()
        ):
            axes = figure.add_subplot(grid[2, column])
            names = [f"{error.distance_m:g} m" for error in drifts]
            axes.bar(names, [getattr(error, part).rmse for error in drifts], color=colour, width=0.55, label="RMSE")
            median = [getattr(error, part).median for error in drifts]
            axes.scatter(names, median, color=BLACK, s=14, zorder=3, label="median")
            axes.set_ylabel(f"drift [{unit}]")
            axes.set_xlabel("over a distance of")
            axes.legend(frameon=False, fontsize=9)
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})


def draw_comparison(
    runs: Mapping[str, tuple[Trajectory, OccupancyGrid | None]],
    path: Path,
    *,
    captions: Mapping[str, str] | None = None,
) -> None:
    """Draw the map of each run with its path, and all paths over each other, into a PNG.

    `captions` stand under the names, such as the figures of a map.
    """
    count = len(runs) + 1
    columns = 2 if count == 4 else min(count, PANELS_A_ROW)
    rows = -(-count // columns)
    spans = [np.ptp(trajectory.positions[:, :2], axis=0) for trajectory, _ in runs.values()]
    tallest = float(np.clip(max(high / max(wide, 0.1) for wide, high in spans) + 0.15, 0.35, 1.3))
    with matplotlib.style.context("default"):
        figure = Figure(figsize=(4.6 * columns, (4.4 * tallest + 0.9) * rows), dpi=DPI * 2 // 3, layout="constrained")
        FigureCanvasAgg(figure)
        together = figure.add_subplot(rows, columns, count)
        for number, (name, (trajectory, grid)) in enumerate(runs.items()):
            colour = RUN_COLOURS[number % len(RUN_COLOURS)]
            axes = figure.add_subplot(rows, columns, number + 1)
            _panel(axes, trajectory, grid, colour)
            caption = (captions or {}).get(name, "")
            axes.set_title(f"{name}\n{caption}" if caption else name, fontsize=10)
            xy = trajectory.positions[:, :2]
            together.plot(xy[:, 0], xy[:, 1], color=colour, linewidth=0.9, label=name)
        together.set_aspect("equal")
        together.set_title("paths", fontsize=10)
        together.grid(color="0.92", linewidth=0.6)
        together.legend(frameon=False, fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2)
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})


def _panel(axes: Axes, trajectory: Trajectory, grid: OccupancyGrid | None, colour: str) -> None:
    axes.set_aspect("equal")
    if grid is not None:
        view = View.of(grid.geometry, grid.observed)
        peaks = view.peaks(np.where(grid.observed, grid.log_odds, -np.inf))
        brightness = np.where(np.isfinite(peaks), 1 / (1 + np.exp(np.clip(peaks, -50, 50))), UNKNOWN_GREY)
        axes.imshow(brightness, cmap="gray", vmin=0, vmax=1, origin="lower", extent=view.extent_m, **PIXELS)
    xy = trajectory.positions[:, :2]
    axes.plot(xy[:, 0], xy[:, 1], color=colour, linewidth=0.6)
    axes.tick_params(labelsize=8)
