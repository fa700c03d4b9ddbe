"""What the plan view of a trajectory in space does not show: height, roll and pitch over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from posegraph_slam.arrays import FloatArray
from posegraph_slam.evaluation.attitude import euler_rpy
from posegraph_slam.files import replacing
from posegraph_slam.geometry import Trajectory, interpolate
from posegraph_slam.report.canvas import BLACK, DPI
from posegraph_slam.report.figures import STAGE_STYLES

ROWS = ("height [m]", "roll [deg]", "pitch [deg]")


def draw_heights(stages: Mapping[str, Trajectory], path: Path, *, truth: Trajectory | None = None) -> None:
    """Draw height, roll and pitch of up to three stages, named in order of refinement, over time into one PNG.

    `truth`, where known, is dotted black; its heights are shifted by their mean difference to those of the last stage
    over the stamps that lie in both. Roll and pitch are shown as they are.
    """
    last = list(stages.values())[-1]
    origin = float(last.stamps_s.min())
    with matplotlib.style.context("default"):
        figure = Figure(figsize=(9.0, 6.5), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = list(figure.subplots(len(ROWS), 1, sharex=True))
        for (name, stage), style in zip(stages.items(), STAGE_STYLES[-len(stages) :], strict=True):
            for each, values in zip(axes, profile(stage), strict=True):
                each.plot(stage.stamps_s - origin, values, label=name, **style)
        if truth is not None and len(truth):
            rows = profile(truth)
            rows[0] += height_offset(last, truth)
            style = {"color": BLACK, "linewidth": 0.8, "linestyle": ":", "zorder": 4}
            for each, values in zip(axes, rows, strict=True):
                each.plot(truth.stamps_s - origin, values, label="truth", **style)
        for each, label in zip(axes, ROWS, strict=True):
            each.set_ylabel(label)
            each.grid(color="0.92", linewidth=0.6)
        axes[-1].set_xlabel("time [s]")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})


def profile(trajectory: Trajectory) -> FloatArray:
    """Return height in m, roll and pitch in degrees (3, N); zeros of a trajectory in the plane."""
    poses = trajectory.spatial().poses
    return np.vstack([poses[:, 2, 3], np.degrees(euler_rpy(poses[:, :3, :3])[:, :2]).T])


def height_offset(estimate: Trajectory, truth: Trajectory) -> float:
    """Return what the heights of `truth` lack, on average over the stamps within the estimate; 0 without any."""
    inside = (truth.stamps_s >= estimate.stamps_s.min()) & (truth.stamps_s <= estimate.stamps_s.max())
    if not inside.any():
        return 0.0
    common = truth.spatial().select(np.flatnonzero(inside))
    heights = interpolate(estimate.spatial(), common.stamps_s).positions[:, 2]
    return float(np.mean(heights - common.positions[:, 2]))
