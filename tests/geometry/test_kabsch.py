"""Closed-form alignment: exact on exact data, and never a reflection."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE2, SE3, align_points, transform_points

planes_and_space = pytest.mark.parametrize("d", [2, 3])


def random_pose(d: int, seed: int) -> FloatArray:
    group = SE2 if d == 2 else SE3
    return group.exp(np.random.default_rng(seed).normal(size=group.dof) * 1.5)


def cloud(d: int, seed: int, n: int = 12) -> FloatArray:
    return np.random.default_rng(seed).normal(size=(n, d))


def assert_is_rotation(T: FloatArray) -> None:
    R = T[:-1, :-1]
    np.testing.assert_allclose(R @ R.T, np.eye(len(R)), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


@given(d=st.sampled_from([2, 3]), seed=st.integers(0, 10_000), n=st.integers(3, 40))
def test_recovers_any_motion(d: int, seed: int, n: int) -> None:
    x, T = cloud(d, seed, max(n, d + 1)), random_pose(d, seed + 1)
    found, scale, determined = align_points(x, transform_points(T, x))
    assert determined
    assert scale == 1.0
    np.testing.assert_allclose(found, T, atol=1e-12)


@planes_and_space
def test_far_from_the_origin(d: int) -> None:
    x, T = cloud(d, 0) + 4e5, random_pose(d, 1)
    found, _, _ = align_points(x, transform_points(T, x))
    np.testing.assert_allclose(found[:d, :d], T[:d, :d], atol=1e-9)


@planes_and_space
def test_recovers_scale(d: int) -> None:
    x, T = cloud(d, 0), random_pose(d, 1)
    similar = T.copy()
    similar[:d, :d] *= 2.5
    found, scale, determined = align_points(x, transform_points(similar, x), with_scale=True)
    assert determined
    assert scale == pytest.approx(2.5)
    np.testing.assert_allclose(found, similar, atol=1e-12)


@planes_and_space
def test_weights_count_points(d: int) -> None:
    x, y = cloud(d, 0), cloud(d, 1)
    counts = np.array([3, 1, 2, 1, 1, 0, 1, 1, 4, 1, 1, 1])
    weighted, _, _ = align_points(x, y, counts.astype(float))
    repeated, _, _ = align_points(np.repeat(x, counts, axis=0), np.repeat(y, counts, axis=0))
    np.testing.assert_allclose(weighted, repeated, atol=1e-12)


@planes_and_space
def test_a_point_without_weight_may_be_anywhere(d: int) -> None:
    x, T = cloud(d, 0), random_pose(d, 1)
    y, w = transform_points(T, x), np.ones(len(x))
    y[3], w[3] = 1e3, 0.0
    np.testing.assert_allclose(align_points(x, y, w)[0], T, atol=1e-12)


@planes_and_space
def test_a_reflected_set_yields_the_best_rotation(d: int) -> None:
    x = cloud(d, 3, 30) * np.array([3.0, 2.0, 1.0][:d])
    mirrored = x * np.r_[-np.ones(1), np.ones(d - 1)]
    T, _, determined = align_points(x, mirrored)
    assert determined
    assert_is_rotation(T)

    def cost(turn: FloatArray) -> float:
        R = Rotation.from_rotvec(turn if d == 3 else [0, 0, turn[0]]).as_matrix()[:d, :d]
        centred_x, centred_y = x - x.mean(0), mirrored - mirrored.mean(0)
        return float(np.sum((centred_x @ R.T - centred_y) ** 2))

    starts = np.random.default_rng(0).uniform(-3, 3, size=(20, 1 if d == 2 else 3))
    best = min(minimize(cost, start).fun for start in starts)
    assert np.sum((transform_points(T, x) - mirrored) ** 2) == pytest.approx(best, rel=1e-6)


def test_the_planar_guard_turns_one_axis_only() -> None:
    """In the plane det(-R) = det(R): negating the whole matrix would leave the reflection."""
    x = np.array([[2.0, 0], [-2, 0], [0, 1], [0, -1]])
    T, _, _ = align_points(x, x * [1, -1])
    np.testing.assert_allclose(T, np.eye(3), atol=1e-12)  # the long axis wins


@planes_and_space
def test_no_rotation_is_claimed_where_a_reflection_is_symmetric(d: int) -> None:
    x = np.vstack([np.eye(d), -np.eye(d)])
    T, _, determined = align_points(x, x * np.r_[-np.ones(1), np.ones(d - 1)])
    assert not determined
    assert_is_rotation(T)


def test_a_line_fixes_the_plane_but_not_space() -> None:
    line = np.linspace(-1, 1, 9)[:, None]
    for d, fixed in ((2, True), (3, False)):
        x, T = line * np.ones(d) / 3, random_pose(d, 5)
        found, _, determined = align_points(x, transform_points(T, x))
        assert determined is fixed
        assert_is_rotation(found)
        np.testing.assert_allclose(transform_points(found, x), transform_points(T, x), atol=1e-8)


def test_the_least_turn_is_taken_about_a_line() -> None:
    x = np.linspace(-1, 1, 9)[:, None] * np.array([1.0, 0, 0])
    y = np.linspace(-1, 1, 9)[:, None] * np.array([0.6, 0.8, 0])
    T, _, _ = align_points(x, y)
    turn = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    np.testing.assert_allclose(turn, [0, 0, np.arctan2(0.8, 0.6)], atol=1e-6)


@planes_and_space
@pytest.mark.parametrize("n", [0, 1, 5])
def test_one_spot_or_nothing_leaves_the_rotation_open(d: int, n: int) -> None:
    x, y = np.full((n, d), 2.0), np.full((n, d), 5.0)
    T, scale, determined = align_points(x, y, with_scale=True)
    assert not determined
    assert scale == 1.0
    assert np.isfinite(T).all()
    assert_is_rotation(align_points(x, y)[0])
    np.testing.assert_allclose(transform_points(align_points(x, y)[0], x), y)


def test_weights_of_zero_leave_everything_open() -> None:
    assert not align_points(cloud(2, 0), cloud(2, 1), np.zeros(12))[2]


def test_agrees_with_scipy_on_noisy_points() -> None:
    x, w = cloud(3, 0, 50), np.random.default_rng(2).uniform(0.1, 2, 50)
    y = transform_points(random_pose(3, 1), x) + 0.1 * cloud(3, 4, 50)
    T, _, _ = align_points(x, y, w)
    mean_x, mean_y = w @ x / w.sum(), w @ y / w.sum()
    expected, _ = Rotation.align_vectors(y - mean_y, x - mean_x, weights=w)
    np.testing.assert_allclose(T[:3, :3], expected.as_matrix(), atol=1e-10)
