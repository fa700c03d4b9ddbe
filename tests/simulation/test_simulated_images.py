"""Disparity and colour images agree with the camera's formulas and with the world."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.datasets.ece276a import T_BASE_CAMERA
from posegraph_slam.datasets.simulation import KinectSettings, camera, demo_settings, simulate_run
from posegraph_slam.datasets.simulation.floor import build_floor
from posegraph_slam.geometry import pose_from_xyt, spatial_from_planar, transform_points
from posegraph_slam.sensors import DisparityCalibration

CALIBRATION = DisparityCalibration()


@pytest.fixture(scope="module")
def run():
    return simulate_run(demo_settings())


@pytest.fixture(scope="module")
def floor(run):
    return build_floor(run.world, run.settings.world, 0.02, np.random.default_rng(0))


def back_project(rows, columns, disparity):
    """Points (n, 3) in the base frame and colour pixels of disparity pixels, written from the report's formulas."""
    dd = 3.31 - 0.00304 * disparity
    depth = 1.03 / dd
    u = (526.37 * rows + 19276 - 7877.07 * dd) / 585.051
    v = (526.37 * columns + 16662) / 585.051
    optical = np.stack([(v - 315.84) / 585.05 * depth, (u - 242.94) / 585.05 * depth, depth], axis=-1)
    regular = np.stack([optical[:, 2], -optical[:, 0], -optical[:, 1]], axis=-1)
    return transform_points(T_BASE_CAMERA, regular), u, v


@pytest.mark.parametrize("time_s", [1.0, 12.0, 25.0, 47.0])
def test_floor_pixels_back_project_onto_the_floor_with_its_colour(run, floor, time_s):
    rng = np.random.default_rng(5)
    xyt = run.motion.xyt_at(np.array([time_s]))[0]
    depth, seen = camera.render_depth(camera.disparity_view(CALIBRATION), run.world, xyt)
    exact = (CALIBRATION.depth_scale / depth - CALIBRATION.dd_offset) / CALIBRATION.dd_slope
    image = camera.render_colour(camera.colour_view(CALIBRATION), run.world, floor, xyt)
    rows, columns = np.nonzero((seen == -1) & (depth < 4))
    picked = rng.choice(len(rows), 3000, replace=False)
    points, u, v = back_project(rows[picked], columns[picked], exact[rows[picked], columns[picked]])
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-9)
    world = transform_points(spatial_from_planar(pose_from_xyt(xyt)), points)[:, :2]
    inside = (u > -0.5) & (u < 479.5)
    got = image[np.rint(u[inside]).astype(int), np.rint(v[inside]).astype(int)]
    right = (got == floor.colour_at(world[inside])).all(axis=1)
    assert inside.mean() > 0.9
    assert right.mean() > 0.97  # half a colour pixel of rounding at the borders of tiles


def test_disparity_image_is_whole_and_empty_outside_its_range(run):
    xyt = run.motion.xyt_at(np.array([30.0]))[0]
    depth, seen = camera.render_depth(camera.disparity_view(CALIBRATION), run.world, xyt)
    settings = KinectSettings(range_max_m=3.0)
    image = camera.disparity_image(depth, CALIBRATION, settings, np.random.default_rng(0))
    assert image.dtype == np.uint16
    assert ((image == 0) == ((depth < 0.5) | (depth >= 3.0))).all()
    rows, columns = np.nonzero((seen == -1) & (image > 0))
    points, _, _ = back_project(rows, columns, image[rows, columns].astype(float))
    assert abs(np.median(points[:, 2])) < 0.003
    assert np.abs(points[:, 2]).max() < 0.05


def test_walls_stand_where_the_plan_has_them(run):
    xyt = run.motion.xyt_at(np.array([40.0]))[0]
    depth, seen = camera.render_depth(camera.disparity_view(CALIBRATION), run.world, xyt)
    exact = (CALIBRATION.depth_scale / depth - CALIBRATION.dd_offset) / CALIBRATION.dd_slope
    count = len(run.world.segments)
    rows, columns = np.nonzero((seen >= 0) & (seen < count))
    points, _, _ = back_project(rows, columns, exact[rows, columns])
    assert points[:, 2].min() > -1e-6
    world = transform_points(spatial_from_planar(pose_from_xyt(xyt)), points)[:, :2]
    ends = run.world.segments[seen[rows, columns]]
    along, offset = ends[:, 2:] - ends[:, :2], world - ends[:, :2]
    gap = np.abs(along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0]) / np.linalg.norm(along, axis=1)
    assert len(rows) > 1000
    assert gap.max() < 1e-6


def test_nothing_nearer_is_missed(run):
    """A slow oracle casts single pixels against every obstacle."""
    rng = np.random.default_rng(2)
    view = camera.colour_view(CALIBRATION)
    xyt = run.motion.xyt_at(np.array([44.0]))[0]
    depth, _ = camera.render_depth(view, run.world, xyt)
    T = spatial_from_planar(pose_from_xyt(xyt))
    centre = transform_points(T, view.centre_m[None])[0]
    ends = run.world.segments
    for i, j in np.column_stack([rng.integers(0, 480, 300), rng.integers(0, 640, 300)]):
        d = T[:3, :3] @ view.directions[i, j]
        expected = -centre[2] / d[2] if d[2] < 0 else np.inf
        edge = ends[:, 2:] - ends[:, :2]
        offset = ends[:, :2] - centre[:2]
        slope = d[0] * edge[:, 1] - d[1] * edge[:, 0]
        t = (offset[:, 0] * edge[:, 1] - offset[:, 1] * edge[:, 0]) / slope
        u = (offset[:, 0] * d[1] - offset[:, 1] * d[0]) / slope
        expected = min(expected, t[(t > 0) & (u >= 0) & (u <= 1)].min(initial=np.inf))
        for x, y, radius in run.world.circles:
            o = centre[:2] - [x, y]
            a, b, c = d[:2] @ d[:2], d[:2] @ o, o @ o - radius**2
            if b * b >= a * c and b < 0:
                expected = min(expected, (-b - np.sqrt(b * b - a * c)) / a)
        assert depth[i, j] == pytest.approx(expected, rel=1e-9)
