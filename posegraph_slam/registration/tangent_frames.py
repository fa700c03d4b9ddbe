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
    """Tangent (p,) of the balanced frame that leads from pose T (4, 4) to one near by, to first order."""
    gap, apart, turn = np.zeros(3 * (d - 1)), np.zeros(3), np.zeros((3, 3))
    for a in range(3):
        apart[a] = other[a, 3] - T[a, 3]
        for b in range(3):
            apart[a] += (other[a, b] - T[a, b]) * centre[b]
            for c in range(3):
                turn[a, b] += T[c, a] * other[c, b]
    first = 0 if d == 2 else 3
    for a in range(d):
        for b in range(3):
            gap[first + a] += T[b, a] * apart[b]
    if d == 2:
        gap[2] = radius * (turn[1, 0] - turn[0, 1]) / 2
    else:
        gap[0], gap[1] = radius * (turn[2, 1] - turn[1, 2]) / 2, radius * (turn[0, 2] - turn[2, 0]) / 2
        gap[2] = radius * (turn[1, 0] - turn[0, 1]) / 2
    return gap
