"""Information and directions between the balanced frame of the pairs and the source origin, in kernels."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.small_matrices import congruent


@kernel
def frame_matrix(d: int, centre: FloatArray, radius: float, forward: bool) -> FloatArray:
    """Matrix (p, p) from tangents about `centre`, turns measured on `radius`, to those at the origin, or backwards.

    It is the adjoint of the shift to the centre: a turn w there is a turn w and a shift centre x w at the origin.
    """
    p = 3 * (d - 1)
    A = np.eye(p)
    sign, unit = (1.0, 1.0 / radius) if forward else (-1.0, radius)
    lever = unit if forward else 1.0
    if d == 2:
        A[2, 2] = unit
        A[0, 2], A[1, 2] = sign * centre[1] * lever, -sign * centre[0] * lever
        return A
    hat = np.array([[0.0, -centre[2], centre[1]], [centre[2], 0.0, -centre[0]], [-centre[1], centre[0], 0.0]])
    for a in range(3):
        A[a, a] = unit
        for b in range(3):
            A[3 + a, b] = sign * hat[a, b] * lever
    return A


@kernel
def to_origin(d: int, information: FloatArray, centre: FloatArray, radius: float) -> FloatArray:
    """Information (p, p) of the tangent at the source origin from that of the balanced frame."""
    back = frame_matrix(d, centre, radius, False)
    result = congruent(information, back, 0)
    return (result + result.T) / 2


@kernel
def free_at_origin(d: int, vectors: FloatArray, free: int, centre: FloatArray, radius: float) -> FloatArray:
    """Unit tangents (free, p) at the source origin of the first `free` eigenvectors (p, p)."""
    forward = frame_matrix(d, centre, radius, True)
    result = np.zeros((free, len(vectors)))
    for j in range(free):
        size = 0.0
        for a in range(len(vectors)):
            for b in range(len(vectors)):
                result[j, a] += forward[a, b] * vectors[b, j]
            size += result[j, a] ** 2
        result[j] /= np.sqrt(size)
    return result


@kernel
def gap_between(d: int, T: FloatArray, other: FloatArray, centre: FloatArray, radius: float) -> FloatArray:
    """Tangent (p,) of the balanced frame that leads from pose T (4, 4) to another one: the logarithm.

    To first order it would be off by half the turn times the shift: 0.5 mm for 20 mrad and 5 cm, where point-to-point
    may end in space, as much as lines and planes leave open. Turns over a right angle are not expected.
    """
    gap, apart, turn, shift = np.zeros(3 * (d - 1)), np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    for a in range(3):
        apart[a] = other[a, 3] - T[a, 3]
        for b in range(3):
            apart[a] += (other[a, b] - T[a, b]) * centre[b]
            for c in range(3):
                turn[a, b] += T[c, a] * other[c, b]
    for a in range(3):
        for b in range(3):
            shift[a] += T[b, a] * apart[b]
    x, y, z = (turn[2, 1] - turn[1, 2]) / 2, (turn[0, 2] - turn[2, 0]) / 2, (turn[1, 0] - turn[0, 1]) / 2
    sine = np.sqrt(x * x + y * y + z * z)
    angle = np.arcsin(min(sine, 1.0))
    grown, bend = 1.0, 1.0 / 12.0
    if angle > 1e-4:
        grown = angle / sine
        bend = (1.0 - angle * (1.0 + np.cos(angle)) / (2.0 * sine)) / (angle * angle)
    x, y, z = grown * x, grown * y, grown * z
    # V^-1 = 1 - K / 2 + bend K K for K = hat(turn) (Sola et al. 2018, equation 146)
    u, v, w = y * shift[2] - z * shift[1], z * shift[0] - x * shift[2], x * shift[1] - y * shift[0]
    apart[0] = shift[0] - u / 2 + bend * (y * w - z * v)
    apart[1] = shift[1] - v / 2 + bend * (z * u - x * w)
    apart[2] = shift[2] - w / 2 + bend * (x * v - y * u)
    if d == 2:
        gap[0], gap[1], gap[2] = apart[0], apart[1], radius * z
        return gap
    gap[0], gap[1], gap[2] = radius * x, radius * y, radius * z
    gap[3], gap[4], gap[5] = apart[0], apart[1], apart[2]
    return gap
