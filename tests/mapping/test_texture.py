"""Disparity formulas at values computed by hand, and a synthetic floor recovered in the right cells."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory, pose_from_xyt, spatial_from_planar
from posegraph_slam.mapping.depth_camera import Calibration, camera_point, colour_pixel, inverse_depth
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.texture import TextureSettings, build_texture, texture_pixels
from posegraph_slam.sensors import DisparityCalibration, RgbdFrames

C = Calibration.of(DisparityCalibration())
ROWS, COLUMNS = 480, 640
TILE_M = 0.5


def mounting() -> np.ndarray:
    """Camera at (0.18, 0.005, 0.36) m, looking down by 0.36 rad."""
    pitch = 0.36
    T = np.eye(4)
    T[:3, :3] = [[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]]
    T[:3, 3] = 0.18, 0.005, 0.36
    return T


def tile_colour(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The floor: tiles of half a metre, each of its own colour (..., 3)."""
    i, j = np.floor(x / TILE_M).astype(int), np.floor(y / TILE_M).astype(int)
    return np.stack([40 + 23 * (i % 9), 40 + 31 * (j % 7), 60 + 90 * ((i + j) % 2)], axis=-1).astype(np.uint8)


def rays(rows: np.ndarray, columns: np.ndarray, T_map_camera: np.ndarray) -> np.ndarray:
    """Directions in the map of colour pixels, for a depth of one along the optical axis."""
    right, down = (columns - 315.84) / 585.05, (rows - 242.94) / 585.05
    directions = np.stack(
        [np.ones(np.broadcast_shapes(right.shape, down.shape)), -right + 0 * down, -down + 0 * right], -1
    )
    return directions @ T_map_camera[:3, :3].T


