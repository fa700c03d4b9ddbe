"""The maps that a depth camera adds: the floor map, and the laser's map with the floor's evidence in it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from posegraph_slam.execution import Executor, Progress
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.floor_map import FloorLabeller, FloorMap, build_floor, fuse_floor
from posegraph_slam.mapping.floor_settings import FloorMethod, FloorSettings
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.mapping.texture import TextureMap, build_texture
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.sensors import RgbdFrames, RobotLog


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthMaps:
    """Texture and floor on the cells of the occupancy map, each None where it was not asked for or has no images.

    `alone` is what the depth camera says by itself, `fused` the laser's map with it. `without_images`: a floor map was
    asked for, but there is no depth image.
    """

    texture: TextureMap | None = None
    floor: FloorMap | None = None
    alone: OccupancyGrid | None = None
    fused: OccupancyGrid | None = None
    without_images: bool = False

    @property
    def remarks(self) -> tuple[str, ...]:
        """What became of frames that could not be used."""
        return tuple(_remarks(self))


def build_depth_maps(
    log: RobotLog,
    trajectory: Trajectory,
    occupancy: OccupancyGrid | None,
    configuration: Configuration,
    *,
    executor: Executor,
    progress: Progress,
) -> DepthMaps:
    """Build the texture map and, where `floor.method` asks for it, the floor map of a log with images.

    Both share the cells of `occupancy`; without it there are none.
    """
    settings, texture, floor = configuration.floor, None, None
    wanted = settings.method is not FloorMethod.NONE and occupancy is not None
    if occupancy is None or log.rgbd is None:
        return DepthMaps(without_images=wanted)
    if log.rgbd.has_images:
        texture = build_texture(
            log.rgbd,
            trajectory,
            configuration.texture,
            geometry=occupancy.geometry,
            labeller=_labeller(log.rgbd, configuration),
            executor=executor,
            progress=progress,
        )
    if wanted and any(log.rgbd.disparity_files):
        floor = build_floor(
            log.rgbd,
            trajectory,
            settings,
            occupancy.geometry,
            seed=configuration.seed,
            executor=executor,
            progress=progress,
        )
    return DepthMaps(
        texture=texture,
        floor=floor,
        alone=None if floor is None else floor.grid(settings),
        fused=None if floor is None else fuse_floor(occupancy, floor, settings),
        without_images=wanted and floor is None,
    )


def _labeller(frames: RgbdFrames, configuration: Configuration) -> FloorLabeller | None:
    if configuration.floor.method is FloorMethod.NONE:
        return None
    return FloorLabeller(settings=configuration.floor, T_base_camera=frames.T_base_camera, seed=configuration.seed)


def floor_step(settings: FloorSettings) -> str:
    """Return in words how the floor would be found, for a plan of the run."""
    return {
        FloorMethod.NONE: "",
        FloorMethod.HEIGHT_RANGE: "tell floor from obstacles by the range of heights in each cell",
        FloorMethod.PLANE: "tell floor from obstacles by a RANSAC plane in each depth image",
        FloorMethod.GROUND: "tell floor from obstacles by the camera's known height and pitch",
    }[settings.method]


def _remarks(maps: DepthMaps) -> Iterable[str]:
    if maps.without_images:
        yield "no floor map: floor.method asks for one, but the log has no depth images"
    if maps.texture is not None and maps.texture.unreadable.count:
        bad = maps.texture.unreadable
        yield f"the texture map leaves out {bad.count} frames that cannot be read; the first: {bad.first}"
    if maps.floor is not None and maps.floor.unreadable.count:
        bad = maps.floor.unreadable
        yield f"the floor map leaves out {bad.count} depth images that cannot be read; the first: {bad.first}"
    if maps.floor is not None and maps.floor.frames_without_floor:
        of = maps.floor.frames_without_floor + maps.floor.frames_used
        yield f"{maps.floor.frames_without_floor} of {of} depth images show no floor"
