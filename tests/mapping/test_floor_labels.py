"""Floor labels against slow oracles, and on planes, boxes and walls whose truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from posegraph_slam.mapping.depth_camera import Calibration, DepthView, camera_point, colour_pixel, depth_image
from posegraph_slam.mapping.floor_labels import (
    FLOOR,
    OBSTACLE,
    OTHER,
    UNLABELLED,
    label_ground,
    label_height_range,
    label_plane,
    pitched_camera,
)
from posegraph_slam.mapping.floor_settings import GroundSettings, HeightRangeSettings, PlaneSettings
from posegraph_slam.sensors import DisparityCalibration

SHAPE = (120, 160)
CALIBRATION = DisparityCalibration()
VIEW = DepthView(down=(np.arange(120) - 60) / 146, right=(np.arange(160) - 80) / 146, shift_m=-0.024)


def mounting(pitch: float, height: float, roll: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T[:3, 3] = 0.18, 0.005, height
    return T


def points_of(depth: np.ndarray, view: DepthView, T: np.ndarray) -> np.ndarray:
    """Points (H, W, 3), one pixel after another as the class describes them."""
    z = depth.astype(np.float64)
    camera = np.stack([z, -z * view.right, -z * view.down[:, None] - view.shift_m], axis=-1)
    return camera @ T[:3, :3].T + T[:3, 3]


def see(T: np.ndarray, planes: list[tuple[np.ndarray, float]], view: DepthView = VIEW) -> np.ndarray:
    """Depth (H, W) of the nearest of some planes n . X = d, 0 where none lies ahead."""
    origin = T[:3, 3] + T[:3, :3] @ [0.0, 0.0, -view.shift_m]
    rays = np.stack(np.broadcast_arrays(1.0, -view.right, -view.down[:, None]), axis=-1) @ T[:3, :3].T
    depth = np.full(rays.shape[:2], np.inf)
    for normal, offset in planes:
        with np.errstate(divide="ignore"):
            hit = (offset - origin @ normal) / (rays @ normal)
        depth = np.where(hit > 0, np.minimum(depth, hit), depth)
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)


GROUND = np.array([0.0, 0.0, 1.0]), 0.0


def scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth with noise and holes over a floor and a wall, and the pose of the camera in base and map."""
    rng = np.random.default_rng(seed)
    T = mounting(rng.uniform(0.2, 0.6), rng.uniform(0.3, 1.2), rng.uniform(-0.1, 0.1), rng.uniform(-3, 3))
    heading = T[:3, 0] * [1, 1, 0] / np.linalg.norm(T[:2, 0])
    wall = heading, heading @ T[:3, 3] + rng.uniform(0.8, 3.0)
    depth = see(T, [GROUND, wall]) * (1 + 0.01 * rng.standard_normal(SHAPE))
    depth[rng.random(SHAPE) < 0.05] = 0
    return depth.astype(np.float32), T


def oracle_ranges(depth: np.ndarray, T: np.ndarray, s: HeightRangeSettings, highest: float) -> np.ndarray:
    """Heights collected cell by cell in a dictionary."""
    points = points_of(depth, VIEW, T)
    cells: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j in np.ndindex(*depth.shape):
        if s.min_depth_m <= depth[i, j] <= s.max_depth_m and points[i, j, 2] <= highest:
            key = math.floor(points[i, j, 0] / s.cell_m), math.floor(points[i, j, 1] / s.cell_m)
            cells.setdefault(key, []).append((i, j))
    labels = np.zeros(depth.shape, dtype=np.uint8)
    for pixels in cells.values():
        heights = [points[pixel][2] for pixel in pixels]
        spread = max(heights) - min(heights)
        for pixel in pixels if len(pixels) >= s.min_points else []:
            labels[pixel] = FLOOR if spread <= s.floor_range_m else OBSTACLE if spread >= s.obstacle_range_m else OTHER
    return labels


@settings(max_examples=6)
@given(seed=st.integers(0, 10_000))
def test_height_ranges_are_those_of_a_dictionary_of_cells(seed):
    depth, T = scene(seed)
    chosen = HeightRangeSettings(cell_m=0.08, floor_range_m=0.03, obstacle_range_m=0.15, min_points=4)
    found, wanted = label_height_range(depth, VIEW, T, chosen, highest_m=0.9), oracle_ranges(depth, T, chosen, 0.9)
    assert (found != wanted).mean() < 1e-3  # a point on the border of two cells may fall into either
    assert {FLOOR, OBSTACLE} <= set(np.unique(found))


def test_one_point_is_not_floor():
    depth = np.zeros(SHAPE, dtype=np.float32)
    T = mounting(0.36, 0.36)
    whole = see(T, [GROUND])
    depth[110, 80] = whole[110, 80]
    assert not label_height_range(depth, VIEW, T).any()
    depth[108:113, 78:83] = whole[108:113, 78:83]
    assert (label_height_range(depth, VIEW, T) == FLOOR).any()
    with pytest.raises(ValueError, match="min_points"):
        HeightRangeSettings(min_points=1)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_ground_labels_are_those_of_transformed_points(seed):
    depth, T = scene(seed)
    chosen, clearance = GroundSettings(), 0.6
    height = points_of(depth, VIEW, T)[..., 2]
    used = (depth >= np.float32(0.5)) & (depth <= 5)
    wanted = np.select([height < -0.1, height <= 0.1, height <= clearance], [OTHER, FLOOR, OBSTACLE], UNLABELLED)
    found = label_ground(depth, VIEW, T, chosen, clearance_m=clearance)
    sure = (np.abs(np.abs(height) - 0.1) > 1e-6) & (np.abs(height - clearance) > 1e-6)
    np.testing.assert_array_equal(found[sure], np.where(used, wanted, UNLABELLED)[sure])


