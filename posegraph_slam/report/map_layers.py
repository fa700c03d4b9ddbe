"""The layers of the interactive map as numbers: pictures, trajectories, keyframes and edges, at what a screen shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from posegraph_slam.arrays import ByteArray, FloatArray, IntArray
from posegraph_slam.geometry import Trajectory
from posegraph_slam.loop_closure.ledger import LoopRecord
from posegraph_slam.loop_closure.verification import gaussian_sigmas
from posegraph_slam.mapping.images import png_bytes
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.pipeline.stored_graph import StoredGraph
from posegraph_slam.pose_graph.graph import ConstraintKind, PoseGraph
from posegraph_slam.pose_graph.residuals import chi2
from posegraph_slam.report.markup import data_uri
from posegraph_slam.report.run_content import RunContent
from posegraph_slam.report.view import View, bounds_around

PATH_POINTS = 4000
"""Points of a trajectory at most: about one a pixel of a wide screen."""
OVERLAPS_SHOWN, REJECTED_SHOWN = 20_000, 20_000
"""Edges of a layer at most; of the overlaps those that fit worst, of the rejected candidates the last ones."""
TEXTURE_BYTES = 3_000_000
"""A texture map takes no more than this; every halving of its sides leaves about a quarter."""
OUTSIDE_SHARE = 0.01
UNSEEN_PIXEL = 128
"""Grey of a cell that was never seen; no other cell has it."""


def map_layers(content: RunContent) -> dict[str, Any]:
    """Return everything that the map draws, ready for JSON: metres as whole millimetres, each after its predecessor."""
    layers: dict[str, Any] = {"paths": [path_layer(name, each) for name, each in content.trajectories.items()]}
    if content.occupancy is not None and not content.occupancy.geometry.yaw_rad:
        layers |= picture_layers(content.occupancy, content.texture)
    if content.stored is not None:
        layers |= graph_layers(content.stored)
    layers["home"] = [round(side, 3) for side in opening(content)]
    return layers


def opening(content: RunContent) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of what the map shows first: most that was mapped, and the last trajectory.

    A hundredth of the cells on each side is left out: single rays through a door or a window reach far.
    """
    last = list(content.trajectories.values())[-1:]
    outlines = [each.positions[:, :2] for each in last]
    if content.occupancy is not None and not content.occupancy.geometry.yaw_rad:
        grid = content.occupancy
        cells = np.argwhere(grid.observed)[:, ::-1] + 0.5
        if len(cells):
            inner = np.quantile(cells, [OUTSIDE_SHARE, 1 - OUTSIDE_SHARE], axis=0)
            outlines.append(grid.geometry.origin_m + grid.geometry.resolution_m * inner)
    return bounds_around(np.concatenate(outlines) if outlines else np.zeros((0, 2)))


def picture_layers(grid: OccupancyGrid, texture: ByteArray | None = None) -> dict[str, Any]:
    """Return the occupancy map as grey PNG (0 free, 255 occupied, `UNSEEN_PIXEL` never seen), and the texture's."""
    view = View.of(grid.geometry, grid.observed)
    peaks = view.peaks(np.where(grid.observed, grid.log_odds, -np.inf))
    probability = 1 / (1 + np.exp(-np.clip(peaks, -50, 50)))
    grey = np.round(255 * probability).astype(np.uint8)
    grey[grey == UNSEEN_PIXEL] += 1
    grey[~np.isfinite(peaks)] = UNSEEN_PIXEL
    extent = [round(float(side), 4) for side in view.extent_m]
    layers = {"occupancy": {"png": data_uri(png_bytes(grey[::-1])), "extent": extent}}
    if texture is not None and bool(texture[..., 3].any()):
        layers["texture"] = {"png": data_uri(texture_png(view.samples(texture[::-1])[::-1])), "extent": extent}
    return layers


def texture_png(pixels: ByteArray) -> bytes:
    """Encode a texture (rows, columns, 4), coarser where it would make the page too large to mail."""
    content = png_bytes(pixels)
    while len(content) > TEXTURE_BYTES:
        rows, columns = (size - size % 2 for size in pixels.shape[:2])
        pixels = pixels[:rows:2, :columns:2]
        content = png_bytes(pixels)
    return content


