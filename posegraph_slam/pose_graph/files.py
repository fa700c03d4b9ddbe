"""Pose-graph files of any known format: which it is, shows in the first record or in the name to write."""

from __future__ import annotations

from pathlib import Path

from posegraph_slam.errors import InputError
from posegraph_slam.pose_graph import g2o, toro
from posegraph_slam.pose_graph.graph import PoseGraph


def read_graph(path: Path | str) -> PoseGraph:
    """Read a g2o or TORO file, told apart by its first record; errors name file and line."""
    path = Path(path)
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            words = (line.split(None, 1) for line in file)
            tag = next((w[0] for w in words if w and not w[0].startswith("#")), "")
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "give a pose-graph text file") from None
    return toro.read_toro(path) if tag in toro.TORO.records else g2o.read_g2o(path)


def check_graph_name(path: Path | str) -> str:
    """Return the suffix of a file to be written, or raise `InputError` if it names no known format."""
    suffix = Path(path).suffix.lower()
    if suffix not in (".g2o", ".graph", ".toro"):
        raise InputError(path, f"unknown kind of pose-graph file {suffix!r}", "name it .g2o, .graph or .toro")
    return suffix


def write_graph(graph: PoseGraph, path: Path | str) -> None:
    """Write a g2o (.g2o) or TORO (.graph, .toro) file."""
    if check_graph_name(path) == ".g2o":
        g2o.write_g2o(graph, path)
    else:
        toro.write_toro(graph, path)
