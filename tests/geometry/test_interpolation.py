"""Interpolation along the geodesic, and what a trajectory accepts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, SE3, Group, Trajectory, interpolate, spatial_from_planar

groups = pytest.mark.parametrize("group", [SE2, SE3], ids=lambda g: g.name)


def trajectory(group: Group, stamps_s: FloatArray, seed: int = 0) -> Trajectory:
    steps = np.random.default_rng(seed).normal(size=(len(stamps_s), group.dof)) * 0.4
    poses = group.identity(len(stamps_s))
    for k in range(1, len(stamps_s)):
        poses[k] = poses[k - 1] @ group.exp(steps[k])
    return Trajectory(stamps_s=stamps_s, poses=poses, parent="odom", child="base")


@groups
def test_known_stamps_return_their_poses(group: Group) -> None:
    known = trajectory(group, np.array([0.0, 0.1, 0.5, 2.0]))
    found = interpolate(known, known.stamps_s)
    np.testing.assert_allclose(found.poses, known.poses, atol=1e-13)
    assert (found.parent, found.child) == ("odom", "base")


@groups
@given(st.floats(0, 1))
def test_a_constant_twist_is_followed(group: Group, share: float) -> None:
    twist = np.linspace(0.3, -0.5, group.dof)
    stamps = np.array([10.0, 11.0, 12.5])
    poses = group.exp((stamps[:, None] - 10.0) * twist)
    known = Trajectory(stamps_s=stamps, poses=poses, parent="odom", child="base")
    at = 10.0 + 2.5 * share
    np.testing.assert_allclose(interpolate(known, np.array([at])).poses[0], group.exp((at - 10.0) * twist), atol=1e-12)


@groups
def test_ends_are_held(group: Group) -> None:
    known = trajectory(group, np.array([1.0, 2.0, 3.0]))
    found = interpolate(known, np.array([-5.0, 99.0]))
    np.testing.assert_allclose(found.poses, known.poses[[0, -1]], atol=1e-13)


@groups
def test_order_of_record_does_not_matter(group: Group) -> None:
    known = trajectory(group, np.array([0.0, 1.0, 2.0, 3.0, 4.0]))
    shuffled = known.select(np.array([3, 0, 4, 1, 2]))
    at = np.linspace(-0.5, 4.5, 23)
    np.testing.assert_array_equal(interpolate(shuffled, at).poses, interpolate(known, at).poses)


@groups
def test_the_last_of_equal_stamps_counts(group: Group) -> None:
    known = trajectory(group, np.array([0.0, 1.0, 1.0, 2.0]))
    at = np.array([0.4, 1.0, 1.7])
    kept = known.select(np.array([0, 2, 3]))
    np.testing.assert_allclose(interpolate(known, at).poses, interpolate(kept, at).poses, atol=1e-14)
    np.testing.assert_allclose(interpolate(known, at).poses[1], known.poses[2], atol=1e-13)


@groups
def test_one_pose_holds_everywhere(group: Group) -> None:
    known = trajectory(group, np.array([7.0]))
    assert interpolate(known, np.array([0.0, 7.0, 9.0])).poses.shape == (3, group.matrix_size, group.matrix_size)
    with pytest.raises(InputError, match="no poses"):
        interpolate(known.select(np.zeros(0, dtype=np.int64)), np.array([1.0]))


def test_large_epochs_stay_exact() -> None:
    epoch = 1_700_000_000.0
    stamps = epoch + np.arange(5) / 64  # sixty-fourths are exact in float64
    known = Trajectory(stamps_s=stamps, poses=SE2.exp(np.outer(np.arange(5), [1.0, 0, 0])), parent="odom", child="base")
    found = interpolate(known, stamps[:-1] + 1 / 128)
    np.testing.assert_array_equal(found.stamps_s - epoch, np.arange(4) / 64 + 1 / 128)
    np.testing.assert_allclose(found.positions[:, 0], np.arange(4) + 0.5, atol=1e-12)
    assert known.in_stamp_order().stamps_s.tolist() == stamps.tolist()


@pytest.mark.parametrize(
    ("stamps", "poses"),
    [
        (np.zeros(3), np.zeros((2, 3, 3))),
        (np.zeros((3, 1)), np.zeros((3, 3, 3))),
        (np.zeros(3), np.zeros((3, 3))),
        (np.zeros(3), np.zeros((3, 2, 2))),
        (np.zeros(3), np.zeros((3, 3, 4))),
    ],
)
def test_shapes_that_do_not_fit_are_refused(stamps: FloatArray, poses: FloatArray) -> None:
    with pytest.raises(InputError, match="do not fit"):
        Trajectory(stamps_s=stamps, poses=poses, parent="odom", child="base")


def test_a_trajectory_is_read_only_and_knows_itself() -> None:
    poses = SE2.exp(np.outer(np.arange(4), [0.5, 0, 0]))
    known = Trajectory(stamps_s=np.arange(4.0), poses=poses, parent="map", child="base")
    with pytest.raises(ValueError, match="read-only"):
        known.poses[0, 0, 0] = 2
    assert known.group is SE2
    assert known.path_length_m == pytest.approx(1.5)
    spatial = known.spatial()
    assert spatial.group is SE3
    np.testing.assert_array_equal(spatial.poses, spatial_from_planar(poses))
    assert spatial.spatial().poses.shape == (4, 4, 4)
    assert known.with_poses(poses, parent="odom").parent == "odom"
