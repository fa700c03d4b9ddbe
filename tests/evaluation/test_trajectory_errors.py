"""Association, absolute and relative pose errors, against evo and by construction."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics, trajectory
from evo.core.units import Unit
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.errors import InputError
from posegraph_slam.evaluation import absolute_pose_error, pair_nearest, relative_pose_error
from posegraph_slam.evaluation.ape import Alignment
from posegraph_slam.geometry import SE2, SE3, Trajectory

STATISTICS = ("mean", "std", "median", "rmse", "max")


def pair_of_trajectories(seed: int, dimension: int, count: int = 80) -> tuple[Trajectory, Trajectory]:
    """A random walk and a noisy copy of it in another frame."""
    rng = np.random.default_rng(seed)
    group = SE2 if dimension == 2 else SE3
    steps = group.exp(rng.normal(0, 0.3, (count, group.dof)))
    noise = group.exp(rng.normal(0, 0.05, (count, group.dof)))
    true, estimate = [group.identity()], [group.exp(rng.normal(0, 1, group.dof))]
    for step, error in zip(steps, noise, strict=True):
        true.append(true[-1] @ step)
        estimate.append(estimate[-1] @ step @ error)
    stamps = 0.1 * np.arange(count + 1)
    return (
        Trajectory(stamps_s=stamps, poses=np.array(estimate), parent="map", child="base"),
        Trajectory(stamps_s=stamps, poses=np.array(true), parent="ref", child="base"),
    )


def evo_pair(estimate: Trajectory, true: Trajectory) -> tuple[trajectory.PosePath3D, trajectory.PosePath3D]:
    return tuple(trajectory.PosePath3D(poses_se3=list(t.spatial().poses)) for t in (true, estimate))


def assert_same(ours: object, theirs: metrics.PE) -> None:
    for name in STATISTICS:
        expected = theirs.get_statistic(metrics.StatisticsType(name))
        np.testing.assert_allclose(getattr(ours, name), expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("alignment", ["none", "origin", "first", "auto", "sim3"])
@pytest.mark.parametrize("seed", range(3))
def test_absolute_error_is_that_of_evo(seed: int, alignment: Alignment, dimension: int) -> None:
    estimate, true = pair_of_trajectories(seed, dimension)
    reference, aligned = evo_pair(estimate, true)
    if alignment in ("origin", "first"):
        aligned.align_origin(reference)
    if alignment == "sim3":
        aligned.align(reference, correct_scale=True)
    if alignment == "auto":
        aligned.align(reference)
    ours = absolute_pose_error(estimate, true, alignment=alignment)
    assert ours.alignment == {"auto": f"se{dimension}", "first": "origin"}.get(alignment, alignment)
    assert ours.paired == len(true)
    for relation, statistics in (
        (metrics.PoseRelation.translation_part, ours.translation_m),
        (metrics.PoseRelation.rotation_angle_deg, ours.rotation_deg),
    ):
        theirs = metrics.APE(relation)
        theirs.process_data((reference, aligned))
        assert_same(statistics, theirs)


@pytest.mark.parametrize(("dimension", "across_m"), [(2, 0.0), (2, 1.0), (3, 0.2), (3, 1.0)])
def test_the_certainty_of_the_alignment_is_what_noise_of_positions_makes_of_it(dimension: int, across_m: float) -> None:
    """Rotations are exact and positions noisy, so that what rotation errors there are come from the alignment."""
    rng = np.random.default_rng(4)
    group = SE2 if dimension == 2 else SE3
    poses = np.tile(group.identity(), (30, 1, 1))
    poses[:, 0, -1] = np.linspace(0, 5, 30)
    poses[:, 1, -1] = across_m * np.sin(np.arange(30))
    true = Trajectory(stamps_s=np.arange(30.0), poses=poses, parent="ref", child="base")
    told, made = [], []
    for _ in range(200):
        noisy = poses.copy()
        noisy[:, :-1, -1] += rng.normal(0, 0.01, (30, dimension))
        error = absolute_pose_error(true.with_poses(noisy), true)
        told.append(error.turn_sigma_deg)
        made.append(error.rotation_deg.mean)
    # in space two more turns, of much longer arms, add a little to that about the line
    assert np.mean(told) == pytest.approx(np.sqrt(np.mean(np.square(made))), rel=0.15)


def test_errors_of_rotation_are_remarked_on_where_positions_lie_in_a_line() -> None:
    _, wide = pair_of_trajectories(0, 3)
    poses = np.array(wide.poses)
    poses[:, :3, 3] = np.linspace(0, 5, len(poses))[:, None] * [1, 0, 0] + 0.01 * poses[:, :3, 3]
    line = wide.with_poses(poses)
    off = np.random.default_rng(1).normal(0, 0.02, (len(poses), 3))
    for true, alignment, remarked in ((wide, "se3", False), (line, "se3", True), (line, "first", False)):
        noisy = np.array(true.poses)
        noisy[:, :3, 3] += off
        remark = absolute_pose_error(true.with_poses(noisy), true, alignment=alignment).remark
        assert ("deg only" in remark) == remarked


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("distance_m", [None, 1.0, 5.0])
@pytest.mark.parametrize("seed", range(3))
def test_relative_error_is_that_of_evo(seed: int, distance_m: float | None, dimension: int) -> None:
    estimate, true = pair_of_trajectories(seed, dimension)
    ours = relative_pose_error(estimate, true, distances_m=(distance_m or 1.0,))
    error = ours.per_frame if distance_m is None else ours.over(distance_m)
    assert error is not None
    for relation, statistics in (
        (metrics.PoseRelation.translation_part, error.translation_m),
        (metrics.PoseRelation.rotation_angle_deg, error.rotation_deg),
    ):
        if distance_m is None:
            theirs = metrics.RPE(relation, delta=1, delta_unit=Unit.frames)
        else:
            theirs = metrics.RPE(
                relation, delta=distance_m, delta_unit=Unit.meters, rel_delta_tol=0.1, all_pairs=True,
                pairs_from_reference=True,
            )  # fmt: skip
        theirs.process_data(evo_pair(estimate, true))
        assert statistics is not None
        assert statistics.count == len(theirs.error)
        assert_same(statistics, theirs)


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_errors_do_not_see_the_choice_of_frame_nor_the_order(seed: int, dimension: int) -> None:
    rng = np.random.default_rng(seed)
    estimate, true = pair_of_trajectories(seed, dimension, 25)
    moved = estimate.with_poses(estimate.group.exp(rng.normal(0, 2, estimate.group.dof)) @ estimate.poses)
    shuffled = moved.select(rng.permutation(len(moved)))
    a, b = absolute_pose_error(estimate, true), absolute_pose_error(shuffled, true)
    np.testing.assert_allclose(a.translation_m.rmse, b.translation_m.rmse, atol=1e-9)
    np.testing.assert_allclose(a.rotation_deg.rmse, b.rotation_deg.rmse, atol=1e-5)
    perfect = absolute_pose_error(true.select(rng.permutation(len(true))), true)
    assert perfect.translation_m.max < 1e-9


def test_stamps_pair_with_their_nearest() -> None:
    pairs = pair_nearest(np.array([2.0, 0.0, 1.0]), np.array([1.009, 5.0, 0.011, -0.01]), max_dt_s=0.02)
    np.testing.assert_array_equal(pairs.estimate, [1, 1, 2])
    np.testing.assert_array_equal(pairs.reference, [3, 2, 0])
    assert len(pair_nearest(np.zeros(0), np.ones(3))) == 0


@given(st.integers(0, 2**32 - 1))
def test_pairing_is_that_of_an_exhaustive_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    estimate, reference = rng.uniform(0, 1, 30), rng.uniform(0, 1, 20)
    apart = np.abs(estimate[:, None] - reference)
    best = apart.argmin(axis=0)
    expected = {(int(best[k]), k) for k in range(20) if apart[best[k], k] <= 0.02}
    pairs = pair_nearest(estimate, reference, max_dt_s=0.02)
    assert set(zip(pairs.estimate.tolist(), pairs.reference.tolist(), strict=True)) == expected


def test_a_spatial_truth_serves_a_planar_estimate_and_is_projected() -> None:
    estimate, true = pair_of_trajectories(1, 2)
    lifted = true.spatial()
    poses = lifted.poses.copy()
    poses[:, 2, 3] = 0.7
    raised = lifted.with_poses(poses)
    against_raised, against_true = (absolute_pose_error(estimate, truth) for truth in (raised, true))
    assert against_raised.alignment == "se2"
    for name in STATISTICS:
        for part in ("translation_m", "rotation_deg"):
            values = [getattr(getattr(result, part), name) for result in (against_raised, against_true)]
            np.testing.assert_allclose(*values, rtol=1e-12)
    flat = absolute_pose_error(estimate.spatial(), raised, alignment="se2")
    np.testing.assert_allclose(flat.translation_m.rmse, absolute_pose_error(estimate, true).translation_m.rmse)
    with pytest.raises(InputError, match="cannot be aligned in space"):
        absolute_pose_error(estimate, true, alignment="se3")


def test_a_robot_that_never_moves_is_aligned_at_its_origin() -> None:
    still = Trajectory(stamps_s=np.arange(5.0), poses=SE2.identity(5), parent="map", child="base")
    result = absolute_pose_error(still, still)
    assert result.alignment == "origin"
    assert result.rotation_deg.max == 0.0
    assert relative_pose_error(still, still).over_distance[0].translation_m is None


def test_trajectories_of_different_times_are_refused() -> None:
    estimate, true = pair_of_trajectories(0, 2)
    later = true.restamped(true.stamps_s + 1e6)
    for metric in (absolute_pose_error, relative_pose_error):
        with pytest.raises(InputError, match=r"only 0 of 81 reference stamps .* one clock"):
            metric(estimate, later)
