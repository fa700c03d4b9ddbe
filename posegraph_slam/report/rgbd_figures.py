"""The figures of an RGB-D run: the camera's path with its loops, and the cloud from above, from a side, and before."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from posegraph_slam.arrays import ByteArray, FloatArray
from posegraph_slam.geometry import Trajectory, pose_from_rotation_translation
from posegraph_slam.pipeline.optimize_rgbd import RgbdResult
from posegraph_slam.pipeline.run_directory import RunDirectory
from posegraph_slam.report.canvas import GREY, page
from posegraph_slam.report.figures import PIXELS, draw_path, draw_segments, draw_trajectories, loop_segments
from posegraph_slam.report.view import bounds_around

PIXELS_ACROSS = 1400
"""Longer side of a picture of the cloud in pixels."""
HEADROOM_M = 0.3
"""Seen from above, what lies this much over the highest camera is cut away: it is the ceiling."""
EDGE_SHARE = 0.002
"""Share of the points on each side that may lie outside of a picture."""


def draw_rgbd_figures(result: RgbdResult, directory: RunDirectory) -> None:
    """Draw path, loops and cloud in a frame whose z axis is up and whose y axis is where the camera looked first.

    Files: figures/trajectories.png, figures/loops.png, figures/cloud_above.png, figures/cloud_side.png,
    figures/before_above.png and figures/after_above.png: the same points placed by odometry and by the optimum.
    """
    T_view_map = upright_frame(result.upward, result.trajectory.poses[0])
    stages = {name: _moved(trajectory, T_view_map) for name, trajectory in result.stages.items()}
    draw_trajectories(stages, directory.path("figures/trajectories.png"), truth=result.truth)
    _draw_loops(result, stages["optimised"], T_view_map, directory.path("figures/loops.png"))
    top = float(stages["optimised"].positions[:, 2].max()) + HEADROOM_M
    if result.cloud is not None:
        points, size = _placed(result.cloud.points, T_view_map), result.cloud.voxel_m
        low = points[:, 2] < top
        above, side = directory.path("figures/cloud_above.png"), directory.path("figures/cloud_side.png")
        draw_cloud(points[low], result.cloud.colours[low], above, pixel_m=size, path_over=stages["optimised"])
        seen = points[:, [0, 2, 1]] * [1, 1, -1]  # along the first view: the nearest points last
        draw_cloud(seen, result.cloud.colours, side, pixel_m=size, up="height [m]")
    for stage, name in (("odometry", "before"), ("optimised", "after")):
        points = _placed(result.samples[stage], T_view_map)
        points = points[points[:, 2] < top]
        draw_cloud(points, _height_colours(points[:, 2]), directory.path(f"figures/{name}_above.png"), title=stage)


def upright_frame(upward: FloatArray, T_map_camera: FloatArray) -> FloatArray:
    """Return T_view_map (4, 4): z along `upward`, y along the camera's view as far as it is level."""
    z = upward / np.linalg.norm(upward)
    ahead = T_map_camera[:3, 2] - z * (z @ T_map_camera[:3, 2])
    if np.linalg.norm(ahead) < 1e-3:  # looking straight down or up: the image's vertical is as good
        ahead = T_map_camera[:3, 1] - z * (z @ T_map_camera[:3, 1])
    y = ahead / np.linalg.norm(ahead)
    R = np.stack([np.cross(y, z), y, z])
    return pose_from_rotation_translation(R, np.zeros(3))


def draw_cloud(
    points: FloatArray,
    colours: ByteArray,
    path: Path,
    *,
    pixel_m: float = 0.01,
    title: str = "",
    path_over: Trajectory | None = None,
    up: str = "y [m]",
) -> None:
    """Draw points (n, 3) seen against their third axis: of those on one pixel, the one of the largest third coordinate.

    A few points far outside of the others are left out. `path_over` is drawn over the cloud; `up` names
    the vertical axis.
    """
    if len(points) == 0:
        return
    low, high = np.quantile(points[:, :2], [EDGE_SHARE, 1 - EDGE_SHARE], axis=0)
    if path_over is not None:
        xy = path_over.positions[:, :2]
        low, high = np.minimum(low, xy.min(axis=0)), np.maximum(high, xy.max(axis=0))
    left, right, bottom, top = bounds_around(np.stack([low, high]), margin=0.03)
    size = max(pixel_m, max(right - left, top - bottom) / PIXELS_ACROSS)
    shape = int(np.ceil((top - bottom) / size)), int(np.ceil((right - left) / size))
    columns = np.floor((points[:, 0] - left) / size).astype(np.int64)
    rows = np.floor((points[:, 1] - bottom) / size).astype(np.int64)
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    order = np.flatnonzero(inside)[np.argsort(points[inside, 2], kind="stable")]
    picture = np.full((*shape, 3), 255, dtype=np.uint8)
    picture[rows[order], columns[order]] = colours[order]
    extent = (left, left + shape[1] * size, bottom, bottom + shape[0] * size)
    with page(path, extent, title=title) as axes:
        axes.imshow(picture, origin="lower", extent=extent, **PIXELS)
        axes.set_ylabel(up)
        if path_over is not None:
            draw_path(axes, path_over)


def _moved(trajectory: Trajectory, T: FloatArray) -> Trajectory:
    return trajectory.with_poses(T @ trajectory.poses)


def _placed(points: FloatArray, T: FloatArray) -> FloatArray:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _height_colours(heights: FloatArray) -> ByteArray:
    """Shades (n, 3) from dark blue below to orange above."""
    low, high = np.quantile(heights, [0.02, 0.98]) if len(heights) else (0.0, 1.0)
    share = np.clip((heights - low) / max(high - low, 1e-6), 0, 1)[:, None]
    colours: ByteArray = np.rint((1 - share) * np.array([0, 60, 120]) + share * np.array([230, 140, 0])).astype(
        np.uint8
    )
    return colours


def _draw_loops(result: RgbdResult, trajectory: Trajectory, T: FloatArray, path: Path) -> None:
    """Draw keyframes, accepted closures by kind and rejected candidates in the plan view."""
    positions = (T @ result.graph.poses)[:, :3, 3]
    with page(path, bounds_around(trajectory.positions[:, :2])) as axes:
        axes.grid(color="0.92", linewidth=0.6)
        axes.set_axisbelow(True)
        for k, pair in enumerate(result.rejected_pairs):
            label = f"rejected ({len(result.rejected_pairs)})" if k == 0 else None
            axes.plot(positions[pair, 0], positions[pair, 1], color=GREY, linewidth=0.5, linestyle=":", label=label)
        for kind, segments in loop_segments(positions, result.graph.constraints).items():
            draw_segments(axes, segments, kind)
        draw_path(axes, trajectory)
