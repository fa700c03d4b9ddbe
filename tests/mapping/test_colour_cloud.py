"""Fusing coloured depth images into a cloud, and the thickness of its surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.datasets.ply import read_ply, write_ply
from posegraph_slam.errors import InputError
from posegraph_slam.mapping.colour_cloud import ColourCloudSettings, fuse_cloud
from posegraph_slam.mapping.surface_thickness import surface_cells, upward_direction
from posegraph_slam.pipeline.executors import make_executor

CAMERA = np.array([60.0, 60.0, 39.5, 29.5])
SETTINGS = ColourCloudSettings(voxel_m=0.05)


def wall(distance_m: float, colour: tuple[int, int, int] = (200, 100, 50)):
    """Frames of a wall straight ahead."""
    depth = np.full((60, 80), round(1000 * distance_m), np.uint16)
    image = np.zeros((60, 80, 3), np.uint8)
    image[:] = colour
    return lambda k: (image, depth)


def steps(count: int, step_m: float = 0.0) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = step_m * np.arange(count)
    return poses


def test_a_wall_is_a_plane_of_its_colour() -> None:
    cloud = fuse_cloud(wall(2.0), steps(3), CAMERA, SETTINGS, depth_units_per_m=1000)
    np.testing.assert_allclose(cloud.points[:, 2], 2.0, atol=0.05 / 1024)
    assert (cloud.colours == [200, 100, 50]).all()
    # 78 x 58 inner pixels in each of three frames, all on the wall
    assert cloud.counts.sum() == 3 * 78 * 58
    keys = np.floor(cloud.points / 0.05).astype(int)
    assert len(np.unique(keys, axis=0)) == len(cloud), "one point a voxel"


def test_the_mean_of_a_voxel_is_that_of_its_points() -> None:
    rng = np.random.default_rng(0)
    depth = rng.integers(1990, 2010, (60, 80)).astype(np.uint16)
    image = rng.integers(0, 255, (60, 80, 3)).astype(np.uint8)
    settings = ColourCloudSettings(voxel_m=0.1, points_min=1)
    cloud = fuse_cloud(lambda k: (image, depth), steps(1), CAMERA, settings, depth_units_per_m=1000)
    z = depth[1:-1, 1:-1] / 1000.0
    v, u = np.mgrid[1:59, 1:79]
    points = np.stack([(u - 39.5) / 60 * z, (v - 29.5) / 60 * z, z], axis=-1).reshape(-1, 3)
    keys = np.floor(points / 0.1).astype(int)
    inside = (keys == np.floor(cloud.points[10] / 0.1).astype(int)).all(axis=1)
    assert cloud.counts[10] == inside.sum()
    np.testing.assert_allclose(cloud.points[10], points[inside].mean(axis=0), atol=2e-3)
    colours = image[1:-1, 1:-1].reshape(-1, 3)[inside].mean(axis=0)
    np.testing.assert_allclose(cloud.colours[10], colours, atol=2)


def test_neither_order_nor_workers_change_a_byte() -> None:
    poses = steps(40, 0.01)
    one = fuse_cloud(wall(2.0), poses, CAMERA, SETTINGS, depth_units_per_m=1000)
    back = fuse_cloud(wall(2.0), poses[::-1], CAMERA, SETTINGS, depth_units_per_m=1000)
    with make_executor(3) as executor:  # type: ignore[union-attr]
        three = fuse_cloud(wall(2.0), poses, CAMERA, SETTINGS, depth_units_per_m=1000, executor=executor)
    for other in (back, three):
        assert other.points.tobytes() == one.points.tobytes()
        assert other.colours.tobytes() == one.colours.tobytes()


def test_every_point_of_every_frame_counts_once() -> None:
    settings = ColourCloudSettings(voxel_m=0.05, points_min=1)
    cloud = fuse_cloud(wall(2.0), steps(40, 0.07), CAMERA, settings, depth_units_per_m=1000)
    assert cloud.counts.sum() == 40 * 78 * 58
    keys = np.floor(cloud.points / 0.05).astype(int)
    assert len(np.unique(keys, axis=0)) == len(cloud), "one point a voxel"


def test_voxels_are_widened_to_bound_memory() -> None:
    fine = ColourCloudSettings(voxel_m=0.01, voxels_max=1000, points_min=1)
    cloud = fuse_cloud(wall(2.0), steps(3), CAMERA, fine, depth_units_per_m=1000)
    assert len(cloud) <= 1000
    assert cloud.voxel_m > 0.01
    coarse = ColourCloudSettings(voxel_m=cloud.voxel_m, points_min=1)
    same = fuse_cloud(wall(2.0), steps(3), CAMERA, coarse, depth_units_per_m=1000)
    assert len(same) == len(cloud)
    np.testing.assert_allclose(same.points, cloud.points, atol=1e-4)


def test_edges_slants_and_far_points_are_left_out() -> None:
    depth = np.full((60, 80), 1500, np.uint16)
    depth[:, 40:] = 3000
    depth[:5] = 5000
    image = np.zeros((60, 80, 3), np.uint8)
    cloud = fuse_cloud(lambda k: (image, depth), steps(1), CAMERA, SETTINGS, depth_units_per_m=1000)
    z = cloud.points[:, 2]
    assert ((np.abs(z - 1.5) < 1e-3) | (np.abs(z - 3.0) < 1e-3)).all(), "nothing floats between the two walls"
    # nor is a column next to the jump taken: 39 + 38 of 78 columns, 53 rows under the far strip
    assert cloud.counts.sum() <= 53 * 76
    with pytest.raises(InputError, match="no voxel"):
        fuse_cloud(wall(6.0), steps(1), CAMERA, SETTINGS, depth_units_per_m=1000)


def test_the_ply_file_holds_points_and_colours(tmp_path) -> None:
    cloud = fuse_cloud(wall(2.0), steps(1), CAMERA, SETTINGS, depth_units_per_m=1000)
    path = tmp_path / "cloud.ply"
    write_ply(cloud.points, path, colours=cloud.colours)
    np.testing.assert_allclose(read_ply(path), cloud.points, atol=1e-6)
    content = path.read_bytes()
    assert b"property uchar red" in content
    assert content.endswith(cloud.colours[-1].tobytes())
    assert len(content.partition(b"end_header\n")[2]) == 15 * len(cloud)


def test_surfaces_that_frames_place_apart_are_thick() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 1, (20_000, 2))
    frames = np.repeat([0, 1], 10_000)
    crisp = np.column_stack([xy, np.full(20_000, 0.05)])
    apart = crisp + np.array([0, 0, 0.01]) * frames[:, None]
    thin, thick = surface_cells(crisp, frames), surface_cells(apart, frames)
    assert thin.median_m < 1e-9
    assert thick.median_m == pytest.approx(0.005, rel=0.05)
    np.testing.assert_allclose(np.abs(thick.normals[:, 2]), 1, atol=1e-2)
    assert len(surface_cells(crisp, np.zeros(20_000, dtype=np.int64)).thickness_m) == 0, (
        "one frame cannot disagree with itself"
    )
    up = upward_direction(thick, np.array([0.3, 0.2, 1.0]))
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-2)


def test_fuses_the_frames_that_are_asked_for() -> None:
    chosen = fuse_cloud(wall(2.0), steps(5), CAMERA, SETTINGS, depth_units_per_m=1000, frames=np.array([0, 1, 2]))
    first = fuse_cloud(wall(2.0), steps(5)[:3], CAMERA, SETTINGS, depth_units_per_m=1000)
    np.testing.assert_array_equal(chosen.points, first.points)
    np.testing.assert_array_equal(chosen.counts, first.counts)
