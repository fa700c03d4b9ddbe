"""The figure of a solved pose graph, seen from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection

from posegraph_slam.arrays import BoolArray
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.report.canvas import BLUE, GREY, VERMILLION, page
from posegraph_slam.report.view import bounds_around


def draw_graph(graph: PoseGraph, path: Path, *, kept: BoolArray | None = None, title: str = "") -> None:
    """Draw poses and edges in x and y into a PNG: odometry, loops, and loops that are not `kept` (E,)."""
    c, d = graph.constraints, graph.group.dimension
    xy = graph.poses[:, :2, d]
    ends = np.stack([xy[c.i], xy[c.j]], axis=1)
    used = np.ones(len(c), dtype=np.bool_) if kept is None else kept
    layers = (
        ("rejected loops", ~used, VERMILLION, 0.5),
        ("loops", used & c.is_loop, GREY, 0.6),
        ("odometry", used & ~c.is_loop, BLUE, 1.0),
    )
    with page(path, bounds_around(xy), title=title) as axes:
        for order, (name, edges, colour, width) in enumerate(layers):
            if edges.any():
                label = f"{name} ({int(edges.sum())})"
                axes.add_collection(
                    LineCollection(list(ends[edges]), colors=colour, linewidths=width, label=label, zorder=2 + order)
                )