@given(pitch=st.floats(-0.5, 1.2), head=st.floats(0.3, 1.6), above=st.floats(0, 0.3), seed=st.integers(0, 99))
def test_pitched_camera_gives_the_plane_of_the_report(pitch, head, above, seed):
    T = pitched_camera(np.array([pitch]), head, above)[0]
    x, y, z = np.random.default_rng(seed).normal(size=3)  # optical frame: right, down, ahead
    normal = Rotation.from_rotvec([pitch, 0, 0]).as_matrix() @ [0, 1, 0]
    signed = normal @ [x, y, z] - head - above * math.cos(pitch)  # of the report, positive below the ground
    np.testing.assert_allclose((T @ [z, -x, -y, 1])[2], -signed, atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


@settings(max_examples=25)
@given(
    pitch=st.floats(0.25, 0.6), height=st.floats(0.3, 0.9), tilt=st.floats(-0.2, 0.2), roll=st.floats(-0.15, 0.15),
    seed=st.integers(0, 10_000),
)  # fmt: skip
def test_ransac_finds_the_tilted_floor_beside_a_wall(pitch, height, tilt, roll, seed):
    """A floor that tilts by up to 11 degrees, noise in 1 / depth, a wall ahead, and a tenth of the pixels wrong."""
    rng = np.random.default_rng(seed)
    T = mounting(pitch, height)
    up = Rotation.from_euler("yx", [tilt, roll]).as_matrix()[:, 2]
    wall = np.array([-1.0, 0.0, 0.0]), -2.0
    exact = see(T, [(up, 0.0), wall])
    depth = np.where(exact > 0, 1 / (1 / np.maximum(exact, 0.1) + 0.002 * rng.standard_normal(SHAPE)), 0)
    wrong = rng.random(SHAPE) < 0.1
    depth[wrong] = rng.uniform(0.4, 3.0, wrong.sum())
    if ((depth[90:] >= 0.4) & (depth[90:] <= 3.0)).sum() < 2000:
        return
    found = label_plane(depth.astype(np.float32), VIEW, T, PlaneSettings(max_step_m=0.5), rng=np.random.default_rng(1))
    assert found.plane is not None
    normal = T[:3, :3] @ found.plane[:3]
    assert math.degrees(math.acos(min(1.0, normal @ up))) < 0.5
    assert abs(found.plane[3] - T[:3, 3] @ up) < 0.006
    distance = points_of(depth, VIEW, T) @ up
    sure = (depth > 0.4) & (depth < 3)
    assert (found.labels[sure & (np.abs(distance) < 0.015)] == FLOOR).all()
    assert (found.labels[sure & (np.abs(distance) > 0.045)] != FLOOR).all()
    bottom = np.arange(SHAPE[0])[:, None] >= 90
    assert (found.labels[sure & bottom & (distance > 0.045)] == OBSTACLE).all()
    assert not (found.labels[:90] == OBSTACLE).any()


def test_a_wall_that_fills_the_view_is_no_floor():
    T = mounting(0.36, 0.36)
    depth = see(T, [(np.array([-1.0, 0.0, 0.0]), -0.7)])
    found = label_plane(depth, VIEW, T, rng=np.random.default_rng(0))
    assert found.plane is None
    assert not found.labels.any()
    assert found.inliers > 0.99  # it is a fine plane, but it stands
    table = see(T, [(np.array([0.0, 0.0, 1.0]), -0.5)])
    assert label_plane(table, VIEW, T, rng=np.random.default_rng(0)).plane is None


def test_frames_with_too_little_depth_say_nothing():
    T, rng = mounting(0.36, 0.36), np.random.default_rng(0)
    for depth in (np.zeros(SHAPE, np.float32), np.full(SHAPE, np.nan, np.float32), np.full(SHAPE, 9.0, np.float32)):
        assert not label_plane(depth, VIEW, T, rng=rng).labels.any()
        assert not label_height_range(depth, VIEW, T).any()
        assert not label_ground(depth, VIEW, T).any()
    line = np.zeros(SHAPE, np.float32)
    line[119] = see(T, [GROUND])[119]  # one row of pixels spans no plane
    assert label_plane(line, VIEW, T, rng=rng).plane is None


def test_the_same_generator_gives_the_same_labels():
    depth, T = scene(3)
    first, again = (label_plane(depth, VIEW, T, rng=np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first.labels, again.labels)
    assert first.inliers == again.inliers


@settings(max_examples=10)
@given(row=st.integers(0, 479), column=st.integers(0, 639), disparity=st.integers(400, 1050))
def test_a_disparity_image_is_a_pinhole_image(row, column, disparity):
    """Points by `DepthView` are those of the report's own formulas for the colour pixel and the depth."""
    image = np.full((480, 640), disparity, dtype=np.float32)
    depth = depth_image(image, CALIBRATION)[row, column]
    view, c = DepthView.of(CALIBRATION, (480, 640)), Calibration.of(CALIBRATION)
    dd = 3.31 - 0.00304 * disparity
    wanted = camera_point(*colour_pixel(row, column, dd, c), 1.03 / dd, c)
    x, y, z = depth, -view.right[column] * depth, -view.down[row] * depth - view.shift_m
    np.testing.assert_allclose((x, y, z), wanted, rtol=1e-5, atol=1e-6)
