"""Figures of an orientation over time: roll, pitch and yaw of estimates against the truth, and their errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from posegraph_slam.arrays import BoolArray, FloatArray
from posegraph_slam.evaluation.attitude import GIMBAL_PITCH_DEG, align_heading, euler_rpy, tilt_deg
from posegraph_slam.files import replacing
from posegraph_slam.geometry import Trajectory, wrap_angle
from posegraph_slam.report.canvas import BLACK, BLUE, DPI, GREEN, ORANGE, VERMILLION

ANGLES = ("roll", "pitch", "yaw")
COLOURS = (BLUE, VERMILLION, GREEN, ORANGE)


def draw_attitude(
    estimates: Mapping[str, Trajectory], path: Path, *, truth: Trajectory | None = None, title: str = ""
) -> None:
    """Draw roll, pitch and yaw of each estimate over time into the PNG `path`.

    With the truth, black, estimates are shown at its stamps with their heading aligned at the start, each angle has its
    error below, and the last row shows the error of the tilt. Grey: true pitch beyond 80 degrees, where roll and yaw
    are ill-defined.
    """
    rows = 3 if truth is None else 7
    with matplotlib.style.context("default"):
        figure = Figure(figsize=(9.0, 1.5 * rows + 1.0), dpi=DPI * 2 // 3, layout="constrained")
        FigureCanvasAgg(figure)
        axes: list[Axes] = list(figure.subplots(rows, 1, sharex=True))
        if truth is None:
            _draw_estimates(axes, estimates)
        else:
            _draw_against(axes, estimates, truth)
        axes[0].set_title(title)
        axes[-1].set_xlabel("time [s]")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})


def _draw_estimates(axes: list[Axes], estimates: Mapping[str, Trajectory]) -> None:
    for (name, estimate), colour in zip(estimates.items(), COLOURS, strict=False):
        rpy = np.degrees(euler_rpy(estimate.poses[:, :3, :3]))
        for row, angle in enumerate(ANGLES):
            _draw_angle(axes[row], estimate.stamps_s - estimate.stamps_s[0], rpy[:, row], colour, name)
            axes[row].set_ylabel(f"{angle} [deg]")


def _draw_against(axes: list[Axes], estimates: Mapping[str, Trajectory], truth: Trajectory) -> None:
    origin = float(truth.stamps_s.min())
    for number, ((name, estimate), colour) in enumerate(zip(estimates.items(), COLOURS, strict=False)):
        pairs = align_heading(estimate, truth)
        seconds, true, rpy = pairs.stamps_s - origin, euler_rpy(pairs.truth), euler_rpy(pairs.estimate)
        error = np.degrees(wrap_angle(rpy - true))
        near_pole = np.abs(np.degrees(true[:, 1])) > GIMBAL_PITCH_DEG
        for row, angle in enumerate(ANGLES):
            values, errors = axes[2 * row], axes[2 * row + 1]
            if number == 0:
                _draw_angle(values, seconds, np.degrees(true[:, row]), BLACK, "truth")
                _shade((values, errors), seconds, near_pole)
                values.set_ylabel(f"{angle} [deg]")
                errors.set_ylabel(f"{angle} error")
                errors.set_ylim(-15, 15)
            _draw_angle(values, seconds, np.degrees(rpy[:, row]), colour, name)
            _draw_angle(errors, seconds, error[:, row], colour, name)
        axes[-1].plot(seconds, tilt_deg(pairs), color=colour, linewidth=0.8)
    axes[-1].set_ylabel("tilt error")
    axes[-1].set_ylim(0, 15)


def _draw_angle(axes: Axes, seconds: FloatArray, degrees: FloatArray, colour: str, name: str) -> None:
    """Draw an angle without the vertical strokes of its wrapping."""
    leaps = np.abs(np.diff(degrees)) > 180.0
    values = np.insert(degrees, np.flatnonzero(leaps) + 1, np.nan)
    times = np.insert(seconds, np.flatnonzero(leaps) + 1, seconds[1:][leaps])
    axes.plot(times, values, color=colour, linewidth=1.2 if colour == BLACK else 0.8, label=name)
    axes.grid(visible=True, linewidth=0.3)


def _shade(all_axes: tuple[Axes, ...], seconds: FloatArray, flags: BoolArray) -> None:
    for axes in all_axes:
        axes.fill_between(
            seconds, 0, 1, where=flags.tolist(), transform=axes.get_xaxis_transform(), color="0.85", linewidth=0
        )
