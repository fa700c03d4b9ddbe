"""Votes of frames against a slow count, the map over files, and its evidence beside the laser's."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from posegraph_slam.datasets.ece276a import T_BASE_CAMERA
from posegraph_slam.datasets.simulation import LidarSettings, camera, demo_settings, simulate_run
from posegraph_slam.errors import ConfigurationError, InputError
from posegraph_slam.geometry import Trajectory, spatial_from_planar
from posegraph_slam.mapping.depth_camera import DepthView, cell_coordinates
from posegraph_slam.mapping.depth_frames import Unreadable
from posegraph_slam.mapping.floor_labels import FLOOR, OBSTACLE, OTHER
from posegraph_slam.mapping.floor_map import FloorLabeller, FloorMap, add_labels, build_floor, fuse_floor
from posegraph_slam.mapping.floor_settings import FloorMethod, FloorSettings, GroundSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.sensors import DisparityCalibration, RgbdFrames

CALIBRATION = DisparityCalibration()
TIMES_S = np.array([3.0, 12.0, 25.0, 41.0, 44.0, 47.0])
METHODS = [FloorMethod.HEIGHT_RANGE, FloorMethod.PLANE, FloorMethod.GROUND]


@pytest.fixture(scope="module")
def run():
    return simulate_run(demo_settings(lidar=LidarSettings(beams=11, rate_hz=1.0)))


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory) -> tuple[RgbdFrames, Trajectory]:
    """Disparity frames of the simulated drive, without colour images, and the true path."""
    folder, rng = tmp_path_factory.mktemp("frames"), np.random.default_rng(4)
    files = []
    for k, xyt in enumerate(run.motion.xyt_at(TIMES_S)):
        depth, _ = camera.render_depth(camera.disparity_view(CALIBRATION), run.world, xyt)
        files.append(folder / f"{k}.png")
        cv2.imwrite(str(files[-1]), camera.disparity_image(depth, CALIBRATION, run.settings.kinect, rng))
    frames = RgbdFrames(
        disparity_stamps_s=TIMES_S, colour_stamps_s=np.empty(0), disparity_files=tuple(files), colour_files=(),
        T_base_camera=T_BASE_CAMERA,
    )  # fmt: skip
    times = np.arange(0.0, 60.0, 0.02)
    poses = spatial_from_planar(run.motion.poses_at(times))
    return frames, Trajectory(stamps_s=times, poses=poses, parent="map", child="base")


@pytest.fixture(scope="module")
def geometry(run) -> GridGeometry:
    ends = np.array([run.world.lower_m, run.world.upper_m])
    return GridGeometry.around(ends, resolution_m=0.05, margin_m=0.5)


def distance_to_obstacles(run, points: np.ndarray) -> np.ndarray:
    """Distance of points (n, 2) from the nearest obstacle of the world."""
    a, b = run.world.segments[:, :2], run.world.segments[:, 2:]
    along = b - a
    offset = points[:, None] - a
    t = np.clip((offset * along).sum(-1) / (along**2).sum(-1), 0, 1)
    lines = np.linalg.norm(offset - t[..., None] * along, axis=-1).min(axis=1)
    circles = np.abs(np.linalg.norm(points[:, None] - run.world.circles[:, :2], axis=-1) - run.world.circles[:, 2])
    return np.minimum(lines, circles.min(axis=1, initial=np.inf))


@pytest.mark.parametrize("method", METHODS)
def test_floor_and_obstacles_lie_where_the_world_has_them(run, recorded, geometry, method):
    floor = build_floor(*recorded, FloorSettings(method=method), geometry)
    assert (floor.frames_used, floor.frames_skipped, floor.frames_without_floor) == (6, 0, 0)
    for kind, count in ((0, 5000), (1, 0 if method is FloorMethod.PLANE else 200)):
        cells = np.argwhere(floor.votes[..., kind] > floor.votes[..., 1 - kind])
        assert len(cells) >= count
        gap = distance_to_obstacles(run, geometry.cell_to_world(cells)) if len(cells) else np.full(1, 0.05)
        # a cell of 0.05 m, and noise of depth: 0.01 m at 3 m and 0.03 m at 5 m
        assert kind == 0 or (gap < (0.15 if method is FloorMethod.GROUND else 0.06)).mean() > 0.98
        assert kind == 1 or (gap > 0.025).mean() > 0.97


@settings(max_examples=12)
@given(seed=st.integers(0, 10_000), min_pixels=st.integers(1, 6))
def test_votes_are_those_of_a_slow_count(seed, min_pixels):
    rng = np.random.default_rng(seed)
    shape = (24, 32)
    view = DepthView(down=np.linspace(-0.4, 0.4, 24), right=np.linspace(-0.5, 0.5, 32), shift_m=0.02)
    depth = rng.uniform(0.5, 2.0, shape).astype(np.float32)
    labels = rng.integers(0, 4, shape).astype(np.uint8)
    T = np.array(T_BASE_CAMERA)
    grid = GridGeometry(
        origin_m=rng.uniform(-0.5, 1.0, 2), resolution_m=0.1, shape=(14, 17), yaw_rad=rng.uniform(-1, 1)
    )
    votes = np.zeros((14, 17, 2), dtype=np.int64)
    add_labels(labels, depth, cell_coordinates(view, T, grid.cells_from_map), farthest_m=2.0,
               min_pixels=min_pixels, votes=votes)  # fmt: skip
    counts = np.zeros((14, 17, 4), dtype=int)
    for i, j in np.ndindex(*shape):
        z = float(depth[i, j])
        point = T[:3, :3] @ [z, -view.right[j] * z, -view.down[i] * z - view.shift_m] + T[:3, 3]
        row, column = grid.world_to_cell(point[:2])
        if 0 <= row < 14 and 0 <= column < 17:
            counts[row, column, labels[i, j]] += 1
    enough = counts[..., 1:].sum(axis=-1) >= min_pixels
    floor = enough & (counts[..., FLOOR] > counts[..., OBSTACLE] + counts[..., OTHER])
    obstacle = enough & ~floor & (counts[..., OBSTACLE] > 0) & (counts[..., OBSTACLE] >= counts[..., FLOOR])
    np.testing.assert_array_equal(votes, np.stack([floor, obstacle], axis=-1))


def test_result_does_not_depend_on_the_workers(recorded, geometry, two_at_a_time, monkeypatch):
    monkeypatch.setattr("posegraph_slam.mapping.floor_map.FRAMES_A_PIECE", 1)
    calls = []
    chosen = FloorSettings(method=FloorMethod.PLANE)
    one = build_floor(*recorded, chosen, geometry, progress=lambda *call: calls.append(call))
    two = build_floor(*recorded, chosen, geometry, executor=two_at_a_time)
    np.testing.assert_array_equal(one.votes, two.votes)
    assert [call[1:] for call in calls] == [(k, 6) for k in range(1, 7)]


def test_files_that_are_absent_or_broken_are_skipped_and_named(recorded, geometry, tmp_path):
    frames, path = recorded
    bad = tmp_path / "bad.png"
    bad.write_bytes(Path(frames.disparity_files[0]).read_bytes()[:500])
    chosen = FloorSettings(method=FloorMethod.GROUND)
    broken = dataclasses.replace(frames, disparity_files=(None, bad, *frames.disparity_files[2:]))
    floor = build_floor(broken, path, chosen, geometry)
    assert (floor.frames_used, floor.frames_skipped, floor.unreadable.count) == (4, 2, 1)
    assert str(bad) in floor.unreadable.first
    with pytest.raises(InputError, match=r"none of 6 can be read; the first: .*bad\.png"):
        build_floor(dataclasses.replace(frames, disparity_files=(bad,) * 6), path, chosen, geometry)
    with pytest.raises(InputError, match="no image files"):
        build_floor(dataclasses.replace(frames, disparity_files=(None,) * 6), path, chosen, geometry)
    with pytest.raises(ConfigurationError, match=r"floor\.method: is none"):
        build_floor(frames, path, FloorSettings(), geometry)


def test_frames_that_show_a_wall_alone_cast_no_vote(recorded, geometry, tmp_path):
    frames, path = recorded
    disparity = np.full((480, 640), round((1.03 / 0.6 - 3.31) / -0.00304), dtype=np.uint16)  # all at 0.6 m
    cv2.imwrite(str(tmp_path / "wall.png"), disparity)
    walled = dataclasses.replace(frames, disparity_files=(tmp_path / "wall.png", *frames.disparity_files[1:]))
    floor = build_floor(walled, path, FloorSettings(method=FloorMethod.PLANE), geometry)
    assert (floor.frames_used, floor.frames_without_floor) == (5, 1)


def grids(floor_votes: int, obstacle_votes: int, laser: float) -> tuple[OccupancyGrid, FloorMap]:
    """One cell as the laser and as the depth camera see it."""
    geometry = GridGeometry(origin_m=np.zeros(2), resolution_m=0.05, shape=(1, 1))
    occupancy = OccupancyGrid(
        geometry=geometry, log_odds=np.full((1, 1), laser, np.float32), observed=np.full((1, 1), laser != 0)
    )
    labeller = FloorMap(
        geometry=geometry, votes=np.array([[[floor_votes, obstacle_votes]]]), frames_used=1, frames_skipped=0,
        frames_without_floor=0, unreadable=Unreadable(),
    )  # fmt: skip
    return occupancy, labeller


@pytest.mark.parametrize(
    ("floor", "obstacle", "laser", "state"),
    [
        (1, 0, 0.0, "unknown"),  # one frame alone is not floor
        (2, 0, 0.0, "free"),
        (100, 0, 5.5, "occupied"),  # floor under a table does not undo what the laser is sure of
        (100, 0, 1.4, "free"),
        (0, 100, -5.5, "occupied"),  # a box below the laser's plane
        (0, 1, -5.5, "free"),
        (0, 0, 5.5, "occupied"),
    ],
)
def test_evidence_moves_the_laser_map(floor, obstacle, laser, state):
    chosen = FloorSettings(method=FloorMethod.GROUND)
    fused = fuse_floor(*grids(floor, obstacle, laser), chosen)
    found = "occupied" if fused.occupied[0, 0] else "free" if fused.free[0, 0] else "unknown"
    assert found == state


def test_maps_on_other_cells_are_not_fused(recorded, geometry):
    occupancy, _ = grids(1, 0, 0.0)
    floor = build_floor(*recorded, FloorSettings(method=FloorMethod.GROUND), geometry)
    with pytest.raises(InputError, match="does not lie on the cells"):
        fuse_floor(occupancy, floor, FloorSettings(method=FloorMethod.GROUND))


def test_a_labeller_uses_the_keys_of_its_method(recorded):
    near = FloorSettings(method=FloorMethod.GROUND, ground=GroundSettings(max_depth_m=1.0))
    labeller = FloorLabeller(settings=near, T_base_camera=T_BASE_CAMERA)
    assert labeller.farthest_m == 1.0
    view = DepthView.of(CALIBRATION, (480, 640))
    depth = np.full((480, 640), 1.5, dtype=np.float32)
    assert not labeller.labels(depth, view, T_BASE_CAMERA, 0).any()
