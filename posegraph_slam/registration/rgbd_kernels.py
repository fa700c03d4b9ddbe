"""Kernels of the direct alignment of RGB-D frames: Gauss-Newton steps from the residuals of a pose, and its fit."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.rgbd_warp import Side, view_shift, warp

POSE = 6
"""Unknowns of the pose; three more where offsets of inverse depth are estimated too, see `warp`."""
TILES = 8
"""The image is cut into 8 x 8 tiles; what they say of the motion is taken for independent."""
MEDIAN_TO_SIGMA = 1.4826
CAUCHY, CUT = 2.3849, 14.0
"""Scale of the weights in deviations, and where a residual counts no more. On wide pairs Tukey's weights, which end at
4.7, fall into wrong minima: features then miss by 3.3 px where they miss by 2.3 px with these."""


@kernel
def middle_of(values: FloatArray, about: float, absolute: bool) -> float:
    """Median of the numbers among `values` (n,) less `about`, or of their sizes; 0 where there is none."""
    kept = np.empty(len(values))
    count = 0
    for k in range(len(values)):
        if values[k] == values[k]:
            kept[count] = abs(values[k] - about) if absolute else values[k] - about
            count += 1
    if count == 0:
        return 0.0
    return float(np.partition(kept[:count], count // 2)[count // 2])


@kernel
def normal_equations(
    points: FloatArray, normals: FloatArray, gradients: FloatArray, across: FloatArray, brightness: FloatArray,
    spread: FloatArray, moved: FloatArray, sigma: FloatArray, levers: FloatArray, scales: FloatArray, H: FloatArray,
    g: FloatArray,
) -> float:  # fmt: skip
    """Add up H (m, m) and g (m,), m = 6 for the update exp(e) T, 9 with the offsets of depth, under Cauchy's weights.

    `levers` (n, 3) is what the offsets add to `across`, `scales` [deviation of `across`, that of `brightness` where its
    `spread` (n,) is 1, its offset]. Returns the weighted cost.
    """
    H[:], g[:] = 0.0, 0.0
    size = len(g)
    row = np.zeros(size)
    cost = 0.0
    for k in range(len(points)):
        if across[k] == across[k]:
            e = across[k] / scales[0]
            if abs(e) < CUT:
                weight = 1.0 / (1.0 + (e / CAUCHY) ** 2)
                factor = 1.0 / (sigma[k] * scales[0])
                nx, ny, nz = normals[k, 0] * factor, normals[k, 1] * factor, normals[k, 2] * factor
                row[0] = moved[k, 1] * nz - moved[k, 2] * ny
                row[1] = moved[k, 2] * nx - moved[k, 0] * nz
                row[2] = moved[k, 0] * ny - moved[k, 1] * nx
                row[3], row[4], row[5] = nx, ny, nz
                for a in range(POSE, size):
                    row[a] = levers[k, a - POSE] / scales[0]
                cost += weight * e * e
                for a in range(size):
                    g[a] += weight * e * row[a]
                    for b in range(a + 1):
                        H[a, b] += weight * row[a] * row[b]
        if brightness[k] == brightness[k]:
            deviation = scales[1] * spread[k]
            e = (brightness[k] - scales[2]) / deviation
            if abs(e) < CUT:
                weight = 1.0 / (1.0 + (e / CAUCHY) ** 2)
                factor = -1.0 / deviation
                hx, hy, hz = gradients[k, 0] * factor, gradients[k, 1] * factor, gradients[k, 2] * factor
                row[0] = points[k, 1] * hz - points[k, 2] * hy
                row[1] = points[k, 2] * hx - points[k, 0] * hz
                row[2] = points[k, 0] * hy - points[k, 1] * hx
                row[3], row[4], row[5] = hx, hy, hz
                cost += weight * e * e
                for a in range(6):
                    g[a] += weight * e * row[a]
                    for b in range(a + 1):
                        H[a, b] += weight * row[a] * row[b]
    for a in range(size):
        for b in range(a):
            H[b, a] = H[a, b]
    return cost


@kernel
def left_update(T: FloatArray, step: FloatArray) -> FloatArray:
    """Return exp(step) T for a step (6,) [rotation, translation]."""
    wx, wy, wz = step[0], step[1], step[2]
    angle = np.sqrt(wx * wx + wy * wy + wz * wz)
    if angle > 1e-4:
        s, c, e = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    else:
        s, c, e = 1.0 - angle**2 / 6, 0.5 - angle**2 / 24, 1.0 / 6 - angle**2 / 120
    K = np.array([[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]])
    KK = K @ K
    R, V = np.eye(3) + s * K + c * KK, np.eye(3) + c * K + e * KK
    result = np.eye(4)
    result[:3, :3] = R @ np.ascontiguousarray(T[:3, :3])
    result[:3, 3] = R @ np.ascontiguousarray(T[:3, 3]) + V @ np.ascontiguousarray(step[3:])
    return result


@kernel
def adjoint(T: FloatArray) -> FloatArray:
    """Adjoint (6, 6) of a pose for tangents [rotation, translation]."""
    A = np.zeros((6, 6))
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    for c in range(3):
        for r in range(3):
            A[r, c] = A[3 + r, 3 + c] = T[r, c]
        A[3, c] = y * T[2, c] - z * T[1, c]
        A[4, c] = z * T[0, c] - x * T[2, c]
        A[5, c] = x * T[1, c] - y * T[0, c]
    return A


@kernel
def inverse(T: FloatArray) -> FloatArray:
    """Inverse of a pose (4, 4)."""
    result = np.eye(4)
    for r in range(3):
        result[r, 3] = 0.0
        for c in range(3):
            result[r, c] = T[c, r]
            result[r, 3] -= T[c, r] * T[c, 3]
    return result


@kernel
def linearise(
    side: Side, T: FloatArray, back: bool, offsets: FloatArray, gate: float, floors: FloatArray, H: FloatArray,
    g: FloatArray,
) -> None:  # fmt: skip
    """Write H (m, m) and g (m,) of one frame's points against the other frame, each kind of residual on its scale."""
    n = len(side.points)
    across, brightness, spread, state = np.empty(n), np.empty(n), np.empty(n), np.zeros(n, np.uint8)
    moved, levers = np.zeros((n, 3)), np.zeros((n, 3))
    warp(side, T, back, offsets, gate, floors[3], across, brightness, spread, moved, levers, state)
    scales = residual_scales(across, brightness, spread, floors)
    normal_equations(
        side.points, side.normals, side.gradients, across, brightness, spread, moved, side.sigma, levers, scales, H, g
    )


