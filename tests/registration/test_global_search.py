"""Registration without a guess: rotations, the table of nearest points, and poses that do not depend on the start."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE3, transform_points
from posegraph_slam.registration import (
    GlobalSearchSettings,
    RegistrationStatus,
    StartKind,
    downsample,
    prepare_cloud,
    prepare_target,
    register_globally,
)
from posegraph_slam.registration.fit import measure_fit
from posegraph_slam.registration.global_search import PreparedTarget
from posegraph_slam.registration.many_starts import descend_all
from posegraph_slam.registration.nearest_field import build_nearest_field
from posegraph_slam.registration.rotation_grid import principal_frame, spread_rotations, yaw_rotations

QUICK = GlobalSearchSettings(rotations=300, survivors=(300, 60, 20), candidates=4)


def mug(rng: np.random.Generator, count: int) -> FloatArray:
    """Points on a cup with a handle and a spout, 0.1 m high."""
    angle, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, 1, count)
    body = np.column_stack([0.4 * np.cos(angle), 0.4 * np.sin(angle), height])
    turn = rng.uniform(-np.pi / 2, np.pi / 2, count // 4)
    tube = rng.uniform(0, 2 * np.pi, count // 4)
    ring = 0.3 + 0.05 * np.cos(tube)
    handle = np.column_stack([0.4 + ring * np.cos(turn), 0.05 * np.sin(tube), 0.5 + ring * np.sin(turn)])
    spout = rng.uniform([-0.7, 0.1, 0.7], [-0.4, 0.2, 0.9], (count // 8, 3))
    return 0.1 * np.vstack([body, handle, spout])


@pytest.fixture(scope="module")
def scene() -> tuple[FloatArray, FloatArray]:
    """Return the whole mug, and its side towards a camera in front of it with noise and outliers."""
    rng = np.random.default_rng(0)
    model, other = mug(rng, 6000), mug(rng, 6000)
    seen = other[other @ np.array([0.3, -1.0, 0.2]) > -0.002] + 0.0
    seen = seen + rng.normal(0, 0.0003, seen.shape)
    outliers = rng.uniform(-0.05, 0.12, (len(seen) // 20, 3))
    return model, np.vstack([seen, outliers])


@pytest.fixture(scope="module")
def target(scene: tuple[FloatArray, FloatArray]) -> PreparedTarget:
    """The whole mug, prepared once."""
    return prepare_target(scene[0], QUICK)


def apart(a: FloatArray, b: FloatArray, points: FloatArray) -> tuple[float, float]:
    """Turn and largest shift of the points between two poses."""
    turn = float(np.linalg.norm(SE3.local(a, b)[:3]))
    return turn, float(np.linalg.norm(transform_points(a, points) - transform_points(b, points), axis=1).max())


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_pose_is_found_wherever_the_cloud_is(
    scene: tuple[FloatArray, FloatArray], target: PreparedTarget, seed: int
) -> None:
    _, cloud = scene
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    A = SE3.exp(np.r_[rng.uniform(1, 3) * axis / np.linalg.norm(axis), rng.uniform(-2, 2, 3)])
    found = register_globally(transform_points(A, cloud), target, QUICK)
    assert found.result.usable
    turn, shift = apart(found.result.T_target_source @ A, np.eye(4), cloud)
    assert turn < np.radians(1.0)
    assert shift < 0.001
    assert found.trimmed_rmse_m < 0.0015
    assert 0 <= found.start < found.starts == 7 * QUICK.rotations


def test_every_second_point_is_enough(scene: tuple[FloatArray, FloatArray], target: PreparedTarget) -> None:
    _, cloud = scene
    full, half = register_globally(cloud, target, QUICK), register_globally(cloud[::2], target, QUICK)
    turn, shift = apart(full.result.T_target_source, half.result.T_target_source, cloud)
    assert turn < np.radians(0.5)
    assert shift < 0.001


def test_the_unit_does_not_matter(scene: tuple[FloatArray, FloatArray]) -> None:
    model, cloud = scene
    small, large = (register_globally(s * cloud, s * model, QUICK) for s in (1.0, 1000.0))
    assert large.result.usable
    np.testing.assert_allclose(large.result.T_target_source[:3, :3], small.result.T_target_source[:3, :3], atol=1e-3)
    assert large.trimmed_rmse_m == pytest.approx(1000 * small.trimmed_rmse_m, rel=0.02)


def test_yaw_starts_find_an_upright_object(scene: tuple[FloatArray, FloatArray]) -> None:
    model, cloud = scene
    A = SE3.exp(np.array([0, 0, 1.4, 0.5, 0.2, -0.1]))
    found = register_globally(
        transform_points(A, cloud), model, GlobalSearchSettings(starts=StartKind.YAW, rotations=4)
    )
    assert found.starts == 4
    assert apart(found.result.T_target_source @ A, np.eye(4), cloud)[1] < 0.001


@pytest.mark.parametrize(("points", "status"), [
    (np.zeros((0, 3)), RegistrationStatus.TOO_FEW_POINTS),
    (np.zeros((40, 3)), RegistrationStatus.DEGENERATE),
    (np.linspace(0, 1, 40)[:, None] * np.ones(3), RegistrationStatus.DEGENERATE),
    (np.random.default_rng(0).uniform(-1, 1, (500, 3)), RegistrationStatus.TOO_FEW_INLIERS),
])  # fmt: skip
def test_clouds_that_fit_nowhere_end_in_a_status(
    target: PreparedTarget, points: FloatArray, status: RegistrationStatus
) -> None:
    found = register_globally(points, target, QUICK)
    assert found.result.status is status
    assert np.isnan(found.result.T_target_source).all()
    assert found.start == -1


def test_planar_points_are_refused(scene: tuple[FloatArray, FloatArray]) -> None:
    with pytest.raises(InputError, match="give \\(points, 3\\)"):
        register_globally(scene[1][:, :2], scene[0])
    with pytest.raises(InputError, match="give \\(points, 3\\)"):
        register_globally(scene[1], scene[0][:, :2])


def test_rotations_are_spread_evenly() -> None:
    R = spread_rotations(2000)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    anywhere = SE3.exp(np.column_stack([np.random.default_rng(0).normal(size=(500, 3)) * 2, np.zeros((500, 3))]))
    cosine = (np.einsum("rij,qij->rq", R, anywhere[:, :3, :3]).max(axis=0) - 1) / 2
    assert np.degrees(np.arccos(cosine.min())) < 16.0
    turns = yaw_rotations(4)
    np.testing.assert_allclose(turns[1], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


def test_the_principal_frame_moves_with_the_cloud() -> None:
    points = mug(np.random.default_rng(1), 500)
    A = SE3.exp(np.array([1.0, -2.0, 0.5, 3.0, 4.0, -1.0]))
    moved = principal_frame(transform_points(A, points))
    np.testing.assert_allclose(moved, A @ principal_frame(points), atol=1e-9)
    assert np.linalg.det(moved[:3, :3]) == pytest.approx(1.0)


def test_the_table_names_the_nearest_voxel() -> None:
    points = mug(np.random.default_rng(1), 2000)
    field = build_nearest_field(points, 40)
    rng = np.random.default_rng(0)
    queries = rng.uniform(points.min(axis=0) - 0.02, points.max(axis=0) + 0.02, (400, 3))
    cells = np.floor((queries - field.origin) / field.voxel_m).astype(int)
    cells = np.clip(cells, 0, np.array(field.row.shape) - 1)
    found = field.points[field.row[tuple(cells.T)]]
    nearest = np.linalg.norm(queries[:, None] - field.points[None], axis=2).min(axis=1)
    excess = np.linalg.norm(queries - found, axis=1) - nearest
    assert excess.min() > -1e-12
    assert excess.max() < 2 * np.sqrt(3) * field.voxel_m


@pytest.mark.parametrize("to_planes", [False, True])
def test_starts_descend_on_their_own(to_planes: bool) -> None:
    points = mug(np.random.default_rng(1), 2000)
    field = build_nearest_field(points, 60)
    table = (field.row, field.points, field.normals, field.origin, field.voxel_m)
    starts = SE3.exp(np.random.default_rng(0).normal(0, [0.1] * 3 + [0.003] * 3, (5, 6)))
    poses, scores = descend_all(starts, np.ascontiguousarray(points[::20]), *table, 0.9, 30, to_planes)
    before = descend_all(starts, np.ascontiguousarray(points[::20]), *table, 0.9, 0, to_planes)[1]
    assert (scores < before).all()
    assert np.abs(poses - np.eye(4)).max() < 0.05
    alone = descend_all(starts[2:3], np.ascontiguousarray(points[::20]), *table, 0.9, 30, to_planes)
    assert alone[0][0].tobytes() == poses[2].tobytes()


def test_the_fit_is_measured_one_way() -> None:
    target = prepare_cloud(np.array([[0.0, 0, 0], [1, 0, 0], [50, 50, 50]]))
    points = np.array([[0.0, 0, 0.1], [1, 0, 0.1], [0, 0.2, 0], [1, 1, 0]])
    fit = measure_fit(points, target, np.eye(4), 0.75)
    assert fit.sum_of_squares_m2 == pytest.approx(0.01 + 0.01 + 0.04 + 1.0)
    assert fit.sum_of_distances_m == pytest.approx(1.4)
    assert fit.rmse_m == pytest.approx(np.sqrt(1.06 / 4))
    assert fit.trimmed_rmse_m == pytest.approx(np.sqrt(0.06 / 3))
    assert fit.inlier_fraction == 0.75


def test_downsampling_takes_the_mean_of_every_voxel() -> None:
    points = np.array([[0.1, 0.1], [0.3, 0.1], [-0.1, 0.1], [1.1, 0.9]])
    np.testing.assert_allclose(downsample(points, 0.5), [[-0.1, 0.1], [0.2, 0.1], [1.1, 0.9]])
    assert downsample(np.zeros((0, 3)), 1.0).shape == (0, 3)
    for voxel in (0.0, 1e-9):
        with pytest.raises(InputError, match="voxel"):
            downsample(points, voxel)
