"""Unit quaternions [w, x, y, z] in kernels: product, exponential, logarithm, gravity direction, mean on the manifold."""

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
def multiply(a, b, out):  # type: ignore[no-untyped-def]
    """Write the product a b (4,) into `out`, which may be neither a nor b."""
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]


@kernel
def turn(q, x, y, z, out):  # type: ignore[no-untyped-def]
    """Write q exp([x, y, z]) (4,), normalised, into `out`, which may be q: a turn by a rotation vector of the body."""
    half2 = 0.25 * (x * x + y * y + z * z)
    # Below a half-angle of 1e-4 the series of sin(h)/h and cos(h) leave less than 1e-18.
    if half2 < 1e-8:
        s, c = 0.5 * (1.0 - half2 / 6.0), 1.0 - 0.5 * half2
    else:
        h = math.sqrt(half2)
        s, c = 0.5 * math.sin(h) / h, math.cos(h)
    x, y, z = s * x, s * y, s * z
    w0 = q[0] * c - q[1] * x - q[2] * y - q[3] * z
    w1 = q[0] * x + q[1] * c + q[2] * z - q[3] * y
    w2 = q[0] * y - q[1] * z + q[2] * c + q[3] * x
    w3 = q[0] * z + q[1] * y - q[2] * x + q[3] * c
    scale = 1.0 / math.sqrt(w0 * w0 + w1 * w1 + w2 * w2 + w3 * w3)
    out[0], out[1], out[2], out[3] = w0 * scale, w1 * scale, w2 * scale, w3 * scale


@kernel
def difference(a, b, out):  # type: ignore[no-untyped-def]
    """Write the rotation vector (3,) of a^-1 b, at most pi long, into `out`."""
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    x = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2]
    y = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1]
    z = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0]
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
    """Move `mean` (4,) to the mean of `points` (n, 4), and write their rotation vectors (n, 3) from it into `errors`.

    Gradient descent on the manifold: turn by the mean error vector until it vanishes (Kraft 2003, section 3.4).
    """
    n = points.shape[0]
    for _ in range(MEAN_ITERATIONS):
        x = y = z = 0.0
        for i in range(n):
            difference(mean, points[i], errors[i])
            x, y, z = x + errors[i, 0], y + errors[i, 1], z + errors[i, 2]
        if math.sqrt(x * x + y * y + z * z) < n * MEAN_TOLERANCE_RAD:
            return
        turn(mean, x / n, y / n, z / n, mean)
    for i in range(n):
        difference(mean, points[i], errors[i])


def wxyz_from_rotation(R: FloatArray) -> FloatArray:
    """Quaternions (..., 4) [w, x, y, z] with w >= 0 from rotations (..., 3, 3)."""
    xyzw = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(np.roll(xyzw, 1, axis=1)).reshape(*R.shape[:-2], 4)


def rotation_from_wxyz(q: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) from quaternions (..., 4) [w, x, y, z]."""
    xyzw = np.roll(q.reshape(-1, 4), -1, axis=1)
    return np.asarray(Rotation.from_quat(xyzw).as_matrix()).reshape(*q.shape[:-1], 3, 3)
