"""What all figures share: page, palette, scale bar, and files whose bytes depend on the content alone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from posegraph_slam.files import replacing

# Okabe and Ito 2008: told apart with every common kind of colour vision
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE, GREY = "#0072B2", "#D55E00", "#CC79A7", "#8C8C8C"

LONG_SIDE_IN = 7.5
"""Longer side of the drawing area: with legend and labels it fits the width of a page."""
SHORT_SIDE_IN = 2.5
DPI = 200


@contextmanager
def page(path: Path, bounds_m: tuple[float, float, float, float], *, title: str = "") -> Iterator[Axes]:
    """Yield axes that show left, right, bottom, top `bounds_m` at equal scale; then write them to the PNG `path`.

    Adds metre labels, a scale bar and, below the axes, a legend of what was labelled.
    """
    left, right, bottom, top = bounds_m
    width, height = right - left, top - bottom
    scale = LONG_SIDE_IN / max(width, height)
    size = max(width * scale, SHORT_SIDE_IN) + 0.8, max(height * scale, SHORT_SIDE_IN) + 1.2
    with matplotlib.style.context("default"):
        figure = Figure(figsize=size, dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        axes.set_aspect("equal")
        axes.set_xlim(left, right)
        axes.set_ylim(bottom, top)
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        axes.set_title(title)
        yield axes
        add_scale_bar(figure, axes)
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            columns = min(len(handles), max(2, int(size[0] / 1.9)))
            figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png", bbox_inches="tight", metadata={"Software": None})


def add_scale_bar(figure: Figure, axes: Axes) -> None:
    """Draw a bar of a round length, about a fifth of the width, below the lower right corner of the axes."""
    left, right = axes.get_xlim()
    length = round_length((right - left) / 5)
    below = ScaledTranslation(0, -0.36, figure.dpi_scale_trans)
    place = axes.get_xaxis_transform() + below
    bar: dict[str, Any] = {
        "color": BLACK,
        "linewidth": 3,
        "solid_capstyle": "butt",
        "clip_on": False,
        "transform": place,
    }
    axes.add_line(Line2D([right - length, right], [0, 0], **bar))
    axes.text(right - length * 1.05, 0, f"{length:g} m", ha="right", va="center", fontsize=9, transform=place)


def round_length(length_m: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above `length_m`."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return next(step * power for step in (5.0, 2.0, 1.0) if step * power <= length_m * (1 + 1e-9))