@kernel
def source_update(T_source_target: FloatArray, size: int) -> FloatArray:
    """Map (m, m) from the update of T_target_source to that of its inverse: exp(e) T has T^-1 exp(-e) for inverse.

    This is exp(-Ad(T^-1) e) T^-1. Offsets of depth, if there are any, stay.
    """
    A = np.eye(size)
    A[:POSE, :POSE] = -adjoint(T_source_target)
    return A


@kernel
def residual_scales(across: FloatArray, brightness: FloatArray, spread: FloatArray, floors: FloatArray) -> FloatArray:
    """Robust deviation of `across`, that of `brightness` over its `spread`, and its offset: exposures differ."""
    scales = np.empty(3)
    scales[0] = max(MEDIAN_TO_SIGMA * middle_of(across, 0.0, True), floors[0])
    scales[2] = middle_of(brightness, 0.0, False)
    scales[1] = max(MEDIAN_TO_SIGMA * middle_of((brightness - scales[2]) / spread, 0.0, True), floors[1])
    return scales


@kernel
def offset_sigma(side: Side, T: FloatArray, sigma: float) -> float:
    """Deviation of the offsets of inverse depth between two views: `sigma` for views half an image's width apart.

    The error belongs to the sensor and lies still in its image (Teichman et al. 2013): of the same view it is the same
    in both frames and cancels, and what is left of a smooth one grows with the shift of the view.
    """
    return sigma * max(view_shift(side, T), 1e-3)