def render_floor(T_map_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Disparity (16 bits) and RGB images of the plane z = 0.

    The colour pixel of a disparity pixel depends on its dd, and dd on the depth there: solve by fixed point.
    """
    i, j = np.arange(ROWS)[:, None] + 0.0, np.arange(COLUMNS)[None, :] + 0.0
    height = T_map_camera[2, 3]
    dd = np.full((ROWS, COLUMNS), 0.5)
    for _ in range(60):
        row = (526.37 * i + 19276 - 7877.07 * dd) / 585.051
        column = (526.37 * j + 16662) / 585.051
        slope = -rays(row, column, T_map_camera)[..., 2] / height  # 1 / depth
        dd = np.clip(1.03 * slope, 1e-3, 3)
    disparity = np.where(slope > 0.1, np.clip(np.round((3.31 - dd) / 0.00304), 0, 65535), 2047)
    direction = rays(i, j, T_map_camera)
    depth = np.where(direction[..., 2] < -1e-3, -height / np.minimum(direction[..., 2], -1e-3), 0.0)
    point = T_map_camera[:3, 3] + depth[..., None] * direction
    colour = np.where(depth[..., None] > 0, tile_colour(point[..., 0], point[..., 1]), np.uint8(255))
    return disparity.astype(np.uint16), colour


def planar_path(xyt: np.ndarray) -> Trajectory:
    return Trajectory(
        stamps_s=100 + np.arange(len(xyt), dtype=float), poses=pose_from_xyt(xyt), parent="map", child="base"
    )


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> tuple[RgbdFrames, Trajectory]:
    """Three frames of a robot that drives ahead and turns; the disparity clock runs between the poses."""
    folder = tmp_path_factory.mktemp("frames")
    path = planar_path(np.array([[0, 0, 0.0], [0.5, 0.1, 0.2], [0.9, 0.4, 0.9], [0.9, 0.4, 0.9]]))
    stamps = np.array([100.0, 101.0, 102.5])
    poses = spatial_from_planar(path.poses[[0, 1, 2]]) @ mounting()
    disparity, colour = [], []
    for k, T in enumerate(poses):
        images = render_floor(T)
        disparity.append(folder / f"disparity{k}.png")
        colour.append(folder / f"rgb{k}.png")
        cv2.imwrite(str(disparity[-1]), images[0])
        cv2.imwrite(str(colour[-1]), np.ascontiguousarray(images[1][..., ::-1]))
    frames = RgbdFrames(
        disparity_stamps_s=stamps, colour_stamps_s=stamps + 0.04, disparity_files=tuple(disparity),
        colour_files=tuple(colour), T_base_camera=mounting(),
    )  # fmt: skip
    return frames, path


def replaced(frames: RgbdFrames, **changes) -> RgbdFrames:
    names = ("disparity_stamps_s", "colour_stamps_s", "disparity_files", "colour_files", "T_base_camera")
    return RgbdFrames(**{**{name: getattr(frames, name) for name in names}, **changes})


def test_formulas_at_values_computed_by_hand():
    # d = 750: dd = 3.31 - 2.28 = 1.03, so the depth is one metre.
    dd = inverse_depth(750.0, C)
    assert dd == pytest.approx(1.03)
    assert C.depth_scale / dd == pytest.approx(1.0)
    # (526.37 * 100 + 19276 - 7877.07 * 1.03) / 585.051 = (52637 + 19276 - 8113.3821) / 585.051
    assert colour_pixel(100.0, 200.0, dd, C) == pytest.approx((63799.6179 / 585.051, 121936 / 585.051), rel=1e-12)
    assert camera_point(242.94 + 58.505, 315.84 - 117.01, 2.0, C) == pytest.approx((2.0, 0.4, -0.2))
    assert camera_point(242.94, 315.84, 3.0, C) == pytest.approx((3.0, 0.0, 0.0))


def test_floor_is_recovered_in_the_right_cells(drive):
    frames, path = drive
    texture = build_texture(frames, path)
    assert (texture.frames_used, texture.frames_skipped) == (3, 0)
    rows, columns = np.nonzero(texture.observed)
    assert len(rows) > 1000
    centres = texture.geometry.cell_to_world(np.column_stack([rows, columns]))
    # Cells well inside a tile: depth is quantised to 2 cm at 2.5 m, and a cell reaches 2.5 cm from its centre.
    from_edge = np.abs(centres / TILE_M - np.round(centres / TILE_M)).min(axis=1) * TILE_M
    inside = (from_edge > 0.1) & (np.linalg.norm(centres - path.positions[1], axis=1) < 2.5)
    assert inside.sum() > 400
    found = texture.colour[rows[inside], columns[inside]].astype(int)
    wrong = np.abs(found - tile_colour(*centres[inside].T)).max(axis=1)
    assert (wrong <= 2).mean() > 0.98
    # Nothing behind the first pose was seen, and what was not seen is black.
    assert centres[:, 0].min() > 0.3
    assert not texture.colour[~texture.observed].any()


def test_cells_of_the_occupancy_map_are_used_when_given(drive):
    geometry = GridGeometry.square(3.0, resolution_m=0.1)
    texture = build_texture(*drive, geometry=geometry)
    assert texture.geometry is geometry
    row, column = geometry.world_to_cell(np.array([1.25, 0.25]))
    assert texture.observed[row, column]
    assert np.abs(texture.colour[row, column].astype(int) - tile_colour(np.array(1.25), np.array(0.25))).max() <= 2


def test_result_does_not_depend_on_the_workers(drive, two_at_a_time, monkeypatch):
    monkeypatch.setattr("posegraph_slam.mapping.texture.FRAMES_A_PIECE", 1)
    calls = []
    one = build_texture(*drive, progress=lambda *call: calls.append(call))
    two = build_texture(*drive, executor=two_at_a_time)
    assert (one.colour == two.colour).all()
    assert (one.observed == two.observed).all()
    assert [call[1:] for call in calls] == [(1, 3), (2, 3), (3, 3)]


def test_pixels_put_north_at_the_top_and_holes_are_transparent(drive):
    texture = build_texture(*drive)
    pixels = texture_pixels(texture)
    assert pixels.shape == (*texture.geometry.shape, 4)
    assert ((pixels[::-1, :, 3] == 255) == texture.observed).all()
    assert ((pixels[::-1, :, 3] == 0) == ~texture.observed).all()
    assert (pixels[::-1, :, :3] == texture.colour).all()


def test_threshold_and_depth_limits_select_the_floor(drive):
    frames, path = drive
    assert not build_texture(frames, path, TextureSettings(floor_height_m=-0.1, floor_tilt_rad=0.0)).observed.any()
    near = build_texture(frames, path, TextureSettings(max_depth_m=1.5))
    assert 0 < near.observed.sum() < build_texture(frames, path).observed.sum()


def test_the_floor_rises_with_the_robot(drive):
    """On a path in space, 2 m up and tilted, the floor under the robot is the same floor."""
    frames, path = drive
    poses = spatial_from_planar(path.poses)
    lift = np.eye(4)
    lift[:3, :3] = [[math.cos(0.3), 0, -math.sin(0.3)], [0, 1, 0], [math.sin(0.3), 0, math.cos(0.3)]]
    lift[2, 3] = 2.0
    level, lifted = (
        build_texture(frames, Trajectory(stamps_s=path.stamps_s, poses=T, parent="map", child="base"))
        for T in (poses, lift @ poses)
    )
    share = lifted.observed.sum() / level.observed.sum()
    assert 0.9 < share / math.cos(0.3) < 1.1
    assert lifted.frames_used == 3


def test_frames_that_are_absent_or_far_in_time_are_skipped_and_counted(drive):
    frames, path = drive
    absent = replaced(frames, disparity_files=(None, *frames.disparity_files[1:]))
    assert build_texture(absent, path).frames_skipped == 1
    late = replaced(frames, colour_stamps_s=frames.colour_stamps_s + np.array([0, 0, 0.5]))
    texture = build_texture(late, path)
    assert (texture.frames_used, texture.frames_skipped) == (2, 1)
    without_pose = path.select(np.array([1, 2, 3]))
    assert build_texture(frames, without_pose).frames_skipped == 1
    single = replaced(frames, colour_stamps_s=frames.colour_stamps_s[:1], colour_files=frames.colour_files[:1])
    assert build_texture(single, path).frames_used == 1
    assert build_texture(frames, path, TextureSettings(frame_stride=2)).frames_used == 2
    with pytest.raises(InputError, match="none of 3 disparity frames"):
        build_texture(replaced(frames, colour_stamps_s=frames.colour_stamps_s + 60), path)
    with pytest.raises(InputError, match="no image files"):
        build_texture(replaced(frames, colour_files=(None, None, None)), path)


def test_unusable_images_are_skipped_and_named(drive, tmp_path):
    frames, path = drive
    whole = Path(frames.disparity_files[0]).read_bytes()
    bad = tmp_path / "bad.png"
    with_bad = replaced(frames, disparity_files=(bad, *frames.disparity_files[1:]))
    for content in (b"", b"no image", whole[:200], whole[: len(whole) // 2], Path(frames.colour_files[0]).read_bytes()):
        bad.write_bytes(content)
        texture = build_texture(with_bad, path)
        assert (texture.frames_used, texture.frames_skipped, texture.unreadable.count) == (2, 1, 1)
        assert "bad.png" in texture.unreadable.first
    bad.unlink()
    assert "bad.png: cannot be opened" in build_texture(with_bad, path).unreadable.first
    with pytest.raises(InputError, match=r"none of 3 can be read; the first: .*bad\.png: cannot be opened"):
        build_texture(replaced(frames, disparity_files=(bad, bad, bad)), path)
    bad.write_bytes(whole)
    with pytest.raises(InputError, match="not 8-bit colour"):
        build_texture(replaced(frames, colour_files=(bad, bad, bad)), path)


def test_contradicting_settings_are_refused():
    for wrong in ({"min_depth_m": 6.0}, {"floor_height_m": -0.6}, {"max_gap_s": 0}, {"nonsense": 1}):
        with pytest.raises(ValidationError):
            TextureSettings(**wrong)
