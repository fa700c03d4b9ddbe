"""How well a scan fits a map that is being drawn: the scores of all particles, in numba."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel
from posegraph_slam.localization.cell_counts import count_scores, one_a_cell, scan_outline, straightened
from posegraph_slam.localization.slam_map import FAR, SlamMap
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.mapping.raycast import NEVER_SEEN

STRAIGHT_CELLS = 0.5
"""The outline of a scan keeps within half a cell: 0.5 % of the count changes, and half of the time is saved."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeighedScan:
    """What the weight functions need of a scan, in the base frame.

    `few` (n, 2) are returns spread over the scan; `returns` one of each cell, and `outline` (m, 2) the polygon of its
    free space, for counting cells; `table` is the likelihood by squared distance.
    """

    few: FloatArray
    returns: FloatArray
    outline: FloatArray
    table: FloatArray


def weighed_scan(points: FloatArray, sensor: FloatArray, reach: int, settings: ParticleSlamSettings) -> WeighedScan:
    """Prepare the returns `points` (n, 2) (base frame), at least one, for the weight function of the settings."""
    few, returns, outline = points, points, points
    if settings.weighting == "cell_counts":
        cell = settings.resolution_m
        returns = one_a_cell(points, cell)
        outline = straightened(scan_outline(points, sensor, cell), STRAIGHT_CELLS * cell)
    else:
        few = np.ascontiguousarray(points[:: -(-len(points) // settings.points_max)])
    return WeighedScan(few=few, returns=returns, outline=outline, table=likelihood_table(reach, settings))


def log_weights(
    slam_map: SlamMap, particles: FloatArray, scan: WeighedScan, settings: ParticleSlamSettings
) -> FloatArray:
    """Return what a scan adds to the log-weights (N,) of the particles."""
    M = slam_map.geometry.cells_from_map
    if settings.weighting == "likelihood_field":
        scores = field_scores(particles, scan.few, M, slam_map.evidence, slam_map.near, scan.table)
    elif settings.weighting == "window_correlation":
        scores = window_scores(particles, scan.few, M, slam_map.near, settings.window_cells // 2)
    else:
        assert slam_map.free_before is not None
        scores = count_scores(particles, scan.outline, scan.returns, M, slam_map.near, slam_map.free_before)
    return from_scores(scores, settings)


def from_scores(scores: FloatArray, settings: ParticleSlamSettings) -> FloatArray:
    """Return the log-weights of scores (N,): sums of log-likelihoods, or counts whose power is the weight."""
    if settings.weighting == "likelihood_field":
        return np.asarray(settings.beam_weight * scores)
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
