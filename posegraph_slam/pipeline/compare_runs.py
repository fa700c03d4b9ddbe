"""Several runs side by side: errors where the truth is known, and how good their maps look where it is not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.datasets.trajectory_files import read_trajectory
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.summary import TrajectoryMetrics, evaluate_trajectory
from posegraph_slam.evaluation.tables import ComparisonRow, ComparisonTable
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.archive import read_occupancy
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.mapping.quality import MapQuality, map_quality
from posegraph_slam.pipeline.evaluate import Reference
from posegraph_slam.pipeline.run_directory import StoredRun, read_run_directory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ComparedRun:
    """One run: its name, trajectory, map (None where it has none) and figures of merit."""

    name: str
    run: StoredRun
    trajectory: Trajectory
    occupancy: OccupancyGrid | None
    quality: MapQuality | None
    measured: TrajectoryMetrics | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunComparison:
    """The runs, their table (a column a run), and remarks on what makes them hard to compare."""

    runs: tuple[ComparedRun, ...]
    table: ComparisonTable
    remarks: tuple[str, ...]

    @property
    def best(self) -> str | None:
        """Name of the run of the first rank; None where no map can be ranked."""
        ranks = next((row.values for row in self.table.rows if row.name == RANK), None)
        if ranks is None:
            return None
        known = [(rank, run.name) for rank, run in zip(ranks, self.runs, strict=True) if rank is not None]
        return min(known)[1] if known else None

    def as_dict(self) -> dict[str, Any]:
        """Return the table for JSON, with the folders, the best run and the remarks."""
        folders = {each.name: str(each.run.folder) for each in self.runs}
        return {**self.table.as_dict(), "runs": folders, "best": self.best, "remarks": list(self.remarks)}


RANK = "rank by map"
RANKED: tuple[tuple[str, bool], ...] = (("crispness", True), ("entropy_bits", False), ("double_walls", False))
"""The figures of a map that rank it, and whether more is better. Thickness is left out: a map smeared all over has
thin walls."""
STORED: tuple[tuple[str, str, int, tuple[str, ...]], ...] = (
    ("APE position RMSE", "m", 4, ("ape", "translation_m", "rmse")),
    ("APE rotation mean", "deg", 3, ("ape", "rotation_deg", "mean")),
    ("relations position mean", "m", 4, ("relations", "all", "translation_m", "mean")),
    ("relations rotation mean", "deg", 3, ("relations", "all", "rotation_deg", "mean")),
    ("far relations position mean", "m", 4, ("relations", "far", "translation_m", "mean")),
    ("start-end gap", "m", 3, ("path", "start_end_gap_m")),
    ("path length", "m", 2, ("path", "length_m")),
)
QUALITY: tuple[tuple[str, str, int, str], ...] = (
    ("map crispness", "", 4, "crispness"),
    ("map entropy", "bits", 4, "entropy_bits"),
    ("double walls", "%", 2, "double_walls"),
    ("wall thickness", "m", 4, "wall_thickness_m"),
    ("wall area", "m2", 2, "wall_area_m2"),
)


def compare_runs(folders: Sequence[Path], *, reference: Reference | None = None) -> RunComparison:
    """Put runs side by side, best map first by mean rank of crispness, entropy and double walls.

    Errors are those that the runs recorded, or, with a `reference`, measured now. Raises InputError for a folder that
    is no run, and for fewer than two.
    """
    if len(folders) < 2:
        raise InputError("psg compare", f"was given {len(folders)} run", "name two or more run directories")
    names = distinct_names(folders)
    runs = tuple(_read(name, folder, reference) for name, folder in zip(names, folders, strict=True))
    rows = [
        *_rows(STORED, runs, lambda run, path: _lookup(_stage(run), path)),
        *_rows(QUALITY, runs, lambda run, name: None if run.quality is None else _quality(run.quality, name)),
        ComparisonRow(name=RANK, unit="", decimals=2, values=map_ranks([run.quality for run in runs])),
        ComparisonRow(name="time", unit="s", decimals=1, values=tuple(run.run.record.get("total_s") for run in runs)),
    ]
    known = tuple(row for row in rows if any(value is not None for value in row.values))
    return RunComparison(runs=runs, table=ComparisonTable(stages=names, rows=known), remarks=_remarks(runs))


def map_ranks(qualities: Sequence[MapQuality | None]) -> tuple[float | None, ...]:
    """Mean rank of each map over the figures of `RANKED`, 1 the best; equal figures share the mean of their ranks."""
    present = [quality for quality in qualities if quality is not None]
    if len(present) < 2:
        return tuple(None for _ in qualities)
    ranks = np.zeros(len(present))
    for name, more_is_better in RANKED:
        values = np.array([getattr(quality, name) for quality in present]) * (-1 if more_is_better else 1)
        below, equal = values[None, :] < values[:, None], values[None, :] == values[:, None]
        ranks += 1 + below.sum(axis=1) + (equal.sum(axis=1) - 1) / 2
    found = iter((ranks / len(RANKED)).tolist())
    return tuple(None if quality is None else next(found) for quality in qualities)


def distinct_names(folders: Sequence[Path]) -> tuple[str, ...]:
    """Return the last parts of the paths, with as many more before them as tell them apart."""
    parts = [folder.resolve().parts for folder in folders]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return tuple(names)
    raise InputError("psg compare", f"was given {folders[0]} twice", "name different run directories")


def _read(name: str, folder: Path, reference: Reference | None) -> ComparedRun:
    run = read_run_directory(folder)
    trajectory = read_trajectory(run.path("trajectory.tum"), parent="map")
    maps = folder / "maps" / "map.npz"
    occupancy = read_occupancy(maps) if maps.is_file() else None
    measured = None
    if reference is not None:
        measured = evaluate_trajectory(trajectory, truth=reference.trajectory, relations=reference.relations)
    quality = None if occupancy is None else map_quality(occupancy)
    return ComparedRun(
        name=name, run=run, trajectory=trajectory, occupancy=occupancy, quality=quality, measured=measured
    )


def _stage(run: ComparedRun) -> Mapping[str, Any]:
    """Return the metrics of a run's result: those measured now, or the last of the stages that it recorded."""
    if run.measured is not None:
        return run.measured.as_dict()
    stages: Mapping[str, Any] = run.run.metrics.get("stages", {})
    return stages[list(stages)[-1]] if stages else {}


def _lookup(values: Any, path: tuple[str, ...]) -> float | None:
    for name in path:
        values = values.get(name) if isinstance(values, Mapping) else None
    return float(values) if isinstance(values, int | float) else None


def _quality(quality: MapQuality, name: str) -> float:
    value = float(getattr(quality, name))
    return 100 * value if name == "double_walls" else value


def _rows(
    described: Any, runs: Sequence[ComparedRun], value: Callable[[ComparedRun, Any], float | None]
) -> list[ComparisonRow]:
    return [
        ComparisonRow(name=name, unit=unit, decimals=decimals, values=tuple(value(run, key) for run in runs))
        for name, unit, decimals, key in described
    ]


def _remarks(runs: Sequence[ComparedRun]) -> tuple[str, ...]:
    """Say what makes runs hard to compare: other logs, other map settings."""
    remarks = []
    if len({run.run.record.get("input", {}).get("sha256") for run in runs}) > 1:
        remarks.append("the runs are of different logs: compare errors, not maps")
    if len({run.run.configuration.mapping.model_dump_json() for run in runs}) > 1:
        remarks.append("the maps were built with different settings (mapping.*): their figures do not compare")
    return tuple(remarks)
