"""What distinguishes one pose-graph text format from another, and the reading and writing that they share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, pose_from_xyt, xyt_from_pose
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.graph_file import (
    assemble_graph,
    fold_information,
    group_of,
    node_ids,
    unfold_information,
    write_text,
)
from posegraph_slam.pose_graph.graph_text import RecordFormat, Records, format_records, read_records

NOTHING = Records(ids=np.zeros((0, 1), dtype=np.int64), reals=np.zeros((0, 0)), lines=np.zeros(0, dtype=np.int64))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphFormat:
    """Records of a format: what they are called, how spatial poses and planar information are written.

    `spatial_poses(path, reals, lines)` turns the numbers of poses (n, `spatial_size`) into matrices (n, 4, 4),
    `spatial_reals` does the opposite. `planar_order` says which of the numbers in a file is each of the upper triangle
    xx xy xt yy yt tt.
    """

    name: str
    tags: Mapping[str, tuple[str, str]]
    """Vertex and edge tag of each group."""
    fix: str | None
    """The tag of fixed nodes; None if the format has none: then the first node is."""
    spatial_size: int
    spatial_poses: Callable[[Path, FloatArray, IntArray], FloatArray]
    spatial_reals: Callable[[FloatArray], FloatArray]
    planar_order: tuple[int, ...]

    @property
    def records(self) -> dict[str, RecordFormat]:
        """The layout of every record."""
        layouts = {}
        for group, (vertex, edge) in self.tags.items():
            size, upper = (3, 6) if group == SE2.name else (self.spatial_size, 21)
            layouts[vertex] = RecordFormat(ids=1, reals=size)
            layouts[edge] = RecordFormat(ids=2, reals=size + upper)
        return layouts | ({} if self.fix is None else {self.fix: RecordFormat(ids=None, reals=0)})

    def poses(self, path: Path, reals: FloatArray, lines: IntArray) -> FloatArray:
        """Turn the numbers of poses into matrices."""
        if reals.shape[1] == 3:
            return pose_from_xyt(reals)
        return self.spatial_poses(path, reals, lines) if len(reals) else np.zeros((0, 4, 4))

    def reals(self, poses: FloatArray) -> FloatArray:
        """Invert `poses`."""
        if poses.shape[-1] == 3:
            return xyt_from_pose(poses)
        return self.spatial_reals(poses) if len(poses) else np.zeros((0, self.spatial_size))


def read_graph_text(path: Path | str, layout: GraphFormat) -> PoseGraph:
    """Read a file; nodes stand in the order of their vertex lines, then those that only edges name, by id.

    Edges between ids that follow each other are `ODOMETRY`, others `EXTERNAL`. Vertices that are missing get poses from
    the edges; if none is fixed, the first is. Raises `InputError` with file and line for anything not understood.
    """
    path = Path(path)
    records = read_records(path, layout.records)
    group = group_of(path, records, layout.tags)
    vertices, edges = (records[tag] for tag in layout.tags[group.name])
    size = 3 if group is SE2 else layout.spatial_size
    upper = edges.reals[:, size:]
    return assemble_graph(
        path,
        group,
        vertices=(vertices, layout.poses(path, vertices.reals, vertices.lines)),
        edges=(edges, layout.poses(path, edges.reals[:, :size], edges.lines)),
        information=unfold_information(group, upper[:, layout.planar_order] if group is SE2 else upper),
        fixed=NOTHING if layout.fix is None else records[layout.fix],
    )


def write_graph_text(graph: PoseGraph, path: Path | str, layout: GraphFormat) -> None:
    """Write vertices, edges, then fixed nodes, each number with the digits that restore it; ids are `node_ids`.

    The file appears complete or not at all. Raises `InputError` for fixed nodes that the format cannot tell of.
    """
    path, c, ids = Path(path), graph.constraints, node_ids(graph)
    if layout.fix is None and not np.array_equal(np.flatnonzero(graph.fixed), [0]):
        problem = f"a {layout.name} file cannot say which nodes are fixed, and here it is not just the first"
        raise InputError(path, problem, "write g2o")
    vertex, edge = layout.tags[graph.group.name]
    upper = fold_information(graph.group, c.information)
    upper = upper[:, np.argsort(layout.planar_order)] if graph.group is SE2 else upper
    reals = np.concatenate([layout.reals(c.T_i_j), upper], axis=1)
    lines = [
        *format_records(vertex, ids[:, None], layout.reals(graph.poses)),
        *format_records(edge, np.stack([ids[c.i], ids[c.j]], axis=1), reals),
    ]
    if layout.fix is not None:
        lines += [f"{layout.fix} {number}" for number in ids[graph.fixed].tolist()]
    write_text(path, "\n".join(lines) + "\n")
