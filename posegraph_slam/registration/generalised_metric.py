"""The metric of generalised ICP and what a pair adds to its normal equations."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel


@kernel
def flat_metric(
    nx: float, ny: float, nz: float, mx: float, my: float, mz: float, share: float, M: FloatArray
) -> None:  # fmt: skip
    """Write 2 share (C_n + C_m)^-1 (3, 3), C of variance 1 along and `share` across a line or plane with that normal.

    A shift along two equal normals then counts once, one along their plane `share` times.
    """
    e = share - 1.0
    xx, yy, zz = 2.0 + e * (nx * nx + mx * mx), 2.0 + e * (ny * ny + my * my), 2.0 + e * (nz * nz + mz * mz)
    xy, xz, yz = e * (nx * ny + mx * my), e * (nx * nz + mx * mz), e * (ny * nz + my * mz)
    cx, cy, cz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    f = 2.0 * share / (xx * cx + xy * cy + xz * cz)
    M[0, 0], M[1, 1], M[2, 2] = f * cx, f * (xx * zz - xz * xz), f * (xx * yy - xy * xy)
    M[0, 1] = M[1, 0] = f * cy
    M[0, 2] = M[2, 0] = f * cz
    M[1, 2] = M[2, 1] = f * (xy * xz - xx * yz)


@kernel
def metric_of_pair(
    d: int, T: FloatArray, target: FloatArray, moved: FloatArray, normal: FloatArray, source_normal: FloatArray,
    plane_share: float, metric: FloatArray, shift: FloatArray,
) -> float:  # fmt: skip
    """Write metric (3, 3) and shift (3,) of a pair in the source frame; the length of the shift in the metric."""
    for a in range(3):
        shift[a] = 0.0
        for b in range(d):
            shift[a] += T[b, a] * (moved[b] - target[b])
    nx = T[0, 0] * normal[0] + T[1, 0] * normal[1] + T[2, 0] * normal[2]
    ny = T[0, 1] * normal[0] + T[1, 1] * normal[1] + T[2, 1] * normal[2]
    nz = T[0, 2] * normal[0] + T[1, 2] * normal[1] + T[2, 2] * normal[2]
    flat_metric(nx, ny, nz, source_normal[0], source_normal[1], source_normal[2], plane_share, metric)
    square = 0.0
    for a in range(3):
        for b in range(3):
            square += shift[a] * metric[a, b] * shift[b]
    return float(np.sqrt(square))


@kernel
def add_pull(
    arm: FloatArray, metric: FloatArray, shift: FloatArray, weight: float, H: FloatArray, g: FloatArray
) -> None:
    """Add a pair, all in the source frame, to the Hessian (6, 6) and gradient (6,) in [turn, move].

    A turn w moves the point by w x arm: with A = hat(arm) and metric M the blocks are A M A^T, A M and M.
    """
    x, y, z = arm[0], arm[1], arm[2]
    for b in range(3):
        ax, ay, az = weight * metric[0, b], weight * metric[1, b], weight * metric[2, b]
        pull = ax * shift[0] + ay * shift[1] + az * shift[2]
        g[3 + b] += pull
        if b == 0:
            g[1] += z * pull
            g[2] -= y * pull
        elif b == 1:
            g[0] -= z * pull
            g[2] += x * pull
        else:
            g[0] += y * pull
            g[1] -= x * pull
        tx, ty, tz = y * az - z * ay, z * ax - x * az, x * ay - y * ax  # column b of A M
        H[0, 3 + b] += tx
        H[1, 3 + b] += ty
        H[2, 3 + b] += tz
        H[3 + b, 0] += tx
        H[3 + b, 1] += ty
        H[3 + b, 2] += tz
        H[3, 3 + b] += ax
        H[4, 3 + b] += ay
        H[5, 3 + b] += az
        for a in range(3):
            along = tx if a == 0 else (ty if a == 1 else tz)
            if b == 0:
                H[a, 1] += z * along
                H[a, 2] -= y * along
            elif b == 1:
                H[a, 0] -= z * along
                H[a, 2] += x * along
            else:
                H[a, 0] += y * along
                H[a, 1] -= x * along


@kernel
def of_dimension(d: int, H: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Hessian (p, p) and gradient (p,) from those of space in [turn, move]: in the plane [x, y, turn about z]."""
    if d == 3:
        return H, g
    pick = (3, 4, 2)
    small, short = np.empty((3, 3)), np.empty(3)
    for a in range(3):
        short[a] = g[pick[a]]
        for b in range(3):
            small[a, b] = H[pick[a], pick[b]]
    return small, short
