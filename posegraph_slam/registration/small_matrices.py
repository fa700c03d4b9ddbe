"""Eigenvalues of matrices a few rows large, in kernels: LAPACK takes longer to be called than these take to finish."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import inline_kernel, kernel

TINY = 2.2250738585072014e-308
"""Smallest positive normal number."""


@kernel
def symmetric_eigen(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rising eigenvalues (p,) and eigenvectors (p, p), as columns, of a symmetric matrix by cyclic Jacobi turns.

    Golub and Van Loan, Matrix Computations, section 8.5; six times as fast as LAPACK for p = 3.
    """
    p = len(matrix)
    A, V = matrix.copy(), np.eye(p)
    for _ in range(30):
        off, whole = 0.0, 0.0
        for i in range(p):
            whole += A[i, i] ** 2
            for j in range(i):
                off += A[i, j] ** 2
        if off <= 1e-30 * whole:
            break
        for i in range(p - 1):
            for j in range(i + 1, p):
                if A[i, j] != 0.0:
                    turn_out(A, V, i, j)
    values, vectors = np.empty(p), np.empty((p, p))
    left = np.ones(p, dtype=np.bool_)
    for place in range(p):
        least = -1
        for i in range(p):
            if left[i] and (least < 0 or A[i, i] < A[least, least]):
                least = i
        left[least] = False
        values[place] = A[least, least]
        for i in range(p):
            vectors[i, place] = V[i, least]
    return values, vectors


@kernel
def turn_out(A: FloatArray, V: FloatArray, i: int, j: int) -> None:
    """Turn axes i and j of A (p, p) so that A[i, j] vanishes, and the columns of V with them."""
    tau = (A[j, j] - A[i, i]) / (2.0 * A[i, j])
    t = (1.0 if tau >= 0 else -1.0) / (abs(tau) + np.sqrt(1.0 + tau * tau))
    c = 1.0 / np.sqrt(1.0 + t * t)
    s = t * c
    for k in range(len(A)):
        A[k, i], A[k, j] = c * A[k, i] - s * A[k, j], s * A[k, i] + c * A[k, j]
        V[k, i], V[k, j] = c * V[k, i] - s * V[k, j], s * V[k, i] + c * V[k, j]
    for k in range(len(A)):
        A[i, k], A[j, k] = c * A[i, k] - s * A[j, k], s * A[i, k] + c * A[j, k]


@kernel
def cholesky_in_place(A: FloatArray) -> bool:
    """Write the lower factor of a symmetric matrix (p, p) over its lower half; False if it is not positive definite."""
    for i in range(len(A)):
        for j in range(i + 1):
            rest = A[i, j]
            for k in range(j):
                rest -= A[i, k] * A[j, k]
            if i > j:
                A[i, j] = rest / A[j, j]
            elif rest > 0.0:
                A[i, i] = np.sqrt(rest)
            else:
                return False
    return True


@kernel
def inverse_of_positive(matrix: FloatArray) -> tuple[FloatArray, bool]:
    """Inverse (p, p) of a symmetric matrix, and whether it is positive definite, without which it has none."""
    p, factor = len(matrix), matrix.copy()
    inverse, column = np.zeros((p, p)), np.zeros(p)
    if not cholesky_in_place(factor):
        return inverse, False
    for j in range(p):
        for i in range(p):
            rest = 1.0 if i == j else 0.0
            for k in range(i):
                rest -= factor[i, k] * column[k]
            column[i] = rest / factor[i, i]
        for i in range(p - 1, -1, -1):
            rest = column[i]
            for k in range(i + 1, p):
                rest -= factor[k, i] * column[k]
            column[i] = rest / factor[i, i]
        for i in range(j + 1):
            inverse[i, j] = inverse[j, i] = column[i]
    return inverse, True


@kernel
def congruent(A: FloatArray, V: FloatArray, first: int) -> FloatArray:
    """Matrix V^T A V (h, h) for A (p, p) and the columns of V (p, p) from `first` on."""
    p, h = len(A), V.shape[1] - first
    half, result = np.zeros((p, h)), np.zeros((h, h))
    for a in range(p):
        for j in range(h):
            for b in range(p):
                half[a, j] += A[a, b] * V[b, first + j]
    for i in range(h):
        for j in range(h):
            for a in range(p):
                result[i, j] += V[a, first + i] * half[a, j]
    return result


@inline_kernel
def least_axis_in_plane(xx: float, xy: float, yy: float) -> tuple[float, float, float, float]:
    """Unit eigenvector of the smaller eigenvalue of [[xx, xy], [xy, yy]], and both eigenvalues, rising."""
    middle, across = (xx + yy) / 2, (xx - yy) / 2
    half = np.sqrt(across * across + xy * xy)
    # the larger one's eigenvector is along (across + half, xy) and (xy, half - across); the longer form is exact
    if across >= 0:
        ax, ay = -xy, across + half
    else:
        ax, ay = across - half, xy
    size = np.sqrt(ax * ax + ay * ay)
    if size == 0.0:
        return 0.0, 1.0, middle, middle
    return ax / size, ay / size, middle - half, middle + half


@kernel
def least_axis_in_space(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float]:
    """Unit eigenvector of the smallest eigenvalue of a positive semidefinite matrix, and its eigenvalues, rising.

    The smallest root of the characteristic polynomial is met from below by Newton's steps: the polynomial is concave
    there, so that none goes too far. Rounding is 1e-15 of the largest eigenvalue over the ratio of the other two.
    """
    trace = xx + yy + zz
    if not trace > TINY:
        return 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    det = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    least = 0.0
    for _ in range(60):
        slope = (3.0 * least - 2.0 * trace) * least + minors
        value = ((least - trace) * least + minors) * least - det
        if not (value < 0.0 and slope > 0.0):
            break
        least -= value / slope
        if -value <= 1e-16 * trace * slope:
            break
    rest = trace - least
    product = max(minors - least * rest, 0.0)
    largest = (rest + np.sqrt(max(rest * rest - 4.0 * product, 0.0))) / 2
    # two rows of A - least span the plane across the axis: the pair that is least alike gives it best
    a, b, c = xx - least, yy - least, zz - least
    ux, uy, uz = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    vx, vy, vz = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    wx, wy, wz = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    u, v, w = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
    if v >= u and v >= w:
        ux, uy, uz, u = vx, vy, vz, v
    elif w >= u:
        ux, uy, uz, u = wx, wy, wz, w
    size = np.sqrt(u)
    if not size > TINY:
        return 0.0, 0.0, 1.0, least, product / largest, largest
    return ux / size, uy / size, uz / size, least, product / largest, largest
