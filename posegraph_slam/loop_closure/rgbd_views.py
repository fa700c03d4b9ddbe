"""Keyframes of an RGB-D camera as loop closure sees them, and which pairs of them may show the same surfaces."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.execution import Executor
from posegraph_slam.geometry import SE3
from posegraph_slam.jit import kernel
from posegraph_slam.loop_closure.appearance import appearance_similarity
from posegraph_slam.loop_closure.rgbd_lag import loosened
from posegraph_slam.pose_graph.graph import Constraints
from posegraph_slam.registration.features import Features, detect_features
from posegraph_slam.registration.rgbd_frame import RgbdFrame, RgbdReference, prepare_reference
from posegraph_slam.settings import Settings

SAMPLE = 200
"""Points of a keyframe that stand for what it sees."""
REFERENCES_KEPT = 48
"""Prepared keyframes in memory at a time, about 9 MB each at 640 x 480."""


class RgbdProposalSettings(Settings):
    """Which pairs of keyframes are tried."""

    proximity: bool = True
    """Try keyframes whose views overlap by the current estimate."""
    appearance: bool = True
    """Try keyframes that look alike, wherever the estimate has them."""
    keyframes_apart_min: int = Field(default=2, ge=2)
    """Least number of keyframes between the two of a pair; consecutive ones are tied by odometry already."""
    overlap_min: float = Field(default=0.35, ge=0, le=1)
    """Least share of one view that the other contains by the estimate."""
    targets_max: int = Field(default=3, ge=1)
    """Keyframes that are tried with one keyframe in a round, for each kind of proposal."""
    words: int = Field(default=4096, ge=2)
    """Size of the vocabulary of appearance: the finer, the better it tells places apart, and the longer it takes."""
    similarity_min: float = Field(default=0.35, ge=0, le=1)
    """Least similarity of appearance, as a share of that between the keyframe and the one before it."""
    rounds_max: int = Field(default=5, ge=1)
    """Rounds of proposing, verifying and solving."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyframeView:
    """What is kept of a keyframe all the time: its features, some of its points (n, 3) and the image's shape."""

    features: Features
    sample: FloatArray
    shape: tuple[int, int]


class KeyframeViews:
    """The keyframes of a log by number: small parts in memory, prepared images read again when they are needed."""

    def __init__(
        self,
        frames: Callable[[int], RgbdFrame],
        keyframes: IntArray,
        executor: Executor,
        *,
        lag: FloatArray | None = None,
    ) -> None:
        """Read the keyframes; `lag` (K, 6) is the camera's motion between their colour and their depth."""
        self._frames, self._keyframes = frames, keyframes
        self._lag = np.zeros((len(keyframes), 6)) if lag is None else lag
        self._kept: OrderedDict[int, RgbdReference] = OrderedDict()
        self._lock = Lock()
        self.views: list[KeyframeView] = executor.map(partial(_view_of, frames), keyframes.tolist())

    def __len__(self) -> int:
        return len(self._keyframes)

    def believed(self, constraints: Constraints) -> Constraints:
        """Return alignments of keyframes, each believed as far as the lag between colour and depth lets it."""
        depth = np.array([np.median(view.sample[:, 2]) if len(view.sample) else 1.0 for view in self.views])
        i, j = constraints.i, constraints.j
        information = loosened(
            constraints.information, constraints.T_i_j, self._lag[i], self._lag[j], np.maximum(depth[i], depth[j])
        )
        return replace(constraints, information=information)

    def reference(self, k: int) -> RgbdReference:
        """Return keyframe k prepared as a reference, from memory where it was used lately."""
        with self._lock:
            known = self._kept.get(k)
            if known is not None:
                self._kept.move_to_end(k)
                return known
        made = prepare_reference(self._frames(int(self._keyframes[k])))
        with self._lock:
            self._kept[k] = made
            while len(self._kept) > REFERENCES_KEPT:
                self._kept.popitem(last=False)
        return made


def _view_of(frames: Callable[[int], RgbdFrame], k: int) -> KeyframeView:
    """Read frame k and keep what proposals and feature matching need."""
    frame = frames(k)
    features = detect_features(frame.intensity[0], frame.depth[0], frame.camera[0])
    depth, (fx, fy, cx, cy) = frame.depth[-1], frame.camera[-1]
    rows, columns = np.nonzero(depth > 0)
    chosen = np.unique(np.linspace(0, max(len(rows) - 1, 0), SAMPLE).astype(np.int64)) if len(rows) else rows
    z = depth[rows[chosen], columns[chosen]].astype(np.float64)
    points = np.column_stack([(columns[chosen] - cx) / fx * z, (rows[chosen] - cy) / fy * z, z])
    shape = (frame.intensity[0].shape[0], frame.intensity[0].shape[1])
    return KeyframeView(features=features, sample=read_only(points), shape=shape)


