"""A cloud laid over the model that it was aligned to, seen from two sides."""

from __future__ import annotations

from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from posegraph_slam.arrays import FloatArray
from posegraph_slam.files import replacing
from posegraph_slam.report.canvas import GREY

MODEL_POINTS, CLOUD_POINTS = 8000, 5000
"""Points drawn at most; more only fill the same pixels."""


def draw_overlay(model: FloatArray, cloud: FloatArray, distance_m: FloatArray, path: Path, *, title: str = "") -> None:
    """Draw cloud (n, 3), placed in the model's frame, over model (m, 3), along its x and its y axis, into one PNG.

    The model is grey, the cloud coloured by its distance (n,) to the model, up to the 98th percentile.
    """
    model = model[:: max(len(model) // MODEL_POINTS, 1)]
    step = max(len(cloud) // CLOUD_POINTS, 1)
    cloud, distance_mm = cloud[::step], 1000 * distance_m[::step]
    limit = max(float(np.quantile(distance_mm, 0.98)), 1e-6)
    everything = np.vstack([model, cloud])
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
    reach = 0.53 * float(np.ptp(everything, axis=0).max())
    with matplotlib.style.context("default"):
        figure = Figure(figsize=(9.0, 4.0), dpi=150, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, fontsize=10)
        marks = None
        for axes, (across, name) in zip(figure.subplots(1, 2), ((0, "x"), (1, "y")), strict=True):
            axes.scatter(model[:, across], model[:, 2], s=1.0, color=GREY, alpha=0.6, linewidths=0, label="model")
            marks = axes.scatter(cloud[:, across], cloud[:, 2], s=1.6, c=distance_mm, vmin=0, vmax=limit,
                                 cmap="viridis", linewidths=0, label="cloud")  # fmt: skip
            axes.set_aspect("equal")
            axes.set_xlim(middle[across] - reach, middle[across] + reach)
            axes.set_ylim(middle[2] - reach, middle[2] + reach)
            axes.set_xlabel(f"{name} of the model [m]")
            axes.set_ylabel("z of the model [m]")
        if marks is not None:
            figure.colorbar(marks, ax=figure.axes, shrink=0.8, label="distance to the model [mm]")
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})
