"""What a report shows of a run directory: whatever of the files of a run is there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from posegraph_slam.arrays import ByteArray
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.archive import read_occupancy
from posegraph_slam.mapping.images import read_image
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.pipeline.run_directory import LOOPS, StoredRun, read_run_directory
from posegraph_slam.pipeline.saving import TRAJECTORY_FILES
from posegraph_slam.pipeline.stored_graph import GRAPH, StoredGraph, read_stored_graph

OCCUPANCY, TEXTURE = "maps/map.npz", "maps/texture.png"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunContent:
    """A run called `name`: its records, trajectories by stage, and graph and maps where it has them.

    `texture` (rows, columns, 4) lies on the cells of `occupancy`, top row first.
    """

    name: str
    run: StoredRun
    trajectories: dict[str, Trajectory]
    stored: StoredGraph | None
    occupancy: OccupancyGrid | None
    texture: ByteArray | None


def read_run_content(folder: Path, *, name: str | None = None) -> RunContent:
    """Read a run of any command that leaves a run directory; `name` is its name while it is still being written.

    Raises InputError where `folder` is no run directory or one of its files cannot be read.
    """
    run = read_run_directory(folder)
    occupancy = read_occupancy(folder / OCCUPANCY) if (folder / OCCUPANCY).is_file() else None
    texture = read_image(folder / TEXTURE) if (folder / TEXTURE).is_file() else None
    if texture is not None and (
        occupancy is None or texture.shape != (*occupancy.geometry.shape, 4) or occupancy.geometry.yaw_rad
    ):
        texture = None
    has_graph = (folder / GRAPH).is_file() and (folder / LOOPS).is_file()
    return RunContent(
        name=name or folder.resolve().name,
        run=run,
        trajectories=read_stages(run),
        stored=read_stored_graph(run) if has_graph else None,
        occupancy=occupancy,
        texture=texture,
    )


def read_stages(run: StoredRun) -> dict[str, Trajectory]:
    """Read the trajectories that the run has, named as its comparison names them, least refined first."""
    stages = {
        stage: read_tum(run.folder / file, parent="map", child="base")
        for stage, file in TRAJECTORY_FILES.items()
        if (run.folder / file).is_file()
    }
    named = list(run.metrics.get("table", {}).get("stages") or [])
    if len(named) == len(stages):
        return dict(zip(named, stages.values(), strict=True))
    return {"estimate": next(iter(stages.values()))} if len(stages) == 1 else stages
