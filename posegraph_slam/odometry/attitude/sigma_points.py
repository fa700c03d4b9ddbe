"""The numeric core of the quaternion UKF: one prediction, one update, and a whole stream, in kernels.

The error state is [turn in the world (3), gyro bias (3)]: q = exp(turn) q_mean. The twelve sigma points are the
columns of +-sqrt(6 P), equally weighted and without a centre (Kraft 2003, eq. 35-37). Kraft turns in the body; in the
world the heading, which gravity cannot show, is always the third component, so that no correction of the tilt turns
the variance of the heading into one of the tilt. With turns in the body a correction by d rad leaks a share d of it.
"""

from __future__ import annotations

import math

import numpy as np

from posegraph_slam.jit import kernel
from posegraph_slam.odometry.attitude.quaternions import (
    mean_quaternion,
    turn_in_body,
    turn_in_world,
    up_in_body,
)

STATE = 6
POINTS = 2 * STATE


@kernel
def cholesky(P, L):  # type: ignore[no-untyped-def]
    """Write the lower factor of P (n, n) into L; a direction without variance gets a zero column."""
    n = P.shape[0]
    for j in range(n):
        pivot = P[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        root = math.sqrt(pivot) if pivot > 0.0 else 0.0
        L[j, j] = root
        for i in range(j + 1, n):
            value = P[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value / root if root > 0.0 else 0.0
            L[j, i] = 0.0


@kernel
def predict_core(q, bias, P, omega, dt, noise, L, points, errors):  # type: ignore[no-untyped-def]
    """Advance q (4,), bias (3,) and P (6, 6) in place by `dt` seconds at the measured rate `omega` (3,).

    `noise` holds the gyro's in rad/sqrt(s) and rad/sqrt(rad), the bias walk in rad/s/sqrt(s), and what replaces the
    first where `omega` is not finite: the body is then taken to rest. L (6, 6), points (12, 4), errors (12, 6) are
    workspace.
    """
    x, y, z = omega[0] - bias[0], omega[1] - bias[1], omega[2] - bias[2]
    rate = math.sqrt(x * x + y * y + z * z)
    known = math.isfinite(rate)
    variance = noise[0] ** 2 + noise[1] ** 2 * rate if known else noise[3] ** 2
    for k in range(3):
        P[k, k] += variance * dt
        P[k + 3, k + 3] += noise[2] ** 2 * dt
    cholesky(P, L)
    spread = math.sqrt(float(STATE))
    for k in range(STATE):
        for side in range(2):
            i, s = 2 * k + side, spread if side == 0 else -spread
            turn_in_world(q, s * L[0, k], s * L[1, k], s * L[2, k], points[i])
            for m in range(3):
                errors[i, 3 + m] = s * L[3 + m, k]
            if known:
                turn_in_body(
                    points[i], (x - errors[i, 3]) * dt, (y - errors[i, 4]) * dt, (z - errors[i, 5]) * dt, points[i]
                )
    if known:
        turn_in_body(q, x * dt, y * dt, z * dt, q)
    mean_quaternion(points, q, errors[:, :3])
    for a in range(STATE):
        for b in range(a + 1):
            total = 0.0
            for i in range(POINTS):
                total += errors[i, a] * errors[i, b]
            P[a, b] = P[b, a] = total / POINTS


@kernel
def invert_symmetric(S, out):  # type: ignore[no-untyped-def]
    """Write the inverse of the positive definite S (3, 3) into `out` by cofactors."""
    a = S[1, 1] * S[2, 2] - S[1, 2] * S[1, 2]
    b = S[0, 2] * S[1, 2] - S[0, 1] * S[2, 2]
    c = S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1]
    scale = 1.0 / (S[0, 0] * a + S[0, 1] * b + S[0, 2] * c)
    out[0, 0], out[1, 1] = scale * a, scale * (S[0, 0] * S[2, 2] - S[0, 2] * S[0, 2])
    out[2, 2] = scale * (S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1])
    out[0, 1] = out[1, 0] = scale * b
    out[0, 2] = out[2, 0] = scale * c
    out[1, 2] = out[2, 1] = scale * (S[0, 1] * S[0, 2] - S[0, 0] * S[1, 2])


