"""How well a scan fits a map that is being drawn: the scores of all particles, in numba."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel
from posegraph_slam.localization.slam_map import FAR, SlamMap
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.mapping.raycast import FRACTION_BITS, NEVER_SEEN, fixed_point, next_cell, plan_walk


def log_weights(
    slam_map: SlamMap, particles: FloatArray, points: FloatArray, sensor: FloatArray, settings: ParticleSlamSettings
) -> FloatArray:
    """Return what a scan with returns `points` (n, 2) (base frame) adds to the log-weights (N,) of the particles."""
    M = slam_map.geometry.cells_from_map
    if settings.weighting == "likelihood_field":
        table = likelihood_table(slam_map.reach, settings)
        scores = field_scores(particles, points, M, slam_map.evidence, slam_map.near, table)
        return np.asarray(settings.beam_weight * scores)
    if settings.weighting == "window_correlation":
        scores = window_scores(particles, points, M, slam_map.near, settings.window_cells // 2)
    else:
        scores = count_scores(particles, points, sensor, M, slam_map.evidence, slam_map.steps[3])
    return np.asarray(settings.correlation_power * np.log1p(np.maximum(scores, 0)))


def likelihood_table(reach: int, settings: ParticleSlamSettings) -> FloatArray:
    """Log-likelihood by squared distance in cells (256,), and of unknown space as the last of 257 values."""
    d2 = np.arange(256) * settings.resolution_m**2
    hit = np.where(np.arange(256) <= reach * reach, np.exp(-0.5 * d2 / settings.sigma_m**2), 0.0)
    hit[FAR] = 0.0
    share = settings.random_share
    return np.log((1 - share) * np.append(hit, settings.unknown_likelihood) + share)


@kernel
def field_scores(particles, points, M, evidence, near, table):  # type: ignore[no-untyped-def]
    """Sum of log-likelihoods (N,) of the returns by their distance to the nearest obstacle."""
    rows, columns = near.shape
    scores = np.zeros(len(particles))
    for k in range(len(particles)):
        c, s = np.cos(particles[k, 2]), np.sin(particles[k, 2])
        total = 0.0
        for b in range(len(points)):
            x = c * points[b, 0] - s * points[b, 1] + particles[k, 0]
            y = s * points[b, 0] + c * points[b, 1] + particles[k, 1]
            column = int(np.floor(M[0, 0] * x + M[0, 1] * y + M[0, 2]))
            row = int(np.floor(M[1, 0] * x + M[1, 1] * y + M[1, 2]))
            if 0 <= row < rows and 0 <= column < columns:
                if evidence[row, column] == NEVER_SEEN:
                    total += max(table[256], table[near[row, column]])
                else:
                    total += table[near[row, column]]
            else:
                total += table[256]
        scores[k] = total
    return scores


@kernel
def window_scores(particles, points, M, near, half):  # type: ignore[no-untyped-def]
    """Largest, over shifts of up to `half` cells either way, of the obstacles under the returns (N,)."""
    rows, columns = near.shape
    width = 2 * half + 1
    scores = np.zeros(len(particles))
    sums = np.zeros((width, width), np.int32)
    for k in range(len(particles)):
        c, s = np.cos(particles[k, 2]), np.sin(particles[k, 2])
        sums[:] = 0
        for b in range(len(points)):
            x = c * points[b, 0] - s * points[b, 1] + particles[k, 0]
            y = s * points[b, 0] + c * points[b, 1] + particles[k, 1]
            column = int(np.floor(M[0, 0] * x + M[0, 1] * y + M[0, 2]))
            row = int(np.floor(M[1, 0] * x + M[1, 1] * y + M[1, 2]))
            if not (0 <= row < rows and 0 <= column < columns) or near[row, column] > 2 * half * half:
                continue  # no obstacle within the window
            if row < half or row >= rows - half or column < half or column >= columns - half:
                continue  # the grid is made so large that nothing that is seen lies at its edge
            for dy in range(width):
                line, counts = near[row + dy - half, column - half : column + half + 1], sums[dy]
                for dx in range(width):  # without a branch, so that it runs on vectors
                    counts[dx] += np.int32(line[dx] == 0)
        scores[k] = sums.max()
    return scores


@kernel
def count_scores(particles, points, sensor, M, evidence, above):  # type: ignore[no-untyped-def]
    """Cells (N,) on which scan and map agree: returns in obstacles, and cells of the beams in known free space."""
    rows, columns = evidence.shape
    total = evidence.reshape(rows * columns)
    start, end = np.empty(2, dtype=np.int64), np.empty(2, dtype=np.int64)
    T = np.empty((3, 3))
    scores = np.zeros(len(particles))
    for k in range(len(particles)):
        c, s = np.cos(particles[k, 2]), np.sin(particles[k, 2])
        for i in range(2):
            T[i, 0] = M[i, 0] * c + M[i, 1] * s
            T[i, 1] = -M[i, 0] * s + M[i, 1] * c
            T[i, 2] = M[i, 0] * particles[k, 0] + M[i, 1] * particles[k, 1] + M[i, 2]
        fixed_point(T, sensor[0], sensor[1], start)
        count = 0
        for b in range(len(points)):
            fixed_point(T, points[b, 0], points[b, 1], end)
            low = min(start[0], start[1], end[0], end[1]) >> FRACTION_BITS
            high_column = max(start[0], end[0]) >> FRACTION_BITS
            high_row = max(start[1], end[1]) >> FRACTION_BITS
            if low < 0 or high_column >= columns or high_row >= rows:
                continue
            walk = plan_walk(start, end, columns)
            index, lead = walk.first, walk.lead
            while index != walk.last:
                at = np.uint64(index)
                if total[at] < 0 and total[at] != NEVER_SEEN:
                    count += 1
                index, lead = next_cell(walk, index, lead)
            if total[walk.last] > above:
                count += 1
        scores[k] = count
    return scores
