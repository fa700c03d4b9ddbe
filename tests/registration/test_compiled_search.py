"""Searches of the compiled loop against plain ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE2, SE3, Group
from posegraph_slam.registration.cloud import prepare_cloud
from posegraph_slam.registration.icp import pose_in_space
from posegraph_slam.registration.pair_search import nothing_known, pair_nearest
from posegraph_slam.registration.selection import middle_of
from posegraph_slam.registration.tangent_frames import frame_matrix, gap_between


@given(st.lists(st.floats(-1e300, 1e300), min_size=1, max_size=60))
def test_the_middle_one_is_that_of_a_sort(values: list[float]) -> None:
    array = np.array(values)
    assert middle_of(array, len(array)) == np.sort(array)[len(array) // 2]


def test_the_middle_of_equal_and_of_few_values() -> None:
    assert middle_of(np.array([2.0, 2.0, 2.0, 7.0]), 4) == 2.0
    assert middle_of(np.array([5.0, 1.0, -9.0]), 2) == 5.0  # the third one does not count


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("ordered", [True, False])
def test_neighbours_are_the_nearest_points_and_the_lowest_of_equals(dimension: int, ordered: bool) -> None:
    rng = np.random.default_rng(0)
    points = rng.integers(0, 6, (150, dimension)).astype(float)  # many equal distances and equal points
    if ordered:
        points = np.column_stack([np.arange(150.0), *rng.integers(0, 2, (dimension - 1, 150))])
    cloud = prepare_cloud(points)
    squares = np.sum((points[:, None] - points[None]) ** 2, axis=2)
    expected = np.argsort(squares, axis=1, kind="stable")[:, :12]
    np.testing.assert_array_equal(cloud.tree.neighbours_of_all(12), expected)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("linked", [True, False])
def test_pairs_stay_the_nearest_ones_on_every_way(dimension: int, linked: bool) -> None:
    rng = np.random.default_rng(1)
    target, source = (prepare_cloud(rng.uniform(0, 3, (200, dimension))) for _ in range(2))
    tree = target.tree
    table = target.surface.nearest if linked else np.zeros((1, 1), dtype=np.int64)
    memory, T, gate = nothing_known(200), np.eye(4), 0.3
    s, t, square = np.empty(200, dtype=np.int64), np.empty(200, dtype=np.int64), np.empty(200)
    for step in (0.5, 0.3, 0.05, 0.02, 0.0, 0.004, 0.2, 0.001):
        T[:dimension, 3] += rng.normal(0, step, dimension)
        count = pair_nearest(T, source.in_space, target.in_space, tree.rows, tree.sorted_points, tree.axis, tree.value,
                             table, gate, *memory, s, t, square)  # fmt: skip
        moved = source.points + T[:dimension, 3]
        squares = np.sum((moved[:, None] - target.points[None]) ** 2, axis=2)
        expected = np.flatnonzero(squares.min(axis=1) <= gate**2)
        np.testing.assert_array_equal(s[:count], expected)
        np.testing.assert_array_equal(t[:count], squares.argmin(axis=1)[expected])


@pytest.mark.parametrize("dimension", [2, 3])
def test_rounding_hides_no_point_as_near_as_the_bound_of_a_search(dimension: int) -> None:
    rng, gate = np.random.default_rng(0), 10.0
    s, t, square = np.empty(99, dtype=np.int64), np.empty(99, dtype=np.int64), np.empty(99)
    for _ in range(40):
        # points in twenty copies: the fourth nearest one, which bounds the search, is as near as the first
        points = rng.uniform(0, 3, (40, dimension))[rng.integers(0, 40, 800)]
        source, target = (prepare_cloud(p) for p in (points[rng.integers(0, 800, 99)], points))
        memory, T, tree = nothing_known(99), np.eye(4), target.tree
        for _ in range(4):
            T[:dimension, 3] += rng.normal(0, 0.1, dimension)
            count = pair_nearest(T, source.in_space, target.in_space, tree.rows, tree.sorted_points, tree.axis,
                                 tree.value, target.surface.nearest, gate, *memory, s, t, square)  # fmt: skip
            squares = np.sum((source.in_space[:, None] + T[:3, 3] - target.in_space[None]) ** 2, axis=2)
            assert count == 99
            np.testing.assert_array_equal(t, squares.argmin(axis=1))


@pytest.mark.parametrize("points", [np.zeros((1, 2)), np.zeros((2, 3)), np.zeros((0, 2))])
def test_clouds_too_small_for_lines_or_planes_have_no_neighbours(points: FloatArray) -> None:
    surface = prepare_cloud(points).surface
    assert surface.neighbours.shape == (len(points), 0)
    assert not surface.oriented.any()


@pytest.mark.parametrize("group", [SE2, SE3], ids=["SE2", "SE3"])
def test_the_gap_between_poses_is_the_logarithm_about_the_centre(group: Group) -> None:
    rng = np.random.default_rng(3)
    for size in (0.3, 1e-3, 1e-7, 0.0):
        T, tangent = group.exp(rng.normal(0, 1, group.dof)), rng.normal(0, 1, group.dof) * size
        centre = np.zeros(3)
        centre[: group.dimension] = rng.normal(0, 2, group.dimension)
        poses = [pose_in_space(pose, group.dimension) for pose in (T, T @ group.exp(tangent))]
        gap = gap_between(group.dimension, poses[0], poses[1], centre, 2.5)
        np.testing.assert_allclose(frame_matrix(group.dimension, centre, 2.5, True) @ gap, tangent, atol=1e-12)
