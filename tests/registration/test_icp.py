"""The closest point loop: what every combination of its parts must do, in the plane and in space."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, SE3, Group, inverse_pose, transform_points
from posegraph_slam.registration import (
    AssociationKind,
    IcpSettings,
    Loss,
    RegistrationStatus,
    ResidualKind,
    icp,
    prepare_cloud,
)
from posegraph_slam.registration.compiled_loop import register

POINT, PLANE = ResidualKind.POINT_TO_POINT, ResidualKind.POINT_TO_PLANE
matchers = pytest.mark.parametrize(
    "settings",
    [
        IcpSettings.point_to_line(),
        IcpSettings.point_to_point(),
        IcpSettings(loss=Loss.HUBER, keep_fraction=0.95),
        IcpSettings(loss=Loss.TUKEY, max_normal_angle_rad=0.8),
        IcpSettings(residual=POINT, loss=Loss.GEMAN_MCCLURE, reciprocal=True, max_iterations=200),
    ],
    ids=["line", "point", "huber-trimmed", "tukey-normals", "point-reciprocal"],
)
spaces = pytest.mark.parametrize("group", [SE2, SE3], ids=["2d", "3d"])


def surface(group: Group, seed: int = 0, n: int | None = None) -> FloatArray:
    """Random points on the walls of a box with a smaller box in it, open towards one side."""
    rng, d = np.random.default_rng(seed), group.dimension
    n = n or {2: 600, 3: 3000}[d]  # apart by 0.04 m in the plane, by 0.12 m in space
    points = rng.uniform(-1, 1, size=(n, d))
    axis, side = rng.integers(d, size=n), rng.choice([-1, 1], size=n)
    points[np.arange(n), axis] = side
    inner = rng.random(n) < 0.25
    points = np.where(inner[:, None], points * 0.3 + 0.25, points)
    return points[(points[:, 0] < 0.99)] * np.array([3.0, 2.0, 1.5][:d])


def motion(group: Group, size: float, seed: int) -> FloatArray:
    direction = np.random.default_rng(seed).normal(size=group.dof)
    return group.exp(size * direction / np.linalg.norm(direction))


def distance(group: Group, a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(group.local(a, b)))


@spaces
@matchers
def test_known_motion_of_the_same_points_is_found(group: Group, settings: IcpSettings) -> None:
    target, T = surface(group), motion(group, 0.06, 1)
    source = transform_points(inverse_pose(T), target)
    result = icp(source, target, group.identity(), settings)
    assert result.usable
    # the same points: point-to-point is exact once every pair is right; a fitted line passes beside its point
    assert distance(group, result.T_target_source, T) < (1e-4 if settings.residual is POINT else 6e-3)
    assert result.inlier_fraction > 0.8


@spaces
@matchers
def test_the_identity_stays(group: Group, settings: IcpSettings) -> None:
    points = surface(group)
    result = icp(points, points, group.identity(), settings)
    assert result.status is RegistrationStatus.CONVERGED
    assert distance(group, result.T_target_source, group.identity()) < 6e-3


@matchers
def test_noisy_scans_of_a_room(settings: IcpSettings, simulated: SimpleNamespace) -> None:
    rng, T = np.random.default_rng(3), SE2.exp(np.array([0.1, 0.05, 0.04]))
    target = simulated.scan(np.eye(3), simulated.room, 361, 0.01, rng)
    source = simulated.scan(T, simulated.room, 361, 0.01, rng)
    result = icp(source, target, np.eye(3), settings)
    assert result.usable
    assert distance(SE2, result.T_target_source, T) < (0.005 if settings.residual is PLANE else 0.03)
    assert not result.degenerate
    assert result.rmse_m < 0.05


@spaces
@matchers
def test_matching_the_other_way_gives_the_inverse(group: Group, settings: IcpSettings) -> None:
    target, source = surface(group, 0), transform_points(motion(group, 0.05, 2), surface(group, 7))
    forward = icp(source, target, group.identity(), settings)
    backward = icp(target, source, group.identity(), settings)
    assert forward.usable
    assert backward.usable
    close = 0.03 if settings.residual is PLANE else 0.12
    assert distance(group, forward.T_target_source @ backward.T_target_source, group.identity()) < close


@spaces
@matchers
def test_moving_both_clouds_moves_the_answer(group: Group, settings: IcpSettings) -> None:
    target, source = surface(group), transform_points(motion(group, 0.05, 2), surface(group, 7))
    A, B = group.exp(np.full(group.dof, 0.7)), group.exp(np.linspace(-1, 2, group.dof))
    plain = icp(source, target, group.identity(), settings)
    moved = icp(transform_points(B, source), transform_points(A, target), A @ inverse_pose(B), settings)
    assert (moved.status, moved.inliers) == (plain.status, plain.inliers)
    np.testing.assert_allclose(moved.T_target_source, A @ plain.T_target_source @ inverse_pose(B), atol=3e-5)
    # T_t_s exp(d) with the source frame moved by B: d' = Ad(B) d
    adjoint = group.adjoint(inverse_pose(B))
    expected = adjoint.T @ plain.information @ adjoint
    # point-to-point is described by its gap of millimetres to the lines, of which 3e-5 m is a share
    share = 1e-3 if settings.residual is PLANE else 1e-2
    np.testing.assert_allclose(moved.information, expected, atol=share * np.abs(expected).max())


@spaces
@matchers
def test_the_same_input_gives_the_same_bytes(group: Group, settings: IcpSettings) -> None:
    target, source = surface(group), surface(group, 7)
    first, second = (icp(source, target, motion(group, 0.05, 1), settings) for _ in range(2))
    prepared = icp(prepare_cloud(source), prepare_cloud(target), motion(group, 0.05, 1), settings)
    for other in (second, prepared):
        assert first.T_target_source.tobytes() == other.T_target_source.tobytes()
        assert first.information.tobytes() == other.information.tobytes()


@spaces
@matchers
def test_clouds_without_overlap_end_in_a_status(group: Group, settings: IcpSettings) -> None:
    points = surface(group)
    result = icp(points + 50.0, points, group.identity(), settings)
    assert result.status is RegistrationStatus.TOO_FEW_INLIERS
    assert not result.usable
    assert np.isnan(result.T_target_source).all()
    assert not result.information.any()


@spaces
def test_outliers_are_weighed_down(group: Group) -> None:
    target, T = surface(group), motion(group, 0.05, 4)
    source = transform_points(inverse_pose(T), surface(group, 5))
    noise = np.random.default_rng(0).uniform(-2, 2, size=(len(source) // 4, group.dimension))
    result = icp(np.vstack([source, noise]), target, group.identity())
    plain = icp(np.vstack([source, noise]), target, group.identity(), IcpSettings(loss=Loss.NONE))
    assert distance(group, result.T_target_source, T) < 0.012
    assert distance(group, result.T_target_source, T) < distance(group, plain.T_target_source, T)


@spaces
@matchers
def test_a_reflected_cloud_never_yields_a_reflection(group: Group, settings: IcpSettings) -> None:
    points = surface(group) * np.r_[1.0, 1.3, 0.8][: group.dimension]
    mirrored = points * np.r_[-np.ones(1), np.ones(group.dimension - 1)]
    result = icp(mirrored, points, group.identity(), settings)
    if result.usable:
        R = result.T_target_source[:-1, :-1]
        assert np.linalg.det(R) == pytest.approx(1.0)
        np.testing.assert_allclose(R @ R.T, np.eye(len(R)), atol=1e-9)


@spaces
@matchers
@pytest.mark.parametrize(
    ("kind", "status"),
    [
        ("empty", RegistrationStatus.TOO_FEW_POINTS),
        ("one", RegistrationStatus.TOO_FEW_POINTS),
        ("three", RegistrationStatus.TOO_FEW_POINTS),
        ("one spot", RegistrationStatus.DEGENERATE),
        ("line", RegistrationStatus.DEGENERATE),
        ("far line", RegistrationStatus.DEGENERATE),
    ],
)
@pytest.mark.parametrize("which", ["source", "target", "both"])
def test_poor_clouds_end_in_a_status(
    group: Group, settings: IcpSettings, kind: str, status: RegistrationStatus, which: str
) -> None:
    d = group.dimension
    line = np.linspace(0, 2, 40)[:, None] * np.full(d, 1 / 3)
    poor = {
        "empty": np.zeros((0, d)), "one": np.ones((1, d)), "three": np.eye(3)[:, :d], "one spot": np.ones((30, d)),
        "line": line, "far line": line + 1000.0,
    }[kind]  # fmt: skip
    rich = surface(group)
    source, target = {"source": (poor, rich), "target": (rich, poor), "both": (poor, poor)}[which]
    result = icp(source, target, group.identity(), settings)
    assert result.status is status
    assert np.isnan(result.T_target_source).all()


@spaces
def test_points_repeated_so_often_that_no_normal_exists(group: Group) -> None:
    spots = surface(group, 0, 40)
    repeated = np.repeat(spots, 20, axis=0)
    assert icp(repeated, repeated, group.identity()).status is RegistrationStatus.TOO_FEW_INLIERS
    exact = icp(repeated, repeated, group.identity(), IcpSettings.point_to_point())
    assert exact.status is RegistrationStatus.CONVERGED
    np.testing.assert_allclose(exact.T_target_source, group.identity(), atol=1e-12)


@spaces
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(group: Group, bad: float) -> None:
    points, broken = surface(group), surface(group)
    broken[4, 0] = bad
    with pytest.raises(InputError, match=r"1 of .* not finite"):
        icp(broken, points, group.identity())
    with pytest.raises(InputError, match=r"1 of .* not finite"):
        icp(points, broken, group.identity())
    with pytest.raises(InputError, match="not a finite pose"):
        icp(points, points, np.full_like(group.identity(), bad))


def test_shapes_that_do_not_fit_are_refused() -> None:
    plane, space = surface(SE2), surface(SE3)
    with pytest.raises(InputError, match="2 coordinates"):
        icp(plane, space, np.eye(3))
    with pytest.raises(InputError, match="give a 3 x 3 matrix"):
        icp(plane, plane, np.eye(4))
    with pytest.raises(InputError, match="shape"):
        icp(plane.ravel(), plane, np.eye(3))
    with pytest.raises(InputError, match="shape"):
        icp(np.zeros((9, 5)), plane, np.eye(3))


@spaces
@pytest.mark.parametrize("residual", list(ResidualKind))
@pytest.mark.parametrize(("loss", "keep"), [(Loss.NONE, 0.8), (Loss.HUBER, 1.0), (Loss.CAUCHY, 0.9),
                                            (Loss.GEMAN_MCCLURE, 1.0), (Loss.TUKEY, 0.9)])  # fmt: skip
def test_the_compiled_loop_is_the_loop_of_parts(group: Group, residual: ResidualKind, loss: Loss, keep: float) -> None:
    target, source = surface(group), surface(group, 7)
    compiled, parts = (
        icp(source, target, motion(group, 0.05, 1),
            IcpSettings(residual=residual, loss=loss, keep_fraction=keep, association=association, max_iterations=40))
        for association in (None, AssociationKind.KD_TREE)
    )  # fmt: skip
    assert (compiled.status, compiled.iterations, compiled.inliers) == (parts.status, parts.iterations, parts.inliers)
    np.testing.assert_allclose(compiled.T_target_source, parts.T_target_source, atol=1e-9)
    np.testing.assert_allclose(compiled.information, parts.information, rtol=1e-5, atol=1e-3)


@spaces
def test_the_layout_of_the_guess_compiles_nothing_anew(group: Group) -> None:
    target, source, T = surface(group), surface(group, 7), motion(group, 0.05, 1)
    plain, compiled = icp(source, target, T), len(register.signatures)
    fixed, wide = T.copy(), np.eye(2 * len(T))
    fixed.flags.writeable = False
    wide[: len(T), : len(T)] = T
    for guess in (fixed, np.asfortranarray(T), wide[: len(T), : len(T)], T.tolist()):
        assert icp(source, target, guess).T_target_source.tobytes() == plain.T_target_source.tobytes()
    assert len(register.signatures) == compiled


@spaces
@pytest.mark.parametrize("residual", ResidualKind)
def test_a_guess_of_three_digits_ends_at_a_rotation(group: Group, residual: ResidualKind) -> None:
    target, T, settings = surface(group), motion(group, 0.3, 1), IcpSettings(residual=residual)
    result = icp(transform_points(inverse_pose(T), target), target, np.round(T, 3), settings)
    R = result.T_target_source[:-1, :-1]
    np.testing.assert_allclose(R.T @ R, np.eye(len(R)), atol=1e-12)
    assert distance(group, result.T_target_source, T) < 1e-5


def test_too_few_steps_are_told() -> None:
    target = surface(SE2)
    source = transform_points(motion(SE2, 0.2, 1), surface(SE2, 7))
    result = icp(source, target, np.eye(3), IcpSettings(max_iterations=1))
    assert result.status is RegistrationStatus.MAX_ITERATIONS
    assert result.iterations == 1
    assert result.usable


@pytest.mark.parametrize("key", ["max_distance_m", "keep_fraction", "degeneracy_ratio", "sigma_floor_m"])
def test_settings_out_of_range_are_refused(key: str) -> None:
    with pytest.raises(ValueError, match=key):
        IcpSettings(**{key: 0.0})  # type: ignore[arg-type]


@spaces
@pytest.mark.parametrize("residual", list(ResidualKind))
@pytest.mark.parametrize("association", [None, AssociationKind.KD_TREE])
def test_the_pose_alone_is_the_same_pose(
    group: Group, residual: ResidualKind, association: AssociationKind | None
) -> None:
    target, source = surface(group), surface(group, 7)
    settings = IcpSettings(residual=residual, association=association)
    whole, alone = (
        icp(source, target, motion(group, 0.05, 1), settings.model_copy(update={"uncertainty": told}))
        for told in (True, False)
    )
    assert alone.T_target_source.tobytes() == whole.T_target_source.tobytes()
    assert (alone.status, alone.rmse_m) == (whole.status, whole.rmse_m)
    assert not alone.information.any()
    assert len(alone.degenerate_directions) == group.dof


def test_copied_settings_are_not_those_of_before() -> None:
    settings = IcpSettings()
    assert settings.for_kernels[2][0] == 0.5
    assert settings.model_copy(update={"max_distance_m": 0.2}).for_kernels[2][0] == 0.2
    assert settings.for_kernels[2][0] == 0.5
