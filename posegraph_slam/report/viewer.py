"""A run in the rerun viewer: map, paths, closures, and the robot moving over time."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.pipeline.stored_graph import StoredGraph
from posegraph_slam.report.run_content import read_run_content

INSTALL = "install it by `pip install 'posegraph_slam[viewer]'`"
PATH_COLOURS = ((230, 159, 0), (86, 180, 233), (0, 114, 178))
WALL, ACCEPTED, REJECTED, ROBOT = (40, 40, 40), (0, 158, 115), (170, 170, 170), (213, 94, 0)
MOVES_AT_MOST = 5000
"""Poses of the robot over time: more would only slow the viewer down."""


def view_run(folder: Path, *, save: Path | None = None) -> dict[str, int]:
    """Show a run directory in the rerun viewer, or write it to the .rrd file `save`; return what was shown.

    Raises InputError where rerun is not installed or `folder` is no run.
    """
    rerun = _rerun()
    content = read_run_content(folder)
    if not content.trajectories:
        raise InputError(folder, "has no trajectory to show", "run the command that made it again")
    rerun.init(f"posegraph_slam {content.name}", spawn=save is None)
    if save is not None:
        save.parent.mkdir(parents=True, exist_ok=True)
        rerun.save(str(save))
    shown = {"walls": 0 if content.occupancy is None else _log_map(rerun, content.occupancy)}
    shown["paths"] = _log_paths(rerun, content.trajectories)
    if content.stored is not None:
        shown |= _log_closures(rerun, content.stored)
    shown["poses"] = _log_robot(rerun, list(content.trajectories.values())[-1])
    return shown


def _rerun() -> ModuleType:
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        raise InputError("psg view", "needs the package rerun-sdk, which is not installed", INSTALL) from error


def _log_map(rerun: Any, grid: OccupancyGrid) -> int:
    """Show the occupied cells as points of their size."""
    centres = grid.geometry.cell_to_world(np.argwhere(grid.occupied))
    points = np.column_stack([centres, np.zeros(len(centres))])
    rerun.log("map/walls", rerun.Points3D(points, radii=grid.geometry.resolution_m / 2, colors=WALL), static=True)
    return len(centres)


def _log_paths(rerun: Any, trajectories: Mapping[str, Trajectory]) -> int:
    """Show the trajectories of the run, the last one as its result."""
    colours = PATH_COLOURS[-len(trajectories) :]
    for (name, path), colour in zip(trajectories.items(), colours, strict=False):
        line = rerun.LineStrips3D([path.spatial().positions], colors=colour, radii=0.02)
        rerun.log(f"paths/{name.replace(' ', '_')}", line, static=True)
    return len(trajectories)


def _log_closures(rerun: Any, stored: StoredGraph) -> dict[str, int]:
    """Show accepted and rejected closures as lines between the keyframes that they join."""
    positions = np.zeros((len(stored.graph), 3))
    positions[:, : stored.graph.poses.shape[-1] - 1] = stored.graph.poses[:, :-1, -1]
    counts = {}
    for name, wanted, colour in (("accepted", True, ACCEPTED), ("rejected", False, REJECTED)):
        pairs = [(each.target, each.source) for each in stored.records if each.accepted == wanted]
        counts[name] = len(pairs)
        if pairs:
            lines = rerun.LineStrips3D(positions[np.array(pairs)], colors=colour, radii=0.01)
            rerun.log(f"closures/{name}", lines, static=True)
    return counts


def _log_robot(rerun: Any, path: Trajectory) -> int:
    """Move an arrow along the path on the timeline `time`, seconds from its start."""
    every = max(1, -(-len(path) // MOVES_AT_MOST))
    start = float(path.stamps_s.min())
    poses = path.spatial().poses
    for k in range(0, len(path), every):
        _set_time(rerun, float(path.stamps_s[k]) - start)
        arrow = rerun.Arrows3D(origins=[poses[k, :3, 3]], vectors=[poses[k, :3, 0]], colors=ROBOT, radii=0.04)
        rerun.log("robot", arrow)
    return len(range(0, len(path), every))


def _set_time(rerun: Any, seconds: float) -> None:
    """Set the time of what follows; rerun 0.23 renamed the function."""
    if hasattr(rerun, "set_time"):
        rerun.set_time("time", duration=seconds)
    else:
        rerun.set_time_seconds("time", seconds)
