"""Carrying corrected poses over to a whole trajectory."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, SE3, Trajectory, deform, pose_from_xyt

RNG = np.random.default_rng(0)


def walk(count: int) -> Trajectory:
    steps = RNG.normal([0.1, 0.0, 0.0], [0.1, 0.02, 0.05], (count, 3))
    poses = np.zeros((count, 3, 3))
    poses[0] = np.eye(3)
    for k in range(1, count):
        poses[k] = poses[k - 1] @ SE2.exp(steps[k])
    return Trajectory(stamps_s=np.arange(count, dtype=np.float64), poses=poses, parent="odom", child="base")


def test_without_correction_nothing_changes() -> None:
    trajectory, anchors = walk(50), np.array([0, 7, 20, 44])
    result = deform(trajectory, anchors, trajectory.poses[anchors])
    np.testing.assert_allclose(result.poses, trajectory.poses, atol=1e-12)


def test_a_rigid_correction_moves_all_poses_rigidly() -> None:
    trajectory, anchors = walk(50), np.array([3, 7, 20, 44])
    T = pose_from_xyt(np.array([4.0, -2.0, 0.7]))
    result = deform(trajectory, anchors, T @ trajectory.poses[anchors])
    np.testing.assert_allclose(result.poses, T @ trajectory.poses, atol=1e-9)


def test_anchors_are_met_exactly_and_the_way_between_is_continuous() -> None:
    trajectory, anchors = walk(60), np.array([0, 15, 30, 59])
    wanted = SE2.retract(trajectory.poses[anchors], RNG.normal(0, 0.1, (4, 3)))
    result = deform(trajectory, anchors, wanted)
    assert (result.poses[anchors] == wanted).all()
    old = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    new = np.linalg.norm(np.diff(result.positions, axis=0), axis=1)
    assert np.abs(new - old).max() < 0.06


def test_spatial_trajectories_and_pauses() -> None:
    poses = np.tile(np.eye(4), (6, 1, 1))
    trajectory = Trajectory(stamps_s=np.arange(6.0), poses=poses, parent="odom", child="base")
    wanted = SE3.exp(np.array([[0.0] * 6, [0, 0, 0, 0, 0, 1.0]]))
    result = deform(trajectory, np.array([0, 5]), wanted)
    np.testing.assert_allclose(result.positions[:, 2], np.linspace(0, 1, 6), atol=1e-9)


@pytest.mark.parametrize("anchors", [[], [3, 3], [4, 2]])
def test_anchors_must_rise(anchors: list[int]) -> None:
    trajectory = walk(10)
    with pytest.raises(InputError, match="rising"):
        deform(trajectory, np.array(anchors, dtype=np.int64), np.tile(np.eye(3), (len(anchors), 1, 1)))
