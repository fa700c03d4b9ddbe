"""The floor map: where the depth camera saw floor and where obstacles, frame by frame, on the cells of a grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray, IntArray, read_only
from posegraph_slam.errors import ConfigurationError, InputError
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress, split_range
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.depth_camera import DepthView, Linear, cell_coordinates, depth_image
from posegraph_slam.mapping.depth_frames import (
    FRAMES_A_PIECE,
    DepthFrames,
    Unreadable,
    each_disparity,
    require_readable,
    usable_frames,
)
from posegraph_slam.mapping.floor_kernels import cast_votes, count_labels
from posegraph_slam.mapping.floor_labels import label_ground, label_height_range, label_plane
from posegraph_slam.mapping.floor_settings import FloorMethod, FloorSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.sensors import DisparityCalibration, RgbdFrames


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloorMap:
    """Votes (R, C, 2): how many frames saw each cell as [floor, obstacle].

    `frames_used` were labelled; `frames_skipped` had no file, could not be read or no pose near in time;
    `frames_without_floor` showed no plausible plane and cast no vote.
    """

    geometry: GridGeometry
    votes: IntArray
    frames_used: int
    frames_skipped: int
    frames_without_floor: int
    unreadable: Unreadable

    def __post_init__(self) -> None:
        votes = read_only(self.votes, np.int64)
        if votes.shape != (*self.geometry.shape, 2):
            raise InputError("floor map", f"votes {votes.shape} do not fit the grid {self.geometry.shape}")
        object.__setattr__(self, "votes", votes)

    def log_odds(self, settings: FloorSettings) -> FloatArray:
        """Return the evidence (R, C) of all frames: obstacle votes raise it, floor votes lower it, within limits."""
        evidence = self.votes[..., 1] * settings.obstacle_log_odds - self.votes[..., 0] * settings.floor_log_odds
        return np.asarray(np.clip(evidence, settings.min_log_odds, settings.max_log_odds), dtype=np.float64)

    def grid(self, settings: FloorSettings) -> OccupancyGrid:
        """Return what the depth camera alone says, as a grid of occupancy: floor is free."""
        observed = np.asarray(self.votes.any(axis=2))
        return OccupancyGrid(
            geometry=self.geometry, log_odds=np.where(observed, self.log_odds(settings), 0.0), observed=observed
        )


def fuse_floor(occupancy: OccupancyGrid, floor: FloorMap, settings: FloorSettings) -> OccupancyGrid:
    """Return the laser's map with its log-odds lowered where the floor was seen and raised at obstacles.

    Both must lie on the same cells. Source: report of ESE 650 project 3, section III.B.
    """
    if floor.geometry.shape != occupancy.geometry.shape or not np.array_equal(
        floor.geometry.cells_from_map, occupancy.geometry.cells_from_map
    ):
        raise InputError("floor map", "does not lie on the cells of the occupancy map", "build it with its geometry")
    seen = floor.votes.any(axis=2)
    return OccupancyGrid(
        geometry=occupancy.geometry,
        log_odds=np.where(seen, occupancy.log_odds + floor.log_odds(settings), occupancy.log_odds),
        observed=occupancy.observed | seen,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloorLabeller:
    """Labels frames of one camera by the method of `settings`; a value that goes to workers.

    `T_base_camera` (4, 4) mounts the camera; `seed` and the number of a frame make its generator, so that the labels
    of a frame do not depend on the frames before it.
    """

    settings: FloorSettings
    T_base_camera: FloatArray
    seed: int = 0

    def __post_init__(self) -> None:
        if self.settings.method is FloorMethod.NONE:
            raise ConfigurationError("floor.method", "is none", "choose height_range, plane or ground")

    @property
    def farthest_m(self) -> float:
        """Largest depth that gets a label."""
        chosen = self.settings
        by_method = {
            FloorMethod.HEIGHT_RANGE: chosen.height_range.max_depth_m,
            FloorMethod.PLANE: chosen.plane.max_depth_m,
            FloorMethod.GROUND: chosen.ground.max_depth_m,
        }
        return by_method[chosen.method]

    def labels(self, depth_m: Float32Array, view: DepthView, T_map_camera: FloatArray, number: int) -> ByteArray:
        """Return the labels (H, W) of frame `number`, seen from `T_map_camera` (4, 4)."""
        chosen, clearance = self.settings, self.settings.clearance_m
        if chosen.method is FloorMethod.PLANE:
            rng = np.random.default_rng([self.seed, number])
            return label_plane(depth_m, view, self.T_base_camera, chosen.plane, rng=rng, clearance_m=clearance).labels
        if chosen.method is FloorMethod.GROUND:
            return label_ground(depth_m, view, self.T_base_camera, chosen.ground, clearance_m=clearance)
        camera_from_base = np.linalg.inv(self.T_base_camera)
        base_height = float(T_map_camera[2] @ camera_from_base[:, 3])
        return label_height_range(depth_m, view, T_map_camera, chosen.height_range, highest_m=base_height + clearance)


def add_labels(
    labels: ByteArray,
    depth_m: Float32Array,
    cells: Linear,
    *,
    farthest_m: float,
    min_pixels: int,
    votes: IntArray,
) -> None:
    """Add the verdict of one labelled frame on every cell to `votes` (R, C, 2) [floor, obstacle], in place.

    `cells` are the `cell_coordinates` of the frame on the grid of the votes; no label lies beyond `farthest_m`. A cell
    with at least `min_pixels` labelled pixels is floor where most of them are, and an obstacle where obstacles are at
    least as many as floor; a frame has one vote a cell.
    """
    corner, size = cells.window_on((votes.shape[0], votes.shape[1]), farthest_m)
    counts = np.zeros((*size, 3), dtype=np.int64)
    count_labels(depth_m, labels, *cells, corner, counts)
    cast_votes(counts, min_pixels, corner, votes)


def build_floor(
    frames: RgbdFrames,
    trajectory: Trajectory,
    settings: FloorSettings,
    geometry: GridGeometry,
    *,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
) -> FloorMap:
    """Return where `frames` show floor and obstacles from `trajectory` (T_map_base), on the cells of `geometry`.

    Frames are read one at a time, so that memory does not grow with the log; votes are whole numbers, so that neither
    do they depend on the workers. Files that cannot be read are skipped and counted. Raises InputError where no frame
    can be used, and ConfigurationError where no method is chosen.
    """
    executor = executor or SerialExecutor()
    labeller = FloorLabeller(settings=settings, T_base_camera=frames.T_base_camera, seed=seed)
    work, offered = usable_frames(
        frames, trajectory, max_gap_s=settings.max_gap_s, stride=settings.frame_stride, colour=False
    )
    add = partial(_vote, labeller=labeller, geometry=geometry, calibration=frames.calibration)
    votes, blind, unreadable = np.zeros((*geometry.shape, 2), dtype=np.int64), 0, Unreadable()
    pieces = work.pieces(FRAMES_A_PIECE)
    for start, stop in split_range(len(pieces), max(1, executor.workers)):
        for part, without_floor, bad in executor.map(add, pieces[start:stop]):
            votes, blind, unreadable = votes + part, blind + without_floor, unreadable + bad
        progress("floor map", min(stop * FRAMES_A_PIECE, len(work)), len(work))
    require_readable(len(work), unreadable)
    return FloorMap(
        geometry=geometry,
        votes=votes,
        frames_used=len(work) - unreadable.count - blind,
        frames_skipped=offered - len(work) + unreadable.count,
        frames_without_floor=blind,
        unreadable=unreadable,
    )


def _vote(
    piece: DepthFrames, *, labeller: FloorLabeller, geometry: GridGeometry, calibration: DisparityCalibration
) -> tuple[IntArray, int, Unreadable]:
    """Votes (R, C, 2) of some frames, how many of them showed no floor or obstacle, and what could not be read."""
    votes = np.zeros((*geometry.shape, 2), dtype=np.int64)
    unreadable: list[str] = []
    blind = 0
    for k, disparity in each_disparity(piece, unreadable):
        depth, view = depth_image(disparity, calibration), DepthView.of(calibration, disparity.shape)
        labels = labeller.labels(depth, view, piece.T_map_camera[k], piece.number[k])
        blind += not labels.any()
        cells = cell_coordinates(view, piece.T_map_camera[k], geometry.cells_from_map)
        add_labels(labels, depth, cells, farthest_m=labeller.farthest_m,
                   min_pixels=labeller.settings.min_pixels, votes=votes)  # fmt: skip
    return votes, blind, Unreadable(count=len(unreadable), first=unreadable[0] if unreadable else "")
