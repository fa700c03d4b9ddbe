"""Where in a whole map do scans fit? The best places, found by branch and bound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import ByteArray, FloatArray
from posegraph_slam.jit import kernel
from posegraph_slam.localization.map_field import FREE, OCCUPIED, MapField
from posegraph_slam.localization.settings import GlobalSearchSettings
from posegraph_slam.registration.correlative import (
    FIELD_MAX,
    insert_block,
    likelihood_field,
    max_pooled,
    rotated_cells,
)

LEVELS = 5
"""Blocks of the coarsest level are 2^5 cells wide: 3.2 m at 0.1 m."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SearchStack:
    """Max-pooled likelihood (L, R, C) and free space (L, R, C) of a map at the resolution of the search.

    The likelihood is that of a return in each cell less `unknown`, that of one in unknown space or beyond the map.
    The map is padded by `pad` cells, so that no return within the range of the search lies outside.
    """

    likelihood: npt.NDArray[np.int16]
    free: ByteArray
    unknown: int
    pad: int
    resolution_m: float


def build_search_stack(field: MapField, settings: GlobalSearchSettings) -> SearchStack:
    """Prepare a map for `find_places`; poses are only looked for in its known free space.

    A return in unknown space neither fits nor conflicts. Were it to count as one in free space, a place whose
    surroundings are mapped in part would score less than many wrong ones that are mapped all around.
    """
    fine = field.geometry.resolution_m
    step = max(settings.resolution_m, fine)
    rows, columns = (int(np.ceil(n * fine / step)) for n in field.geometry.shape)
    pad = (1 << LEVELS) + int(np.ceil(settings.range_max_m / step)) + 1
    cells = np.argwhere(field.kind == OCCUPIED)[:, ::-1]
    likelihood = likelihood_field((cells + 0.5) * fine, np.zeros(2), step, rows, columns, pad, settings.sigma_m)
    free = np.zeros_like(likelihood)
    free_cells = np.floor((np.argwhere(field.kind == FREE) + 0.5) * (fine / step)).astype(np.int64)
    free[free_cells[:, 0] + pad, free_cells[:, 1] + pad] = 1
    unknown = round(settings.unknown_likelihood * FIELD_MAX)
    relative = likelihood.astype(np.int16) - unknown
    np.maximum(relative, 0, out=relative, where=free == 0)
    return SearchStack(
        likelihood=max_pooled(relative, LEVELS), free=max_pooled(free, LEVELS), unknown=unknown, pad=pad,
        resolution_m=step,
    )  # fmt: skip


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
    cells = rotated_cells(points, start, angles, np.zeros(2), stack.resolution_m, stack.pad)
    offsets = cells[:, :, 1] * np.int32(stack.likelihood.shape[2]) + cells[:, :, 0]
    gaps = np.array([settings.separation_m / stack.resolution_m, settings.separation_rad / turn])
    least = int((settings.score_min * FIELD_MAX - stack.unknown) * len(points))
    found, scores = search_peaks(stack.likelihood, stack.free, stack.pad, offsets, gaps, least, settings.candidates_max)
    poses = np.column_stack([(found[:, 1:] + 0.5) * stack.resolution_m, angles[found[:, 0]]])
    return poses, (scores / len(points) + stack.unknown) / FIELD_MAX


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
def score_of(field, offsets, shift):  # type: ignore[no-untyped-def]
    """Sum of a flat field under `offsets` (n,) shifted by `shift`; the field is padded, so that all lie inside."""
    total = 0
    for k in range(len(offsets)):
        total += field[offsets[k] + shift]
    return total


@kernel
def search_peaks(stack, free, pad, offsets, gaps, least, peaks_max):  # type: ignore[no-untyped-def]
    """Peaks (P, 3) [angle index, x, y] and score sums (P,) over the whole field; see `find_places`.

    `offsets` (A, n) are the points' cells in a flat level of the stack, at each angle, for a robot at cell (0, 0).

    Blocks are visited in the order of their bounds; a block whose bound does not exceed the worst peak of a full list
    is dropped, and so is one without free space (Hess et al. 2016, for several maxima).
    """
    levels = len(stack) - 1
    width, stride = 1 << levels, stack.shape[2]
    rows, columns = stack.shape[1] - 2 * pad, stride - 2 * pad
    flat = stack.reshape((len(stack), -1))
    across, along = (columns + width - 1) // width, (rows + width - 1) // width
    turns = len(offsets)
    count = turns * across * along
    bounds = np.full(count, least, np.int64)
    for a in range(turns):
        for by in range(along):
            for bx in range(across):
                if free[levels, by * width + pad, bx * width + pad] > 0:
                    bounds[(a * along + by) * across + bx] = score_of(
                        flat[levels], offsets[a], (by * stride + bx) * width
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
                score = score_of(flat[level - 1], offsets[a], qy * stride + qx)
                if score <= threshold:
                    continue
                insert_block(todo, first, top, qx, qy, level - 1, score)
                top += 1
    return peaks[:known].copy(), scores[:known].copy()