@kernel
def update_core(q, bias, P, up, sigma, L, points, errors):  # type: ignore[no-untyped-def]
    """Correct q, bias and P in place by the measured upward direction `up` (3,), a unit vector in the body.

    `sigma` is the standard deviation of each of its components in rad.
    """
    cholesky(P, L)
    spread = math.sqrt(float(STATE))
    seen, mean = np.empty((POINTS, 3)), np.zeros(3)
    for k in range(STATE):
        for side in range(2):
            i, s = 2 * k + side, spread if side == 0 else -spread
            for m in range(STATE):
                errors[i, m] = s * L[m, k]
            turn_in_world(q, errors[i, 0], errors[i, 1], errors[i, 2], points[i])
            up_in_body(points[i], seen[i])
            for m in range(3):
                mean[m] += seen[i, m] / POINTS
    S, S_inverse, cross = np.zeros((3, 3)), np.empty((3, 3)), np.zeros((STATE, 3))
    for i in range(POINTS):
        for b in range(3):
            seen_b = (seen[i, b] - mean[b]) / POINTS
            for a in range(3):
                S[a, b] += (seen[i, a] - mean[a]) * seen_b
            for a in range(STATE):
                cross[a, b] += errors[i, a] * seen_b
    for a in range(3):
        S[a, a] += sigma * sigma
    invert_symmetric(S, S_inverse)
    gain, step = cross @ S_inverse, np.zeros(STATE)
    for a in range(STATE):
        for b in range(3):
            step[a] += gain[a, b] * (up[b] - mean[b])
    for a in range(STATE):  # P - K S K' (Kraft 2003, eq. 75), with K S = cross
        for b in range(a + 1):
            total = P[a, b]
            for m in range(3):
                total -= gain[a, m] * cross[b, m]
            P[a, b] = P[b, a] = total
    turn_in_world(q, step[0], step[1], step[2], q)
    for m in range(3):
        bias[m] += step[3 + m]


@kernel
def correct(q, bias, P, accel, dt, noise, L, points, errors):  # type: ignore[no-untyped-def]
    """Apply `update_core` with the direction of `accel` (3,) where the motion allows it, and tell whether it did.

    `noise` holds gravity, sigma where |accel| is gravity, its growth with the relative excess, the largest excess that
    is believed, and for how long an error lasts. Samples that come `dt` after the last one, within that time, share
    what one alone would tell; one that comes at once tells nothing. Values that are not finite are not believed.
    """
    share = dt / noise[4] if dt < noise[4] else 1.0
    size = math.sqrt(accel[0] ** 2 + accel[1] ** 2 + accel[2] ** 2)
    excess = abs(size / noise[0] - 1.0)
    if not excess <= noise[3] or size == 0.0 or not share > 0.0:
        return False
    up = np.empty(3)
    for m in range(3):
        up[m] = accel[m] / size
    update_core(q, bias, P, up, math.sqrt((noise[1] ** 2 + (noise[2] * excess) ** 2) / share), L, points, errors)
    return True


@kernel
def filter_stream(dt, omega, accel, gyro_noise, accel_noise, q, bias, P):  # type: ignore[no-untyped-def]
    """Run over a stream: `omega` (N, 3) holds the rate over the step of `dt` (N,) that ends at `accel` (N, 3).

    q, bias and P start the filter and are changed. Returns quaternions (N, 4), biases (N, 3), covariances (N, 6, 6) and
    which samples (N,) the accelerometer corrected.
    """
    n = len(dt)
    quaternions, biases, covariances = np.empty((n, 4)), np.empty((n, 3)), np.empty((n, STATE, STATE))
    used = np.zeros(n, np.bool_)
    L, points, errors = np.zeros((STATE, STATE)), np.empty((POINTS, 4)), np.empty((POINTS, STATE))
    for k in range(n):
        if dt[k] > 0.0:
            predict_core(q, bias, P, omega[k], dt[k], gyro_noise, L, points, errors)
        used[k] = correct(q, bias, P, accel[k], dt[k], accel_noise, L, points, errors)
        quaternions[k], biases[k], covariances[k] = q, bias, P
    return quaternions, biases, covariances, used
