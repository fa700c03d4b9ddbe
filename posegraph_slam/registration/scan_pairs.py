"""Registration of many pairs out of one sequence of point sets, in chunks that may run on other processes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress, split_range
from posegraph_slam.registration.cloud import Cloud, prepare_cloud
from posegraph_slam.registration.icp import DEFAULT_SETTINGS, icp
from posegraph_slam.registration.result import RegistrationResult, RegistrationStatus
from posegraph_slam.registration.settings import IcpSettings

STATUSES = tuple(RegistrationStatus)
"""The status that each code of `PairResults.status` stands for."""

CHUNK = 64
"""Pairs a unit of work: about 0.2 s, long against sending its points; neighbours share all but one prepared scan."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointSets:
    """N point sets one after the other: set k is `points` (M, d) from row `offsets[k]` up to `offsets[k+1]`; (N+1,)."""

    points: FloatArray
    offsets: IntArray

    def __post_init__(self) -> None:
        points, offsets = read_only(self.points), read_only(self.offsets, np.int64)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "offsets", offsets)
        if points.ndim != 2 or offsets.ndim != 1 or len(offsets) < 1:
            raise InputError("point sets", f"points {points.shape} and offsets {offsets.shape} do not fit together")
        if offsets[0] != 0 or offsets[-1] != len(points) or (np.diff(offsets) < 0).any():
            raise InputError("point sets", f"offsets must rise from 0 to the number of points, {len(points)}")

    def __len__(self) -> int:
        return int(self.offsets.shape[0]) - 1

    @staticmethod
    def from_list(sets: Sequence[FloatArray]) -> PointSets:
        """Join arrays (n_k, d), at least one."""
        return PointSets(points=np.concatenate(sets), offsets=np.cumsum([0, *map(len, sets)]))

    def points_of(self, index: int) -> FloatArray:
        """Points (n, d) of set `index`."""
        return self.points[self.offsets[index] : self.offsets[index + 1]]

    def select(self, index: IntArray) -> PointSets:
        """Return the sets at `index`, in that order."""
        counts = np.diff(self.offsets)[index]
        offsets = np.r_[0, np.cumsum(counts)]
        rows = np.repeat(self.offsets[index] - offsets[:-1], counts) + np.arange(offsets[-1])
        return PointSets(points=self.points[rows], offsets=offsets)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairResults:
    """`RegistrationResult`s of E pairs as arrays; rows that are not `usable` hold NaN poses and zero information.

    `T_target_source` (E, d+1, d+1), `information` (E, p, p), `status` (E,) codes into `STATUSES`, `inliers` (E,),
    `inlier_fraction` (E,), `rmse_m` (E,), `degenerate` (E,), `iterations` (E,).
    """

    T_target_source: FloatArray
    information: FloatArray
    status: IntArray
    inliers: IntArray
    inlier_fraction: FloatArray
    rmse_m: FloatArray
    degenerate: BoolArray
    iterations: IntArray

    def __post_init__(self) -> None:
        for name in ("T_target_source", "information", "inlier_fraction", "rmse_m"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        for name in ("status", "inliers", "iterations"):
            object.__setattr__(self, name, read_only(getattr(self, name), np.int64))
        object.__setattr__(self, "degenerate", read_only(self.degenerate, np.bool_))

    def __len__(self) -> int:
        return int(self.status.shape[0])

    @property
    def usable(self) -> BoolArray:
        """Which pairs (E,) have a transform that may be used."""
        good = [STATUSES.index(s) for s in (RegistrationStatus.CONVERGED, RegistrationStatus.MAX_ITERATIONS)]
        return np.isin(self.status, good)

    def status_of(self, pair: int) -> RegistrationStatus:
        """How the registration of `pair` ended."""
        return STATUSES[int(self.status[pair])]


def match_consecutive(
    sets: PointSets,
    T_initial: FloatArray,
    settings: IcpSettings = DEFAULT_SETTINGS,
    *,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
) -> PairResults:
    """Register each of N point sets onto the one before it: set k+1 (source) onto set k (target).

    `T_initial` (N-1, d+1, d+1) are the guesses T_k_k+1, from odometry for instance. Chaining the results gives the
    scan-matched trajectory T_k+1 = T_k T_k_k+1. The result does not depend on the executor.
    """
    first = np.arange(max(len(sets) - 1, 0))
    return match_pairs(sets, np.column_stack([first, first + 1]), T_initial, settings,
                       executor=executor, progress=progress)  # fmt: skip


def match_pairs(
    sets: PointSets,
    target_source: IntArray,
    T_initial: FloatArray,
    settings: IcpSettings = DEFAULT_SETTINGS,
    *,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
) -> PairResults:
    """Register pairs of sets: `target_source` (E, 2) names target and source, `T_initial` (E, d+1, d+1) the guesses.

    Each unit of work carries only the points that it needs. Raises `InputError` for shapes that do not fit.
    """
    pairs, guesses = np.asarray(target_source, dtype=np.int64), np.asarray(T_initial, dtype=np.float64)
    size = sets.points.shape[1] + 1
    if pairs.ndim != 2 or pairs.shape[1] != 2 or guesses.shape != (len(pairs), size, size):
        raise InputError("scan pairs", f"pairs {pairs.shape} and initial poses {guesses.shape} do not fit together",
                         f"give (E, 2) and (E, {size}, {size})")  # fmt: skip
    if len(pairs) and (pairs.min() < 0 or pairs.max() >= len(sets)):
        raise InputError("scan pairs", f"name set {pairs.max()}, but there are {len(sets)}")
    work = []
    for start, stop in split_range(len(pairs), CHUNK):
        needed, rows = np.unique(pairs[start:stop], return_inverse=True)
        work.append((sets.select(needed), rows.reshape(-1, 2), guesses[start:stop]))
    runner = executor if executor is not None else SerialExecutor()
    parts: list[PairResults] = []
    group = max(runner.workers * 4, 1)
    for start, stop in split_range(len(work), group):
        parts += runner.map(partial(match_chunk, settings=settings), work[start:stop])
        progress("registration", min(stop * CHUNK, len(pairs)), len(pairs))
    return _concatenate(parts, sets.points.shape[1])


def match_chunk(work: tuple[PointSets, IntArray, FloatArray], *, settings: IcpSettings) -> PairResults:
    """Register the pairs of one unit of work: its point sets, (target, source) rows (E, 2) and guesses."""
    sets, pairs, guesses = work
    prepared: dict[int, Cloud] = {}

    def cloud(index: int) -> Cloud:
        if index not in prepared:
            prepared[index] = prepare_cloud(sets.points_of(index), neighbours=settings.normal_neighbours)
        return prepared[index]

    results = [icp(cloud(int(s)), cloud(int(t)), T, settings) for (t, s), T in zip(pairs, guesses, strict=True)]
    return _stack(results)


def _stack(results: list[RegistrationResult]) -> PairResults:
    """Gather single results, at least one, into arrays."""
    return PairResults(
        T_target_source=np.array([r.T_target_source for r in results]),
        information=np.array([r.information for r in results]),
        status=np.array([STATUSES.index(r.status) for r in results]),
        inliers=np.array([r.inliers for r in results]),
        inlier_fraction=np.array([r.inlier_fraction for r in results]),
        rmse_m=np.array([r.rmse_m for r in results]),
        degenerate=np.array([r.degenerate for r in results]),
        iterations=np.array([r.iterations for r in results]),
    )


def _concatenate(parts: list[PairResults], dimension: int) -> PairResults:
    """Join the results of all chunks; none give empty arrays."""
    n, p = dimension + 1, 3 * (dimension - 1)
    real, whole = np.zeros(0), np.zeros(0, dtype=np.int64)
    empty = PairResults(T_target_source=np.zeros((0, n, n)), information=np.zeros((0, p, p)), status=whole,
                        inliers=whole, inlier_fraction=real, rmse_m=real, degenerate=np.zeros(0, dtype=np.bool_),
                        iterations=whole)  # fmt: skip
    names = PairResults.__dataclass_fields__
    return PairResults(**{name: np.concatenate([getattr(part, name) for part in [empty, *parts]]) for name in names})
