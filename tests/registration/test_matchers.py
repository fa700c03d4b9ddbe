"""What every matcher must do: the conformance suite."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, SE3, Group, inverse_pose, pose_from_xyt, transform_points
from posegraph_slam.registration import RegistrationResult, RegistrationStatus
from posegraph_slam.registration.matchers import available_matchers

CASES = [(2, name) for name in available_matchers(2)] + [(3, name) for name in available_matchers(3)]
every_matcher = pytest.mark.parametrize(("dimension", "name"), CASES, ids=[f"{d}d-{name}" for d, name in CASES])
GUIDED = [case for case in CASES if case[1] != "global"]
matchers_with_a_guess = pytest.mark.parametrize(("dimension", "name"), GUIDED, ids=[f"{d}d-{n}" for d, n in GUIDED])

LOOSE = {"point_to_point": 8.0}
"""How much farther off than the others a matcher may be: raw points of two samples are a grain apart."""


def lopsided_object(rng: np.random.Generator, count: int) -> FloatArray:
    """Points on two boxes and a ball, the whole of which no turn maps onto itself."""
    boxes = [((0, 0, 0), (1.6, 1.0, 0.7)), ((1.1, 0.5, 0.7), (0.7, 0.4, 0.6))]
    parts = []
    for centre, size in boxes:
        points = rng.uniform(-0.5, 0.5, (2 * count // 5, 3))
        axis = rng.choice(3, len(points), p=[0.3, 0.3, 0.4])
        points[np.arange(len(points)), axis] = rng.choice([-0.5, 0.5], len(points))
        parts.append(points * size + centre)
    ball = rng.normal(size=(count // 5, 3))
    parts.append(0.35 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + (-0.6, -0.7, 0.5))
    return np.vstack(parts)


@pytest.fixture(scope="module")
def scenes(simulated: SimpleNamespace) -> dict[int, tuple[Group, FloatArray, FloatArray, FloatArray]]:
    """Group, target, source and true pose by dimension: two noisy scans of a room, two samplings of an object."""
    rng = np.random.default_rng(4)
    T2, T3 = pose_from_xyt(np.array([0.12, -0.06, 0.05])), SE3.exp(np.array([0.04, -0.03, 0.05, 0.06, -0.04, 0.05]))
    target2, source2 = (simulated.scan(T, simulated.room, 361, 0.005, rng) for T in (np.eye(3), T2))
    target3, source3 = lopsided_object(rng, 5000), lopsided_object(rng, 4000)
    noisy = [p + rng.normal(0, 0.003, p.shape) for p in (target3, transform_points(inverse_pose(T3), source3))]
    return {2: (SE2, target2, source2, T2), 3: (SE3, noisy[0], noisy[1], T3)}


@pytest.fixture(scope="module")
def forward(scenes) -> Callable[[int, str], RegistrationResult]:
    """Give the registration of the source onto the target by a matcher, made once."""

    @cache
    def register(dimension: int, name: str) -> RegistrationResult:
        group, target, source, _ = scenes[dimension]
        return available_matchers(dimension)[name](source, target, group.identity())

    return register


def gap(group: Group, a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(group.local(a, b)))


@every_matcher
def test_identity(dimension: int, name: str, scenes) -> None:
    group, target, _, _ = scenes[dimension]
    result = available_matchers(dimension)[name](target, target, group.identity())
    assert result.status is RegistrationStatus.CONVERGED
    assert gap(group, result.T_target_source, group.identity()) < 0.003


@every_matcher
def test_known_motion(dimension: int, name: str, scenes, forward) -> None:
    group, _, _, T = scenes[dimension]
    result = forward(dimension, name)
    assert result.usable
    assert gap(group, result.T_target_source, T) < 0.006 * LOOSE.get(name, 1.0)
    assert result.inlier_fraction > 0.7
    assert 0 < result.rmse_m < 0.1
    assert not result.degenerate
    values = np.linalg.eigvalsh(result.information)
    assert values[0] > 1e2
    assert values[-1] < 1e10


@every_matcher
def test_inverse(dimension: int, name: str, scenes, forward) -> None:
    group, target, source, _ = scenes[dimension]
    onto, backward = forward(dimension, name), available_matchers(dimension)[name](target, source, group.identity())
    assert onto.usable
    assert backward.usable
    circle = onto.T_target_source @ backward.T_target_source
    assert gap(group, circle, group.identity()) < 0.008 * LOOSE.get(name, 1.0)


@every_matcher
def test_equivariance(dimension: int, name: str, scenes, forward) -> None:
    group, target, source, _ = scenes[dimension]
    A, B = group.exp(np.linspace(0.6, -0.5, group.dof)), group.exp(np.linspace(-0.4, 0.9, group.dof))
    matcher = available_matchers(dimension)[name]
    plain = forward(dimension, name)
    moved = matcher(transform_points(B, source), transform_points(A, target), A @ inverse_pose(B))
    assert moved.usable
    expected = A @ plain.T_target_source @ inverse_pose(B)
    # a trimmed loop may stop elsewhere in a circle of pairings, and a global search start from another cell
    assert gap(group, moved.T_target_source, expected) < 1e-3


@every_matcher
def test_determinism(dimension: int, name: str, scenes, forward) -> None:
    group, target, source, _ = scenes[dimension]
    first, second = forward(dimension, name), available_matchers(dimension)[name](source, target, group.identity())
    for field in ("T_target_source", "information", "degenerate_directions"):
        assert getattr(first, field).tobytes() == getattr(second, field).tobytes()


@every_matcher
def test_no_overlap_ends_in_a_status(dimension: int, name: str, scenes) -> None:
    group, target, source, _ = scenes[dimension]
    apart = source + 50.0
    if name == "global":  # finds clouds wherever they are: only one that fits nowhere has no overlap
        apart = np.random.default_rng(0).uniform(-5, 5, source.shape)
    result = available_matchers(dimension)[name](apart, target, group.identity())
    assert result.status is RegistrationStatus.TOO_FEW_INLIERS
    assert np.isnan(result.T_target_source).all()
    assert not result.information.any()


@every_matcher
@pytest.mark.parametrize("kind", ["empty", "three", "spot", "line"])
def test_poor_clouds_end_in_a_status(dimension: int, name: str, kind: str, scenes) -> None:
    group, target, _, _ = scenes[dimension]
    line = np.linspace(0, 2, 40)[:, None] * np.full(dimension, 0.5)
    poor = {"empty": np.zeros((0, dimension)), "three": np.eye(3)[:, :dimension], "spot": np.ones((40, dimension)),
            "line": line}[kind]  # fmt: skip
    result = available_matchers(dimension)[name](poor, target, group.identity())
    few = kind in ("empty", "three")
    assert result.status is (RegistrationStatus.TOO_FEW_POINTS if few else RegistrationStatus.DEGENERATE)
    assert np.isnan(result.T_target_source).all()


@every_matcher
def test_a_mirrored_cloud_never_yields_a_reflection(dimension: int, name: str, scenes) -> None:
    group, target, _, _ = scenes[dimension]
    mirrored = target * np.r_[-1.0, np.ones(dimension - 1)]
    result = available_matchers(dimension)[name](mirrored, target, group.identity())
    if result.usable:
        R = result.T_target_source[:-1, :-1]
        assert np.linalg.det(R) == pytest.approx(1.0)
        np.testing.assert_allclose(R @ R.T, np.eye(dimension), atol=1e-9)


@matchers_with_a_guess
@pytest.mark.parametrize("factors", [(-1.0, 1.0), (2.0, 2.0), (1.01, 1.0)], ids=["mirrored", "scaled", "sheared"])
def test_a_guess_that_is_no_rigid_motion_is_refused(dimension: int, name: str, factors, scenes) -> None:
    _, target, source, T = scenes[dimension]
    guess = T @ np.diag(np.r_[factors, np.ones(dimension - 1)])
    with pytest.raises(InputError, match="no rigid motion"):
        available_matchers(dimension)[name](source, target, guess)


@every_matcher
def test_arrays_that_hold_no_numbers_are_refused(dimension: int, name: str, scenes) -> None:
    group, target, source, _ = scenes[dimension]
    matcher = available_matchers(dimension)[name]
    for wrong in (source.astype(str), source.astype(object), source + 1j, [[1.0, 2.0], [1.0]], source > 0):
        with pytest.raises(InputError, match="give an array of numbers"):
            matcher(wrong, target, group.identity())
        with pytest.raises(InputError, match="give an array of numbers"):
            matcher(source, wrong, group.identity())
