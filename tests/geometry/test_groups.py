"""Group axioms, exponential maps and Jacobians over every group, batch shape and size of motion."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE2, SE3, SO2, SO3, Group

GROUPS = (SO2, SE2, SO3, SE3)
BATCHES = ((), (0,), (1,), (5,), (2, 3), (2, 0, 3))
ANGLES = (0.0, 1e-9, 1e-7, 5e-5, 2e-4, 9e-3, 2e-2, 0.7, 3.0, np.pi - 1e-4, np.pi - 1e-7)

groups = pytest.mark.parametrize("group", GROUPS, ids=lambda g: g.name)
batches = pytest.mark.parametrize("batch", BATCHES, ids=str)
angles = pytest.mark.parametrize("angle", ANGLES)


def tangents(group: Group, batch: tuple[int, ...], angle: float, seed: int = 0) -> FloatArray:
    """Random tangents whose rotation has exactly the given angle and whose translation is of metres."""
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=(*batch, group.dof))
    part = {"SO(2)": slice(0, 1), "SE(2)": slice(2, 3), "SO(3)": slice(0, 3), "SE(3)": slice(0, 3)}[group.name]
    xi[..., part] *= angle / np.linalg.norm(xi[..., part], axis=-1, keepdims=True)
    return xi


def hat(group: Group, xi: FloatArray) -> FloatArray:
    """The Lie algebra's matrix of one tangent, written out from its definition."""
    skew = {1: lambda w: np.array([[0, -w[0]], [w[0], 0]]),
            3: lambda w: np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])}  # fmt: skip
    if group in (SO2, SO3):
        return skew[group.dof](xi)
    rotation, translation = (xi[2:], xi[:2]) if group is SE2 else (xi[:3], xi[3:])
    result = np.zeros((group.matrix_size, group.matrix_size))
    result[:-1, :-1], result[:-1, -1] = skew[len(rotation)](rotation), translation
    return result


@groups
@batches
def test_axioms(group: Group, batch: tuple[int, ...]) -> None:
    a, b, c = (group.exp(tangents(group, batch, angle, seed)) for seed, angle in enumerate((0.5, 2.9, 1e-7)))
    n = group.matrix_size
    eye = group.identity(*batch)
    assert a.shape == eye.shape == (*batch, n, n)
    np.testing.assert_allclose(group.compose(group.compose(a, b), c), group.compose(a, group.compose(b, c)), atol=1e-13)
    np.testing.assert_allclose(group.compose(a, group.inverse(a)), eye, atol=1e-13)
    np.testing.assert_allclose(group.compose(a, group.between(a, b)), b, atol=1e-13)
    np.testing.assert_allclose(group.compose(a, eye), a)
    np.testing.assert_allclose(np.linalg.det(a), np.ones(batch), atol=1e-13)


@groups
@batches
@angles
def test_logarithm_undoes_exponential(group: Group, batch: tuple[int, ...], angle: float) -> None:
    xi = tangents(group, batch, angle)
    back = group.log(group.exp(xi))
    assert back.shape == xi.shape
    # at pi the axis is the eigenvector of a matrix whose rounding is 1e-16: half the digits of the distance remain
    np.testing.assert_allclose(back, xi, atol=1e-12 if angle < 3.1 else 1e-8)
    np.testing.assert_allclose(group.exp(back), group.exp(xi), atol=1e-12 if angle < 3.1 else 1e-8)


@groups
@angles
def test_exponential_is_that_of_the_matrix(group: Group, angle: float) -> None:
    xi = tangents(group, (3,), angle)
    expected = np.array([expm(hat(group, x)) for x in xi])
    np.testing.assert_allclose(group.exp(xi), expected, atol=2e-14)


@groups
@batches
def test_adjoint_moves_tangents_across(group: Group, batch: tuple[int, ...]) -> None:
    T, d = group.exp(tangents(group, batch, 2.0)), tangents(group, batch, 0.3, 1)
    adjoint = group.adjoint(T)
    assert adjoint.shape == (*batch, group.dof, group.dof)
    moved = (adjoint @ d[..., None])[..., 0]
    np.testing.assert_allclose(T @ group.exp(d), group.exp(moved) @ T, atol=1e-12)


@groups
@angles
def test_right_jacobian_is_the_derivative(group: Group, angle: float) -> None:
    xi, h = tangents(group, (4,), angle), 1e-6
    steps = h * np.eye(group.dof)
    numeric = np.stack(
        [(group.local(group.exp(xi), group.exp(xi + e)) - group.local(group.exp(xi), group.exp(xi - e))) / (2 * h)
         for e in steps], axis=-1)  # fmt: skip
    np.testing.assert_allclose(group.right_jacobian(xi), numeric, atol=3e-9)


@groups
@batches
def test_retract_undoes_local(group: Group, batch: tuple[int, ...]) -> None:
    a, b = (group.exp(tangents(group, batch, 1.4, seed)) for seed in (0, 1))
    np.testing.assert_allclose(group.retract(a, group.local(a, b)), b, atol=1e-12)


@pytest.mark.parametrize(("group", "pose"), [(SE2, gtsam.Pose2), (SE3, gtsam.Pose3)], ids=["SE(2)", "SE(3)"])
@angles
def test_chart_is_gtsams(group: Group, pose: type, angle: float) -> None:
    # gtsam's Pose2 divides 1 - cos(w) by w as it stands: below 1e-4 rad it keeps 7 digits only
    close = 1e-6 if 0 < angle < 1e-3 else 1e-11
    for xi in tangents(group, (5,), angle):
        theirs = pose.Expmap(xi)
        np.testing.assert_allclose(group.exp(xi), theirs.matrix(), atol=close)
        np.testing.assert_allclose(group.adjoint(group.exp(xi)), theirs.AdjointMap(), atol=close)
        if angle < 3.1:
            np.testing.assert_allclose(pose().localCoordinates(theirs), xi, atol=max(close, 1e-9))
            np.testing.assert_allclose(group.log(theirs.matrix()), pose.Logmap(theirs), atol=max(close, 1e-9))


def test_half_turns_are_found() -> None:
    axes = np.vstack([np.eye(3), -np.eye(3), np.ones((1, 3)) / np.sqrt(3), [[0.6, -0.8, 0.0]]])
    rotations = 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    found = SO3.log(rotations)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.pi, atol=1e-12)
    np.testing.assert_allclose(SO3.exp(found), rotations, atol=1e-12)


@given(st.sampled_from(GROUPS), st.integers(0, 10_000), st.floats(0, 3.0), st.floats(0, 3.0))
def test_inverse_reverses_products(group: Group, seed: int, angle_a: float, angle_b: float) -> None:
    a, b = group.exp(tangents(group, (2,), angle_a, seed)), group.exp(tangents(group, (2,), angle_b, seed + 1))
    np.testing.assert_allclose(group.inverse(a @ b), group.inverse(b) @ group.inverse(a), atol=1e-12)
    np.testing.assert_allclose(group.adjoint(a @ b), group.adjoint(a) @ group.adjoint(b), atol=1e-11)