@kernel
def align_level(
    side: Side, back: Side, T: FloatArray, offsets: FloatArray, gate: float, iterations: int, floors: FloatArray
) -> tuple[FloatArray, int, bool]:
    """Iterate Gauss-Newton on one level from T; stop when a step moves the view less than a fiftieth of a pixel.

    `side` holds the target's points and the source's images, `back` the source's points, none of them to align in one
    direction, and the target's images. `offsets` (3,) of inverse depth go in and come out. `floors` (4,) are the least
    deviations [of depth in its own deviations, of brightness], the deviation of the offsets as `offset_sigma` takes it,
    0 to keep them as they are, and the noise of brightness. What is known of the offsets beforehand counts as much as a
    tile of the image: its points are no independent measurements of a smooth error. Returns the pose, iterations made,
    and whether they settled.
    """
    size = POSE + 3 if floors[2] > 0 else POSE
    H, g, H_back, g_back = np.zeros((size, size)), np.zeros(size), np.zeros((size, size)), np.zeros(size)
    distance = max(side.points[:, 2].mean(), 0.1)
    fine = 0.02 / side.camera[0]
    prior = 0.0
    if size > POSE:
        points_a_tile = max((len(side.points) + len(back.points)) / TILES**2, 1.0)
        prior = points_a_tile * offset_sigma(side, T, floors[2]) ** -2.0
    for made in range(iterations):
        linearise(side, T, False, offsets, gate, floors, H, g)
        if len(back.points) > 0:
            T_back = inverse(T)
            linearise(back, T_back, True, offsets, gate, floors, H_back, g_back)
            A = source_update(T_back, size)
            H += A.T @ H_back @ A
            g += A.T @ g_back
        for a in range(POSE, size):
            H[a, a] += prior
            g[a] += prior * offsets[a - POSE]
        for a in range(size):
            H[a, a] += 1e-6 * H[a, a] + 1e-9
        step = np.asarray(-np.linalg.solve(H, g))
        if not np.isfinite(step).all():
            return T, made, False
        T = left_update(T, step[:POSE])
        offsets[: size - POSE] += step[POSE:]
        turn = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        shift = np.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
        if turn < fine and shift < fine * distance:
            return T, made + 1, True
    return T, iterations, False


@kernel
def describe_fit(
    side: Side, T: FloatArray, back: bool, offsets: FloatArray, gate: float, floors: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return H (m, m), the sum of outer products of the scores of image tiles (m, m), and measures of the fit (10,).

    Residuals of neighbouring pixels are far from independent; those of whole tiles nearly are. The measures count
    points, then those in every state, from OUT to INVADES; then [points with a normal on a surface, those within three
    deviations, sum of their squared distances in metres, correlation of the intensities].
    """
    points, normals, gradients, intensity, sigma = (
        side.points, side.normals, side.gradients, side.intensity, side.sigma,
    )  # fmt: skip
    camera, image, n = side.camera, side.image, len(side.points)
    across, brightness, spread, state = np.empty(n), np.empty(n), np.empty(n), np.zeros(n, np.uint8)
    moved, levers = np.zeros((n, 3)), np.zeros((n, 3))
    warp(side, T, back, offsets, gate, floors[3], across, brightness, spread, moved, levers, state)
    scales = residual_scales(across, brightness, spread, floors)
    size = POSE + 3 if floors[2] > 0 else POSE
    H, g = np.zeros((size, size)), np.zeros(size)
    normal_equations(points, normals, gradients, across, brightness, spread, moved, sigma, levers, scales, H, g)
    measures = np.zeros(10)
    measures[0] = n
    pairs, sum_a, sum_b, sum_aa, sum_bb, sum_ab = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    tile = np.empty(n, np.int64)
    for k in range(n):
        u = camera[0] * points[k, 0] / points[k, 2] + camera[2]
        v = camera[1] * points[k, 1] / points[k, 2] + camera[3]
        column = min(max(int(u * TILES / image.shape[1]), 0), TILES - 1)
        tile[k] = min(max(int(v * TILES / image.shape[0]), 0), TILES - 1) * TILES + column
        measures[1 + state[k]] += 1
        if across[k] == across[k]:
            measures[6] += 1
            if abs(across[k]) < 3.0 * scales[0]:
                measures[7] += 1
                measures[8] += (across[k] * sigma[k]) ** 2
        if brightness[k] == brightness[k]:
            a, b = intensity[k], intensity[k] + brightness[k]
            pairs += 1
            sum_a, sum_b = sum_a + a, sum_b + b
            sum_aa, sum_bb, sum_ab = sum_aa + a * a, sum_bb + b * b, sum_ab + a * b
    if pairs > 1:
        product = (sum_aa - sum_a * sum_a / pairs) * (sum_bb - sum_b * sum_b / pairs)
        measures[9] = (sum_ab - sum_a * sum_b / pairs) / np.sqrt(product) if product > 0 else 0.0
    order = np.argsort(tile, kind="mergesort")
    M, H_tile, g_tile = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
    start = 0
    while start < n:
        end = start
        while end < n and tile[order[end]] == tile[order[start]]:
            end += 1
        rows = order[start:end]
        normal_equations(points[rows], normals[rows], gradients[rows], across[rows], brightness[rows], spread[rows],
                         moved[rows], sigma[rows], levers[rows], scales, H_tile, g_tile)  # fmt: skip
        for a in range(size):
            for b in range(size):
                M[a, b] += g_tile[a] * g_tile[b]
        start = end
    return H, M, measures
