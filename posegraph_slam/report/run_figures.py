"""The pictures of one run, drawn into its directory."""

from __future__ import annotations

import numpy as np

from posegraph_slam.geometry import SE3
from posegraph_slam.pipeline.jobs import JobResult
from posegraph_slam.pipeline.optimize_rgbd import RgbdResult
from posegraph_slam.pipeline.run_directory import RunDirectory
from posegraph_slam.pose_graph.graph import ConstraintKind
from posegraph_slam.report.figures import draw_floor, draw_map, draw_texture, draw_trajectories, loop_segments
from posegraph_slam.report.rgbd_figures import draw_rgbd_figures
from posegraph_slam.report.space_figure import draw_heights


def draw_figures(result: JobResult, directory: RunDirectory) -> None:
    """Draw the trajectories of the stages, the map with its loops, the rejected ones too, and the texture if any.

    Files: figures/trajectories.png, figures/heights.png of poses in space, figures/map.png,
    figures/map_rejected.png, figures/texture.png, figures/floor.png; those of an RGB-D log are in `draw_rgbd_figures`.
    """
    if isinstance(result, RgbdResult):
        draw_rgbd_figures(result, directory)
        return
    draw_trajectories(result.stages, directory.path("figures/trajectories.png"), truth=result.truth)
    if result.trajectory.group is SE3:
        draw_heights(result.stages, directory.path("figures/heights.png"), truth=result.truth)
    if result.occupancy is None:
        return
    positions = result.graph.poses[:, :-1, -1]
    constraints = result.graph.constraints
    # matches of overlapping keyframes are everywhere: they would hide the map and the closures
    loops = loop_segments(positions, constraints.select(constraints.kind != int(ConstraintKind.OVERLAP)))
    draw_map(result.occupancy, directory.path("figures/map.png"), trajectory=result.trajectory, loops=loops)
    if len(result.rejected_pairs):
        draw_map(
            result.occupancy,
            directory.path("figures/map_rejected.png"),
            trajectory=result.trajectory,
            loops=loops,
            rejected=np.asarray(positions[result.rejected_pairs][..., :2]),
        )
    maps = result.depth_maps
    walls = result.occupancy.occupied
    if maps.texture is not None:
        draw_texture(
            maps.texture.geometry,
            maps.texture.colour,
            maps.texture.observed,
            directory.path("figures/texture.png"),
            trajectory=result.trajectory,
            occupied=walls if maps.texture.geometry is result.occupancy.geometry else None,
        )
    if maps.alone is not None:
        draw_floor(maps.alone, directory.path("figures/floor.png"), trajectory=result.trajectory, occupied=walls)
