"""Smoothing takes the jitter out of matched poses and keeps them in place."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.geometry import SE2, Trajectory
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.smoothing import smooth, solve_chain

RNG = np.random.default_rng(5)


def test_the_chain_is_solved_as_by_a_dense_solver() -> None:
    count = 12
    information = np.array([np.diag(RNG.uniform(0.1, 5, 3)) for _ in range(count)])
    between = np.array([np.diag(RNG.uniform(0.1, 5, 3)) for _ in range(count - 1)])
    carry, error = RNG.normal(0, 1, (count - 1, 3, 3)), RNG.normal(0, 1, (count - 1, 3))
    A, b = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
    for i in range(count):
        A[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += information[i]
    for i in range(count - 1):
        J = np.zeros((3, 3 * count))
        J[:, 3 * i : 3 * i + 3], J[:, 3 * i + 3 : 3 * i + 6] = -carry[i], np.eye(3)
        A += J.T @ between[i] @ J
        b -= J.T @ between[i] @ error[i]
    expected = np.linalg.solve(A, b).reshape(count, 3)
    np.testing.assert_allclose(solve_chain(information, between, carry, error), expected, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 400])
def test_jitter_is_smoothed_and_the_path_stays(count: int) -> None:
    steps = SE2.exp(np.tile([0.02, 0.0, 0.01], (count - 1, 1)))
    truth = [np.eye(3)]
    for step in steps:
        truth.append(truth[-1] @ step)
    true = np.array(truth)
    sigmas = np.array([0.005, 0.005, 0.002])
    matched = SE2.retract(true, RNG.normal(0, sigmas, (count, 3)))
    stamps = np.arange(count, dtype=np.float64)
    # wheels that roll one per cent too far, with no noise
    wheels = [np.eye(3)]
    for step in steps:
        wheels.append(wheels[-1] @ SE2.exp(1.01 * SE2.log(step)))
    odometry = OdometryEstimate(
        trajectory=Trajectory(stamps_s=stamps, poses=np.array(wheels), parent="odom", child="base"),
        covariance=np.tile(np.diag([1e-6, 1e-6, 1e-7]), (max(count - 1, 0), 1, 1)),
        source="wheels",
    )
    information = np.tile(np.diag(sigmas**-2), (count, 1, 1))
    trajectory = Trajectory(stamps_s=stamps, poses=matched, parent="map", child="base")
    result = smooth(trajectory, information, odometry)
    error_before = np.linalg.norm(trajectory.positions - true[:, :2, 2], axis=1)
    error_after = np.linalg.norm(result.positions - true[:, :2, 2], axis=1)
    assert error_after.max() < 0.02
    if count == 400:
        assert np.sqrt(np.mean(error_after**2)) < 0.6 * np.sqrt(np.mean(error_before**2))
        assert abs(result.path_length_m - 0.02 * 399) < 0.1 * abs(trajectory.path_length_m - 0.02 * 399)
