"""The parts of the loop one at a time: surfaces, association, rejection, steps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, SE3, Group, align_points
from posegraph_slam.registration.cloud import Cloud, prepare_cloud
from posegraph_slam.registration.downsampling import EVEN_SHARE, shape_of_neighbourhoods, thin_scan_lines
from posegraph_slam.registration.icp import has_settled
from posegraph_slam.registration.pairing import (
    Association,
    Pairs,
    by_tree,
    by_voxel_hash,
    is_reciprocal,
    normal_angle_test,
    place,
    trimming_test,
)
from posegraph_slam.registration.residuals import PointToPlane, PointToPoint, linearise, plane_residuals
from posegraph_slam.registration.settings import IcpSettings

searches = pytest.mark.parametrize("search", [by_tree, by_voxel_hash])
spaces = pytest.mark.parametrize("group", [SE2, SE3], ids=["2d", "3d"])


@spaces
def test_surface_agrees_with_singular_values(group: Group) -> None:
    points = np.random.default_rng(0).normal(size=(60, group.dimension))
    cloud = prepare_cloud(points, neighbours=8)
    for row in range(0, 60, 7):
        nearest = np.argsort(np.linalg.norm(points - points[row], axis=1))[:8]
        around = points[nearest]
        _, S, Vt = np.linalg.svd(around - around.mean(axis=0))
        assert abs(Vt[-1] @ cloud.surface.normals[row]) == pytest.approx(1.0)
        assert cloud.surface.thickness_m[row] == pytest.approx(S[-1] / np.sqrt(8 - group.dimension))
        apart = cloud.surface.anchors[row] - around.mean(axis=0)  # twicing shifts anchors along the normals alone
        np.testing.assert_allclose(np.abs(apart @ Vt[-1]), np.linalg.norm(apart), atol=1e-12)


@spaces
def test_normals_of_a_round_thing_point_outward(group: Group) -> None:
    points = np.random.default_rng(0).normal(size=(3000, group.dimension))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    cosine = np.abs(np.sum(prepare_cloud(points + 5.0).surface.normals * points, axis=1))
    assert np.quantile(cosine, 0.01) > 0.99


def test_neighbours_on_one_scan_line_are_taken_from_farther_around() -> None:
    """On the floor, noise along the rays and a line span a thin cone, which is not the floor."""
    rng = np.random.default_rng(0)
    bearing, depression = np.meshgrid(np.linspace(-np.pi, np.pi, 900), np.radians([8.0, 10.0, 12.0, 14.0, 16.0, 18.0]))
    ranges = 1.5 / np.sin(depression) + rng.normal(0, 0.01, bearing.shape)
    rays = np.stack([np.cos(depression) * np.cos(bearing), np.cos(depression) * np.sin(bearing), -np.sin(depression)])
    cloud = prepare_cloud((rays * ranges).reshape(3, -1).T)
    surface = cloud.surface
    np.testing.assert_array_equal(surface.nearest[:, 0], np.arange(len(cloud)))
    assert np.mean(np.any(surface.neighbours != surface.nearest, axis=1)) > 0.9
    assert np.quantile(np.abs(surface.normals[:, 2]), 0.02) > np.cos(np.radians(3))
    even = prepare_cloud(rng.uniform(0, 1, (4000, 3)) * [4, 3, 0.01]).surface
    assert np.mean(np.any(even.neighbours != even.nearest, axis=1)) < 0.02


def test_dense_scan_lines_are_thinned_until_they_are_even() -> None:
    rng = np.random.default_rng(0)
    along, across = np.meshgrid(np.arange(0.0, 6.0, 0.01), np.arange(0.0, 6.0, 0.15))
    points = np.stack([along.ravel(), across.ravel(), np.zeros(along.size)], axis=1)
    thinned = thin_scan_lines(prepare_cloud(points + rng.normal(0, 0.002, points.shape)))
    assert len(np.unique(np.round(thinned.points[:, 1] / 0.15))) == 40  # all lines are left
    assert 3000 < len(thinned) < 8000
    assert shape_of_neighbourhoods(thinned)[0] <= EVEN_SHARE
    lost = np.vstack([points, [[3e6, 0.0, 0.0]]])
    assert len(thin_scan_lines(prepare_cloud(lost))) <= len(lost)  # a far outlier leaves the grid in its bounds
    for few_or_even in (prepare_cloud(points[::40]), prepare_cloud(rng.uniform(0, 1, (3000, 3)) * [6, 6, 0.01]),
                        prepare_cloud(points[:, :2])):  # fmt: skip
        assert thin_scan_lines(few_or_even) is few_or_even


@spaces
def test_fits_keep_their_digits_far_away(group: Group) -> None:
    points = np.random.default_rng(0).normal(size=(60, group.dimension)) * 0.1
    near, far = (prepare_cloud(points + shift).surface for shift in (0.0, 2.0**16))
    np.testing.assert_array_equal(near.neighbours, far.neighbours)
    np.testing.assert_allclose(far.thickness_m, near.thickness_m, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(far.normals * near.normals, axis=1)), 1.0, atol=1e-9)


def test_corners_are_trusted_less_than_walls() -> None:
    wall = np.column_stack([np.linspace(-2, 2, 200), np.zeros(200)])
    corner = np.column_stack([np.full(100, 2.0), np.linspace(0.02, 2, 100)])
    noise = np.random.default_rng(0).normal(scale=0.003, size=(300, 2))
    trust = prepare_cloud(np.vstack([wall, corner]) + noise).surface.trust
    assert trust[198:202].max() < 0.3
    assert np.median(trust) > 0.6


@spaces
@searches
@pytest.mark.parametrize("gate_m", [0.05, 0.6, 5.0])
def test_association_is_that_of_brute_force(
    group: Group, search: Callable[[Cloud, float], Association], gate_m: float
) -> None:
    rng = np.random.default_rng(1)
    source, target = rng.normal(size=(80, group.dimension)), rng.normal(size=(50, group.dimension))
    source[:10] = target[:10]  # some at distance zero before the motion, some of these on voxel faces
    scene = place(prepare_cloud(source), prepare_cloud(target), group.exp(np.full(group.dof, 0.2)))
    pairs = search(scene.target, gate_m)(scene.moved)
    distance = np.linalg.norm(scene.moved[:, None] - target[None], axis=2)
    inside = np.flatnonzero(distance.min(axis=1) <= gate_m)
    np.testing.assert_array_equal(pairs.source, inside)
    np.testing.assert_array_equal(pairs.target, distance.argmin(axis=1)[inside])
    np.testing.assert_allclose(pairs.distance_m, distance.min(axis=1)[inside])
    backward = distance.argmin(axis=0)[pairs.target] == pairs.source
    np.testing.assert_array_equal(is_reciprocal(scene, pairs), backward)


@searches
def test_a_pair_at_the_gate_is_in(search: Callable[[Cloud, float], Association]) -> None:
    cloud = prepare_cloud(np.array([[0.0, 0], [1, 0], [0, 1]]))
    moved = place(prepare_cloud(cloud.points + np.array([-0.25, 0])), cloud, np.eye(3))
    assert len(search(cloud, 0.25)(moved.moved)) == 3
    assert len(search(cloud, np.nextafter(0.25, 0))(moved.moved)) == 0


def test_trimming_keeps_the_nearest_share() -> None:
    distance = np.array([0.5, 0.1, 0.4, 0.2, 0.3])
    pairs = Pairs(source=np.arange(5), target=np.arange(5), distance_m=distance)
    cloud = prepare_cloud(np.zeros((5, 2)))
    scene = place(cloud, cloud, np.eye(3))
    np.testing.assert_array_equal(trimming_test(0.6)(scene, pairs), [False, True, False, True, True])
    np.testing.assert_array_equal(trimming_test(0.01)(scene, pairs), [False, True, False, False, False])


def test_normals_are_compared_without_their_signs() -> None:
    along_x = np.column_stack([np.linspace(0, 1, 20), np.zeros(20)])
    cloud, row = prepare_cloud(along_x, neighbours=5), np.arange(20)
    pairs = Pairs(source=row, target=row, distance_m=np.zeros(20))
    for angle, stays in ((0.3, True), (-0.3, True), (np.pi - 0.3, True), (0.5, False), (np.pi / 2, False)):
        scene = place(cloud, cloud, SE2.exp(np.array([0, 0, angle])))
        assert normal_angle_test(0.4)(scene, pairs).all() == stays


@spaces
def test_the_jacobian_is_the_derivative(group: Group) -> None:
    rng, h = np.random.default_rng(2), 1e-6
    source, target = (
        prepare_cloud(rng.normal(size=(40, group.dimension)) + 3),
        prepare_cloud(rng.normal(size=(40, group.dimension))),
    )
    T = group.exp(rng.normal(size=group.dof))
    pairs = Pairs(source=rng.permutation(40), target=rng.permutation(40), distance_m=np.zeros(40))
    frame, jacobian = linearise(place(source, target, T), pairs)
    for axis, step in enumerate(frame.to_origin.T):
        ahead, behind = (plane_residuals(place(source, target, group.retract(T, s * h * step)), pairs) for s in (1, -1))
        np.testing.assert_allclose(jacobian[:, axis], (ahead - behind) / (2 * h), atol=1e-8)


@spaces
def test_a_plane_step_reaches_the_minimum_of_its_linear_cost(group: Group) -> None:
    rng = np.random.default_rng(4)
    source, target = (prepare_cloud(rng.normal(size=(60, group.dimension))) for _ in range(2))
    pairs = Pairs(source=np.arange(60), target=rng.permutation(60), distance_m=np.zeros(60))
    scene, weights = place(source, target, group.identity()), rng.uniform(0.1, 1, 60)
    better = PointToPlane(1e-9).improve(scene, pairs, weights)
    assert better is not None
    frame, jacobian = linearise(scene, pairs)
    root = np.sqrt(weights)
    expected, *_ = np.linalg.lstsq(jacobian * root[:, None], -plane_residuals(scene, pairs) * root, rcond=None)
    np.testing.assert_allclose(group.log(better), frame.to_origin @ expected, atol=1e-9)


def test_a_point_step_is_the_closed_form() -> None:
    rng = np.random.default_rng(4)
    source, target = (prepare_cloud(rng.normal(size=(30, 3))) for _ in range(2))
    pairs = Pairs(source=np.arange(30), target=np.arange(30)[::-1], distance_m=np.zeros(30))
    better = PointToPoint().improve(place(source, target, np.eye(4)), pairs, np.ones(30))
    np.testing.assert_allclose(better, align_points(source.points, target.points[::-1])[0])


@pytest.mark.parametrize(("step", "settled"), [
    ([9e-4, 0, 0], True), ([1.1e-3, 0, 0], False), ([0, 0, 0.019], True), ([0, 0, 0.021], False),
])  # fmt: skip
def test_turning_and_moving_end_the_loop_apart(step: list[float], settled: bool) -> None:
    settings = IcpSettings(rotation_tolerance_rad=0.02, translation_tolerance_m=1e-3)
    assert has_settled(np.eye(3), SE2.exp(np.array(step)), settings) is settled


@given(st.integers(0, 10_000), st.sampled_from([2, 3]), st.floats(0.05, 3))
def test_voxels_find_what_the_tree_finds(seed: int, d: int, gate_m: float) -> None:
    rng = np.random.default_rng(seed)
    target = prepare_cloud(rng.uniform(-2, 2, size=(rng.integers(1, 60), d)).round(1))  # on voxel faces, with ties
    moved = np.vstack([rng.uniform(-4, 4, size=(30, d)), target.points])
    tree, voxels = by_tree(target, gate_m)(moved), by_voxel_hash(target, gate_m)(moved)
    np.testing.assert_array_equal(tree.source, voxels.source)
    np.testing.assert_allclose(tree.distance_m, voxels.distance_m, atol=1e-12)


def test_a_cloud_too_wide_for_its_gate_is_refused() -> None:
    wide = prepare_cloud(np.array([[0.0, 0], [1e7, 0], [0, 1]]))
    with pytest.raises(InputError, match="KD-tree"):
        by_voxel_hash(wide, 0.1)


@spaces
@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_clouds_of_a_few_points_have_a_surface_without_normals(group: Group, count: int) -> None:
    points = np.random.default_rng(count).normal(size=(count, group.dimension))
    surface = prepare_cloud(points).surface
    assert len(surface.anchors) == len(surface.normals) == count
    if count < group.dimension:
        np.testing.assert_array_equal(surface.anchors, points)
        assert not surface.oriented.any()
        assert surface.neighbours.shape == (count, 0)
    repeated = prepare_cloud(np.repeat(points[:1], 50, axis=0)).surface
    assert not repeated.oriented.any()
