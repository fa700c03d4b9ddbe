"""Where in a whole map do scans fit? The best places, found by branch and bound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import ByteArray, FloatArray
from posegraph_slam.jit import kernel
from posegraph_slam.localization.map_field import FREE, OCCUPIED, MapField
from posegraph_slam.localization.settings import GlobalSearchSettings
from posegraph_slam.registration.correlative import (
    FIELD_MAX,
    block_score,
    insert_block,
    likelihood_field,
    max_pooled,
    rotated_cells,
)

LEVELS = 5
"""Blocks of the coarsest level are 2^5 cells wide: 3.2 m at 0.1 m."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SearchStack:
    """Max-pooled likelihood (L, R, C) and free space (L, R, C) of a map at the resolution of the search."""

    likelihood: ByteArray
    free: ByteArray
    resolution_m: float


def build_search_stack(field: MapField, settings: GlobalSearchSettings) -> SearchStack:
    """Prepare a map for `find_places`; poses are only looked for in its known free space."""
    fine = field.geometry.resolution_m
    step = max(settings.resolution_m, fine)
    rows, columns = (int(np.ceil(n * fine / step)) for n in field.geometry.shape)
    pad = 1 << LEVELS
    cells = np.argwhere(field.kind == OCCUPIED)[:, ::-1]
    likelihood = likelihood_field((cells + 0.5) * fine, np.zeros(2), step, rows, columns, pad, settings.sigma_m)
    free = np.zeros_like(likelihood)
    free_cells = np.floor((np.argwhere(field.kind == FREE) + 0.5) * (fine / step)).astype(np.int64)
    free[free_cells[:, 0] + pad, free_cells[:, 1] + pad] = 1
    return SearchStack(likelihood=max_pooled(likelihood, LEVELS), free=max_pooled(free, LEVELS), resolution_m=step)


def find_places(
    stack: SearchStack, points: FloatArray, settings: GlobalSearchSettings
) -> tuple[FloatArray, FloatArray]:
    """Return the best poses (P, 3) in the grid frame for `points` (n, 2) (base frame), and their scores (P,) in [0, 1].

    Best first, at most `candidates_max`, each further than the separation from better ones. Empty where nothing scores
    `score_min`, or there are fewer than ten points.
    """
    points = points[np.hypot(points[:, 0], points[:, 1]) <= settings.range_max_m]
    if len(points) < 10:
        return np.zeros((0, 3)), np.zeros(0)
    points = points[:: -(-len(points) // settings.points_max)]
    farthest = float(np.hypot(points[:, 0], points[:, 1]).max())
    turn = max(stack.resolution_m / max(farthest, 1.0), settings.angle_step_rad)
    angles = np.arange(int(np.ceil(2 * np.pi / turn))) * turn
    start = np.array([stack.resolution_m / 2, stack.resolution_m / 2, 0.0])
    cells = rotated_cells(points, start, angles, np.zeros(2), stack.resolution_m, 1 << LEVELS)
    gaps = np.array([settings.separation_m / stack.resolution_m, settings.separation_rad / turn])
    least = int(settings.score_min * FIELD_MAX * len(points))
    found, scores = search_peaks(stack.likelihood, stack.free, cells, gaps, least, settings.candidates_max)
    poses = np.column_stack([(found[:, 1:] + 0.5) * stack.resolution_m, angles[found[:, 0]]])
    return poses, scores / (FIELD_MAX * len(points))


@kernel
def keep_peak(peaks, scores, count, gaps, turns, a, x, y, score):  # type: ignore[no-untyped-def]
    """Put a pose into the list of peaks (best first) unless a better one is near; drop worse ones near it."""
    kept = 0
    for k in range(count):
        turn = abs(peaks[k, 0] - a)
        turn = min(turn, turns - turn)
        near = turn <= gaps[1] and (peaks[k, 1] - x) ** 2 + (peaks[k, 2] - y) ** 2 <= gaps[0] * gaps[0]
        if near and scores[k] >= score:
            return count
    for k in range(count):
        turn = abs(peaks[k, 0] - a)
        turn = min(turn, turns - turn)
        if not (turn <= gaps[1] and (peaks[k, 1] - x) ** 2 + (peaks[k, 2] - y) ** 2 <= gaps[0] * gaps[0]):
            peaks[kept], scores[kept] = peaks[k], scores[k]
            kept += 1
    if kept == len(scores):
        kept -= 1  # the list is full: the last, worst one goes; callers only offer better ones
    at = kept
    while at > 0 and scores[at - 1] < score:
        peaks[at], scores[at] = peaks[at - 1], scores[at - 1]
        at -= 1
    peaks[at, 0], peaks[at, 1], peaks[at, 2], scores[at] = a, x, y, score
    return kept + 1


@kernel
def search_peaks(stack, free, cells, gaps, least, peaks_max):  # type: ignore[no-untyped-def]
    """Peaks (P, 3) [angle index, x, y] and score sums (P,) over the whole field; see `find_places`.

    Blocks are visited in the order of their bounds; a block whose bound does not exceed the worst peak of a full list
    is dropped, and so is one without free space (Hess et al. 2016, for several maxima).
    """
    levels = len(stack) - 1
    pad = width = 1 << levels
    rows, columns = stack.shape[1] - 2 * pad, stack.shape[2] - 2 * pad
    across, along = (columns + width - 1) // width, (rows + width - 1) // width
    turns = len(cells)
    count = turns * across * along
    bounds = np.zeros(count, np.int64)
    for a in range(turns):
        for by in range(along):
            for bx in range(across):
                if free[levels, by * width + pad, bx * width + pad] > 0:
                    bounds[(a * along + by) * across + bx] = block_score(
                        stack[levels], cells[a], bx * width, by * width
                    )
    order = np.argsort(-bounds, kind="mergesort")
    peaks, scores, known = np.zeros((peaks_max, 3), np.int64), np.zeros(peaks_max, np.int64), 0
    todo = np.empty((4 * (levels + 1) + 4, 4), np.int64)
    for position in range(count):
        block = order[position]
        threshold = scores[known - 1] if known == peaks_max else least
        if bounds[block] <= threshold:
            break
        a, rest = block // (along * across), block % (along * across)
        todo[0, 0], todo[0, 1] = (rest % across) * width, (rest // across) * width
        todo[0, 2], todo[0, 3] = levels, bounds[block]
        top = 1
        while top > 0:
            top -= 1
            x, y, level, bound = todo[top, 0], todo[top, 1], todo[top, 2], todo[top, 3]
            threshold = scores[known - 1] if known == peaks_max else least
            if bound <= threshold:
                continue
            if level == 0:
                known = keep_peak(peaks, scores, known, gaps, turns, a, x, y, bound)
                continue
            half = 1 << (level - 1)
            first = top
            for quarter in range(4):
                qx, qy = x + half * (quarter & 1), y + half * (quarter >> 1)
                if qx >= columns or qy >= rows or free[level - 1, qy + pad, qx + pad] == 0:
                    continue
                score = block_score(stack[level - 1], cells[a], qx, qy)
                if score <= threshold:
                    continue
                insert_block(todo, first, top, qx, qy, level - 1, score)
                top += 1
    return peaks[:known].copy(), scores[:known].copy()
