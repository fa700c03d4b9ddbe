"""Writing what a run found into its directory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.loop_closure.ledger import LoopRecord
from posegraph_slam.mapping.archive import write_occupancy
from posegraph_slam.mapping.images import write_png
from posegraph_slam.mapping.nav2 import map_pixels, write_nav2
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.mapping.texture import texture_pixels
from posegraph_slam.pipeline.matching_file import MATCHING, write_matching
from posegraph_slam.pipeline.optimize import OptimizationResult
from posegraph_slam.pipeline.run_directory import LOOPS, METRICS, RunDirectory
from posegraph_slam.pose_graph.g2o import write_g2o

TRAJECTORY_FILES = {"odometry": "odometry.tum", "scan matching": "scan_matching.tum", "optimised": "trajectory.tum"}
"""File of each stage's trajectory: a pose of the body at every scan stamp."""


def save_run(result: OptimizationResult, directory: RunDirectory) -> None:
    """Write trajectories, graph, loop candidates, metrics and maps; docs/run_directory.md describes the files."""
    for stage, name in TRAJECTORY_FILES.items():
        write_tum(result.stages[stage], directory.path(name))
    write_matching(result.matched, directory.path(MATCHING))
    write_g2o(result.graph, directory.path("graph.g2o"))
    save_loops(result, directory)
    directory.write_json(METRICS, {"table": result.comparison.as_dict(), **result.metrics})
    save_maps(result, directory)


def save_loops(result: OptimizationResult, directory: RunDirectory) -> None:
    """Write every loop candidate of a run with laser scans."""
    write_loops(result.loops, result.keyframes, result.trajectory.stamps_s[result.keyframes], directory)


def write_loops(
    loops: Sequence[LoopRecord],
    keyframes: IntArray,
    stamps_s: FloatArray,
    directory: RunDirectory,
    *,
    record: type[LoopRecord] = LoopRecord,
    unit: str = "scan",
) -> None:
    """Write every loop candidate, named by keyframe, `unit` and stamp, with its evidence and what became of it.

    `keyframes` (K,) are numbers of scans or frames, taken at `stamps_s` (K,); the columns are the fields of `record`.
    """
    names = [field.name for field in fields(record)]
    header = [f"target_{unit}", f"source_{unit}", "target_stamp_s", "source_stamp_s", *names]
    rows = (
        [
            keyframes[loop.target],
            keyframes[loop.source],
            stamps_s[loop.target],
            stamps_s[loop.source],
            *(getattr(loop, name) for name in names),
        ]
        for loop in loops
    )
    directory.write_rows(LOOPS, header, rows)


def save_maps(result: OptimizationResult, directory: RunDirectory) -> None:
    """Write the occupancy map, and the texture and floor maps where there are any.

    `map` is the laser's occupancy map, `floor` what the depth camera says of the floor, `map_with_floor` the two
    together, each for nav2, for eyes and exactly; all have the same cells.
    """
    maps = result.depth_maps
    for name, grid in (("map", result.occupancy), ("floor", maps.alone), ("map_with_floor", maps.fused)):
        if grid is not None:
            save_occupancy(grid, directory, name)
    if maps.texture is not None:
        write_png(texture_pixels(maps.texture), directory.path("maps/texture.png"))


def save_occupancy(occupancy: OccupancyGrid, directory: RunDirectory, name: str = "map") -> None:
    """Write a map of occupancy for nav2, for eyes and exactly, as maps/NAME.*."""
    folder = directory.path(f"maps/{name}.pgm").parent
    write_nav2(occupancy, folder, name)
    write_png(map_pixels(occupancy), folder / f"{name}.png")
    write_occupancy(occupancy, folder / f"{name}.npz")