def propose_overlapping(
    poses: FloatArray, views: Sequence[KeyframeView], settings: RgbdProposalSettings
) -> tuple[IntArray, FloatArray]:
    """Pairs (M, 2) [older, newer] of keyframes at `poses` (K, 4, 4) whose views overlap, and their overlap (M,).

    For each newer one the best are taken that are no neighbours of each other.
    """
    none = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    centres = np.stack([_centre(T, view.sample) for T, view in zip(poses, views, strict=True)])
    radii = np.array([np.median(view.sample[:, 2]) if len(view.sample) else 0.0 for view in views])
    pairs = cKDTree(centres).query_pairs(2 * float(radii.max(initial=0.0)) + 1e-9, output_type="ndarray")
    pairs = np.sort(pairs, axis=1)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] >= settings.keyframes_apart_min]
    if len(pairs) == 0:
        return none
    pairs = pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))]
    overlap = np.array([_mutual_overlap(poses, views, int(i), int(j)) for i, j in pairs])
    return _best_targets(pairs, overlap, overlap >= settings.overlap_min, settings)


def propose_alike(
    views: Sequence[KeyframeView], settings: RgbdProposalSettings, rng: np.random.Generator
) -> tuple[IntArray, FloatArray]:
    """Pairs (M, 2) [older, newer] of keyframes that look alike, and their similarity (M,)."""
    similarity = appearance_similarity([view.features.words for view in views], settings.words, rng)
    count = len(views)
    older, newer = np.triu_indices(count, settings.keyframes_apart_min)
    order = np.lexsort((older, newer))
    older, newer = older[order], newer[order]
    if count < 2 or len(newer) == 0:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    beside = np.maximum(similarity[np.arange(1, count), np.arange(count - 1)], 1e-3)
    value = similarity[older, newer]
    # a keyframe whose neighbour looks different, after a sudden turn, is measured by the usual likeness of neighbours
    usual = np.maximum(beside[newer - 1], 0.5 * np.median(beside))
    pairs = np.column_stack([older, newer])
    return _best_targets(pairs, value, value >= settings.similarity_min * usual, settings)


def _best_targets(
    pairs: IntArray, value: FloatArray, fits: np.ndarray, settings: RgbdProposalSettings
) -> tuple[IntArray, FloatArray]:
    """For each newer keyframe, the pairs of the largest values whose older ones are no neighbours."""
    kept = list[int]()
    rows = np.flatnonzero(fits)
    order = rows[np.lexsort((pairs[rows, 0], -value[rows], pairs[rows, 1]))]
    taken = dict[int, list[int]]()
    for row in order.tolist():
        older, newer = int(pairs[row, 0]), int(pairs[row, 1])
        chosen = taken.setdefault(newer, [])
        if len(chosen) < settings.targets_max and all(abs(older - other) > 1 for other in chosen):
            chosen.append(older)
            kept.append(row)
    return pairs[kept].reshape(-1, 2), value[kept]


def _centre(T: FloatArray, sample: FloatArray) -> FloatArray:
    """Where a keyframe looks: the median of its points, or the camera itself where it saw nothing."""
    point = np.median(sample, axis=0) if len(sample) else np.zeros(3)
    return np.asarray(T[:3, :3] @ point + T[:3, 3])


def _mutual_overlap(poses: FloatArray, views: Sequence[KeyframeView], i: int, j: int) -> float:
    """Lesser share of the points of one keyframe that fall into the other's image."""
    T_i_j = SE3.between(poses[i], poses[j])
    a, b = views[i], views[j]
    there = share_in_view(b.sample, T_i_j, a.features.camera, *a.shape)
    back = share_in_view(a.sample, SE3.inverse(T_i_j), b.features.camera, *b.shape)
    return float(min(there, back))


@kernel
def share_in_view(points: FloatArray, T: FloatArray, camera: FloatArray, height: int, width: int) -> float:
    """Share of points (n, 3) that fall into an image after the transform T (4, 4)."""
    inside = 0
    for k in range(len(points)):
        z = T[2, 0] * points[k, 0] + T[2, 1] * points[k, 1] + T[2, 2] * points[k, 2] + T[2, 3]
        if z < 0.1:
            continue
        x = T[0, 0] * points[k, 0] + T[0, 1] * points[k, 1] + T[0, 2] * points[k, 2] + T[0, 3]
        y = T[1, 0] * points[k, 0] + T[1, 1] * points[k, 1] + T[1, 2] * points[k, 2] + T[1, 3]
        u, v = camera[0] * x / z + camera[2], camera[1] * y / z + camera[3]
        if 0 <= u < width and 0 <= v < height:
            inside += 1
    return inside / max(len(points), 1)
