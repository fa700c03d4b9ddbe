"""Smoothing the poses of all scans between what matching and what odometry say of them."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE2, Trajectory
from posegraph_slam.jit import kernel
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.registration.beam_information import inverse


def smooth(trajectory: Trajectory, information: FloatArray, odometry: OdometryEstimate) -> Trajectory:
    """Return the most likely poses given matched poses (N, 3, 3), their information (N, 3, 3), and odometry's steps.

    Minimises sum |x_i|^2_information + |x_i+1 - Ad(D_i^-1) x_i + log(U_i^-1 D_i)|^2_odometry over the right updates
    x_i, where D_i are the steps of the matched poses and U_i those of the odometry: one linear solve with a
    block-tridiagonal matrix, linear in N. Matching keeps the path in place; odometry takes its jitter away.
    """
    steps = SE2.between(trajectory.poses[:-1], trajectory.poses[1:])
    error = SE2.log(SE2.between(odometry.steps, steps))
    carry = SE2.adjoint(SE2.inverse(steps))
    x = solve_chain(np.ascontiguousarray(information), inverse(odometry.covariance), carry, error)
    return trajectory.with_poses(SE2.retract(trajectory.poses, x))


@kernel
def solve_chain(information, step_information, carry, error):  # type: ignore[no-untyped-def]
    """Minimise sum x_i^T information_i x_i + r_i^T step_information_i r_i with r_i = x_i+1 - carry_i x_i + error_i.

    `information` (N, 3, 3), `step_information`, `carry` (N-1, 3, 3), `error` (N-1, 3); returns x (N, 3). Block
    elimination from the first to the last, then substitution back.
    """
    count = len(information)
    diagonal = information.copy()
    right = np.zeros((count, 3))
    upper = np.zeros((max(count - 1, 0), 3, 3))
    for i in range(count - 1):
        weighted = carry[i].T @ step_information[i]
        diagonal[i] += weighted @ carry[i]
        diagonal[i + 1] += step_information[i]
        upper[i] = -weighted
        right[i] += weighted @ error[i]
        right[i + 1] -= step_information[i] @ error[i]
    for i in range(count - 1):
        factor = np.linalg.solve(diagonal[i], upper[i]).T
        diagonal[i + 1] -= factor @ upper[i]
        right[i + 1] -= factor @ right[i]
    x = np.zeros((count, 3))
    x[count - 1] = np.linalg.solve(diagonal[count - 1], right[count - 1])
    for back in range(count - 1):
        i = count - 2 - back
        x[i] = np.linalg.solve(diagonal[i], right[i] - upper[i] @ x[i + 1])
    return x
