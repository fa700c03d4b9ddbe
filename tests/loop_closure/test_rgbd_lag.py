"""Colour and depth taken at different times: what that moves, and how much less an alignment is believed."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.geometry import SE3, Trajectory
from posegraph_slam.loop_closure.rgbd_lag import LAG_SHARE, lag_motion, loosened


def test_the_motion_during_the_lag_is_that_of_the_camera() -> None:
    twist = np.array([0.0, 0.6, 0.1, 0.3, 0.0, -0.2])
    stamps = np.array([0.0, 0.04, 0.07, 0.11, 0.14])
    poses = SE3.exp(stamps[:, None] * twist)
    trajectory = Trajectory(stamps_s=stamps, poses=poses, parent="odom", child="camera")
    lag = np.array([0.01, 0.0, -0.005, 0.02, 0.01])
    np.testing.assert_allclose(lag_motion(trajectory, np.arange(5), lag), lag[:, None] * twist, atol=1e-12)
    still = Trajectory(stamps_s=np.zeros(5), poses=poses, parent="odom", child="camera")
    assert not lag_motion(still, np.arange(5), lag).any(), "frames without times have no speed"


def test_nothing_changes_where_colour_and_depth_belong_together() -> None:
    information = np.stack([np.diag([4.0, 5, 6, 7, 8, 9]), np.eye(6)])
    T, none = SE3.exp(np.full((2, 6), 0.1)), np.zeros((2, 6))
    np.testing.assert_array_equal(loosened(information, T, none, none, np.ones(2)), information)
    # two views a steady motion apart: colours and depths tell the same
    twist = np.array([[0.02, 0.0, 0.01, 0.0, 0.03, 0.0]])
    same = loosened(np.eye(6)[None], SE3.exp(5 * twist), twist, twist.copy() * (1 + 1e-12), np.ones(1))
    np.testing.assert_allclose(same, np.eye(6)[None], atol=1e-9)


def test_a_turn_at_one_end_counts_as_a_turn_and_as_a_shift_at_the_depth_of_the_view() -> None:
    turn, depth = 0.04, 2.5
    tight = np.eye(6)[None] * 1e12
    motion = np.array([[0.0, turn, 0.0, 0.0, 0.0, 0.0]])
    for ends in ((motion, np.zeros((1, 6))), (np.zeros((1, 6)), motion)):
        sigma = np.sqrt(np.diagonal(np.linalg.inv(loosened(tight, np.eye(4)[None], *ends, np.array([depth]))[0])))
        assert sigma[:3] == pytest.approx(LAG_SHARE * turn, rel=1e-3)
        assert sigma[3:] == pytest.approx(LAG_SHARE * turn * depth, rel=1e-3)