def path_layer(name: str, trajectory: Trajectory) -> dict[str, Any]:
    """Return a trajectory in stamp order, thinned evenly along its path, with its start and end kept."""
    xy = trajectory.in_stamp_order().positions[:, :2]
    return {"name": name, "mm": millimetres(xy[thinned(xy)])}


def thinned(xy: FloatArray) -> IntArray:
    """Return the rows of `xy` (N, 2) to draw: one for each `PATH_POINTS`-th of the path, at least first and last."""
    if len(xy) <= PATH_POINTS:
        return np.arange(len(xy))
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    stretch = np.floor(path / max(path[-1], 1e-9) * (PATH_POINTS - 2))
    return np.unique(np.concatenate([[0], np.flatnonzero(np.diff(stretch) > 0) + 1, [len(xy) - 1]]))


def millimetres(xy: FloatArray) -> list[int]:
    """Return positions (N, 2) as x0 y0 and then the steps, in whole millimetres."""
    whole = np.round(1000 * np.asarray(xy)).astype(np.int64)
    return list(np.diff(whole, axis=0, prepend=np.zeros((1, 2), dtype=np.int64)).ravel().tolist())


def graph_layers(stored: StoredGraph) -> dict[str, Any]:
    """Return keyframes, every loop candidate with what became of it, and the matches of overlaps."""
    graph = stored.graph
    squared = chi2(graph)
    first = len(graph) - 1
    accepted = dict(zip(stored.record_of.tolist(), squared[first : first + len(stored.record_of)], strict=True))
    rejected = [row for row, record in enumerate(stored.records) if not record.accepted]
    shown = sorted([*accepted, *rejected[-REJECTED_SHOWN:]])
    return {
        "nodes": {"mm": millimetres(graph.poses[:, :2, -1]), "scan": np.diff(graph.index, prepend=0).tolist()},
        "loops": loop_rows([stored.records[row] for row in shown], [accepted.get(row) for row in shown], graph),
        "loops_left_out": len(stored.records) - len(shown),
        "overlaps": overlap_rows(graph, squared),
        "overlaps_total": int((graph.constraints.kind == ConstraintKind.OVERLAP).sum()),
    }


def loop_rows(
    records: Sequence[LoopRecord], squared: Sequence[float | None], graph: PoseGraph
) -> Mapping[str, list[Any]]:
    """Return the candidates column by column; `squared` is the chi-square of those that are in the graph."""
    kinds = list(dict.fromkeys(record.kind for record in records))
    reasons = list(dict.fromkeys(record.reason for record in records))
    sigmas = gaussian_sigmas(np.array([np.nan if each is None else each for each in squared]), graph.group.dof)
    return {
        "kinds": kinds,
        "reasons": reasons,
        "i": [record.target for record in records],
        "j": [record.source for record in records],
        "kind": [kinds.index(record.kind) for record in records],
        "reason": [reasons.index(record.reason) for record in records],
        "accepted": [int(record.accepted) for record in records],
        "sigma": [rounded(sigma, 2) for sigma in sigmas.tolist()],
        "moved_m": [rounded(record.error_before_m, 2) for record in records],
        "moved_deg": [rounded(np.degrees(record.error_before_rad), 1) for record in records],
        "matched": [rounded(record.matched_fraction, 2) for record in records],
        "rmse_mm": [rounded(1000 * record.rmse_m, 0) for record in records],
    }


def overlap_rows(graph: PoseGraph, squared: FloatArray) -> dict[str, list[Any]]:
    """Return the worst of the overlaps: keyframes i, j and distance from the solution in sigmas."""
    rows = np.flatnonzero(graph.constraints.kind == ConstraintKind.OVERLAP)
    worst = rows[np.argsort(-squared[rows], kind="stable")[:OVERLAPS_SHOWN]]
    rows = np.sort(worst)
    c = graph.constraints
    sigmas = np.round(gaussian_sigmas(squared[rows], graph.group.dof), 1)
    return {"i": c.i[rows].tolist(), "j": c.j[rows].tolist(), "sigma": sigmas.tolist()}


def rounded(value: float, digits: int) -> float | None:
    """Return a number for JSON: rounded, None where it is not finite, whole where no digit is kept."""
    if not np.isfinite(value):
        return None
    return round(float(value), digits) if digits else round(value)
