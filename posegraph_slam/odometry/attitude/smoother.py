"""Backward pass over the filter's estimates: what later samples say of earlier ones (Rauch, Tung, Striebel 1965)."""

from __future__ import annotations

import numpy as np

from posegraph_slam.jit import kernel
from posegraph_slam.odometry.attitude.quaternions import turn_in_body, turn_in_world, world_difference
from posegraph_slam.odometry.attitude.sigma_points import STATE


@kernel
def smooth_stream(dt, omega, gyro_noise, quaternions, biases, covariances):  # type: ignore[no-untyped-def]
    """Smooth the output of `filter_stream`, in place: quaternions (N, 4), biases (N, 3), covariances (N, 6, 6).

    A turn of the world's error stays what it is while the body turns, and a bias error b turns it by -R b dt: the
    transition is F = [[1, -R dt], [0, 1]], exact to first order in the error. With P' = F (P + Q) F^T the gain is
    G = P F^T P'^-1, and the state moves by G times what it was to become less what it was predicted to become.
    """
    n = len(dt)
    F, noise = np.eye(STATE), np.zeros(STATE)
    q, turn, difference = np.empty(4), np.empty(3), np.empty(STATE)
    for k in range(n - 2, -1, -1):
        step = dt[k + 1]
        if not step > 0.0:
            quaternions[k], biases[k], covariances[k] = quaternions[k + 1], biases[k + 1], covariances[k + 1]
            continue
        rate = omega[k + 1] - biases[k]
        size = np.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
        known = np.isfinite(size)
        q[:] = quaternions[k]
        if known:
            turn_in_body(q, rate[0] * step, rate[1] * step, rate[2] * step, q)
        noise[:3] = (gyro_noise[0] ** 2 + gyro_noise[1] ** 2 * size if known else gyro_noise[3] ** 2) * step
        noise[3:] = gyro_noise[2] ** 2 * step
        F[:3, 3:] = 0.0
        if known:
            _fill_turn(quaternions[k], -step, F)
        P = covariances[k]
        predicted = F @ (P + np.diag(noise)) @ F.T
        G = np.linalg.solve(predicted, F @ P).T
        world_difference(q, quaternions[k + 1], turn)
        difference[:3] = turn
        difference[3:] = biases[k + 1] - biases[k]
        move = G @ difference
        turn_in_world(quaternions[k], move[0], move[1], move[2], quaternions[k])
        biases[k] += move[3:]
        P += G @ (covariances[k + 1] - predicted) @ G.T
        for a in range(STATE):
            for b in range(a):
                P[a, b] = P[b, a] = 0.5 * (P[a, b] + P[b, a])


@kernel
def _fill_turn(q, scale, F):  # type: ignore[no-untyped-def]
    """Write `scale` times the rotation matrix of q (4,) into the upper right block of F."""
    w, x, y, z = q
    F[0, 3], F[0, 4], F[0, 5] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    F[1, 3], F[1, 4], F[1, 5] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    F[2, 3], F[2, 4], F[2, 5] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    for a in range(3):
        for b in range(3):
            F[a, 3 + b] *= scale
