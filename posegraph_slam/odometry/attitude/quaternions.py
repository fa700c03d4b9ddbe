"""Unit quaternions [w, x, y, z] in kernels: turn, difference, vertical direction, mean on the manifold."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel

MEAN_ITERATIONS = 20
"""Bound on the iterations of the mean; sigma points within a radian converge in three to five."""
MEAN_TOLERANCE_RAD = 1e-9


@kernel
def exponential(x, y, z):  # type: ignore[no-untyped-def]
    """Return w, x, y, z of the unit quaternion that turns by the rotation vector [x, y, z]."""
    half2 = 0.25 * (x * x + y * y + z * z)
    # Below a half-angle of 1e-4 the series of sin(h)/h and cos(h) leave less than 1e-18.
    if half2 < 1e-8:
        s, c = 0.5 * (1.0 - half2 / 6.0), 1.0 - 0.5 * half2
    else:
        h = math.sqrt(half2)
        s, c = 0.5 * math.sin(h) / h, math.cos(h)
    return c, s * x, s * y, s * z


@kernel
def store_product(a0, a1, a2, a3, b0, b1, b2, b3, out):  # type: ignore[no-untyped-def]
    """Write the normalised product a b into `out` (4,)."""
    w = a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3
    x = a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2
    y = a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1
    z = a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    out[0], out[1], out[2], out[3] = w * scale, x * scale, y * scale, z * scale


@kernel
def turn_in_body(q, x, y, z, out):  # type: ignore[no-untyped-def]
    """Write q exp([x, y, z]) into `out` (4,), which may be q."""
    w, x, y, z = exponential(x, y, z)
    store_product(q[0], q[1], q[2], q[3], w, x, y, z, out)


@kernel
def turn_in_world(q, x, y, z, out):  # type: ignore[no-untyped-def]
    """Write exp([x, y, z]) q into `out` (4,), which may be q."""
    w, x, y, z = exponential(x, y, z)
    store_product(w, x, y, z, q[0], q[1], q[2], q[3], out)


@kernel
def world_difference(a, b, out):  # type: ignore[no-untyped-def]
    """Write the rotation vector (3,) of b a^-1, at most pi long, into `out`."""
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    x = a[0] * b[1] - a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    y = a[0] * b[2] - a[1] * b[3] - a[2] * b[0] + a[3] * b[1]
    z = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] - a[3] * b[0]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    s = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 / w if s < 1e-8 else 2.0 * math.atan2(s, w) / s
    out[0], out[1], out[2] = scale * x, scale * y, scale * z


@kernel
def up_in_body(q, out):  # type: ignore[no-untyped-def]
    """Write the world's upward direction in the body (3,), the last row of the rotation matrix, into `out`."""
    out[0] = 2.0 * (q[1] * q[3] - q[0] * q[2])
    out[1] = 2.0 * (q[2] * q[3] + q[0] * q[1])
    out[2] = 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])


@kernel
def mean_quaternion(points, mean, errors):  # type: ignore[no-untyped-def]
    """Move `mean` (4,) to the mean of `points` (n, 4), and write their turns (n, 3) from it in the world into `errors`.

    Gradient descent on the manifold: turn by the mean error vector until it vanishes (Kraft 2003, section 3.4).
    """
    n = points.shape[0]
    for _ in range(MEAN_ITERATIONS):
        x = y = z = 0.0
        for i in range(n):
            world_difference(mean, points[i], errors[i])
            x, y, z = x + errors[i, 0], y + errors[i, 1], z + errors[i, 2]
        if math.sqrt(x * x + y * y + z * z) < n * MEAN_TOLERANCE_RAD:
            return
        turn_in_world(mean, x / n, y / n, z / n, mean)
    for i in range(n):
        world_difference(mean, points[i], errors[i])


def wxyz_from_rotation(R: FloatArray) -> FloatArray:
    """Quaternions (..., 4) [w, x, y, z] with w >= 0 from rotations (..., 3, 3)."""
    xyzw = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(np.roll(xyzw, 1, axis=1)).reshape(*R.shape[:-2], 4)


def rotation_from_wxyz(q: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) from quaternions (..., 4) [w, x, y, z]."""
    xyzw = np.roll(q.reshape(-1, 4), -1, axis=1)
    return np.asarray(Rotation.from_quat(xyzw).as_matrix()).reshape(*q.shape[:-1], 3, 3)
