"""How fast the sum of the pairs' scores changes with the pose: less than the Jacobian of noisy lines tells."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.score_products import share_of_source
from posegraph_slam.registration.small_matrices import TINY, cholesky_in_place, inverse_of_positive

LEAST_SLOPE = 0.1
"""Mean curvature of the loss, over that of least squares, that is taken at least: it may be negative far out."""


@kernel
def follow_partners(
    offset: FloatArray, weight: FloatArray, target: FloatArray, anchors: FloatArray, normals: FloatArray,
    thickness: FloatArray, size: FloatArray, k_all: int, t: IntArray, bend: FloatArray,
) -> None:  # fmt: skip
    """Diminish the curvatures (m,) of the pairs in the plane by the share in which lines follow the source points.

    Where points are as dense as they are noisy, the nearest target of a source point that moves off the surface is one
    that errs as it does: its height follows by the share b, the slope of the targets' heights over the sources' (which
    is the mean derivative for normal noise: Stein 1981). The points about a target at a height h are those in a disc of
    radius R about it, and their mean height is e h with e = (sigma / R)^2, to first order; its return to the surface
    makes this e + (1 - e) e. A move of the source by 1 moves the distance by 1 - b e (2 - e): at 1081 beams and 2 to
    3 cm 0.95 to 0.98. The line's own noise is in both heights. In space points are far apart for their noise, and
    what both heights share is rather the surface's own roughness.
    """
    count = len(t)
    follows = np.empty(count)
    together, alone = 0.0, 0.0
    for k in range(count):
        at = t[k]
        height = normals[at, 0] * (target[at, 0] - anchors[at, 0]) + normals[at, 1] * (target[at, 1] - anchors[at, 1])
        share = thickness[at] ** 2 / 3.0  # the mean square along a line is R^2 / 3
        follows[k] = share / max(share, size[k]) if share > 0.0 else 0.0
        together += weight[k] * follows[k] * height * offset[k]
        alone += weight[k] * follows[k] * offset[k] * offset[k]
    common = 1.0 / share_of_source(2, k_all)
    b = min(max(common * together / max(alone, TINY) - (common - 1.0 - 1.0 / k_all), 0.0), 1.0)
    for k in range(count):
        bend[k] *= 1.0 - b * follows[k] * (2.0 - follows[k])


@kernel
def without_tilts(
    H: FloatArray, jacobian: FloatArray, source: FloatArray, s: IntArray, centre: FloatArray, radius: float,
    thickness: FloatArray, size: FloatArray, k_all: int, t: IntArray, weight: FloatArray, bend: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """H (3, 3), which is J^T W J, and the same sum D by curvatures, less what is noise of the lines' directions.

    The axis of k points of variances a along and b across it errs by the angle (a b / k)^0.5 / (a - b) (Anderson 1963),
    at most by any at all, and a row of the Jacobian by as much times its derivative. Along a corridor this looks like
    walls across it: at 1081 beams it is over the hundredth of the whole at which a direction counts as held.
    """
    hxx, hxy, hyy, hxt, hyt, htt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    xx, xy, yy, xt, yt, tt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    inverse, count = 1.0 / radius, float(k_all)
    for k in range(len(t)):
        at, across, u, v, turn = s[k], thickness[t[k]], jacobian[k, 0], jacobian[k, 1], jacobian[k, 2]
        across *= across
        longer = size[k] - across
        tilt = min(size[k] * across / (count * longer * longer), 0.5) if longer > 0.0 else 0.5
        turned = ((source[at, 0] - centre[0]) * u + (source[at, 1] - centre[1]) * v) * inverse
        vv, uv, uu, vt, ut, square = v * v, u * v, u * u, v * turned, u * turned, turned * turned
        held, part = bend[k], tilt * bend[k]
        xx, xy, yy = xx + held * uu - part * vv, xy + (held + part) * uv, yy + held * vv - part * uu
        xt, yt = xt + held * u * turn + part * vt, yt + held * v * turn - part * ut
        tt += held * turn * turn - part * square
        part = tilt * weight[k]
        hxx, hxy, hyy = hxx + part * vv, hxy - part * uv, hyy + part * uu
        hxt, hyt, htt = hxt - part * vt, hyt + part * ut, htt + part * square
    D = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
    return H - np.array([[hxx, hxy, hxt], [hxy, hyy, hyt], [hxt, hyt, htt]]), D


@kernel
def inverse_slope(bent: FloatArray, values: FloatArray, slope: float) -> FloatArray:
    """Inverse (h, h) of the mean slope of the score along the held eigenvectors of H, whose eigenvalues end `values`.

    It is that of `bent`, the sum of each pair's curvature, unless residuals far out leave less than `LEAST_SLOPE` of H
    along any direction: then of H times the mean slope.
    """
    held = len(bent)
    free = len(values) - held
    rest = bent.copy()
    for i in range(held):
        rest[i, i] -= LEAST_SLOPE * values[free + i]
    inverse, exists = inverse_of_positive(bent)
    if not (exists and cholesky_in_place(rest)):
        inverse[:] = 0.0
        for i in range(held):
            inverse[i, i] = 1.0 / (slope * values[free + i])
    return inverse
