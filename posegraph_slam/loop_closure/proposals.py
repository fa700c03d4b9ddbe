"""Which pairs of keyframes may close a loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.loop_closure.settings import ProposalSettings
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints

REACH_SIGMAS = 3.5
"""Half width of a search window in standard deviations: beyond it a closure would be refused as a surprise."""
PLACES_AT_ONCE = 256
"""Places from which travel is measured in one call."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidates:
    """Pairs of keyframes: `target` (M,) older, `source` (M,) newer, why (`kind`), and how far the guess may be off.

    `reach_m` and `reach_rad` (M,) bound the search around the current estimate; `travel_m` (M,) is the travel between
    the two that is not yet covered by closures.
    """

    target: IntArray
    source: IntArray
    kind: IntArray
    travel_m: FloatArray
    reach_m: FloatArray
    reach_rad: FloatArray

    def __post_init__(self) -> None:
        for name in ("target", "source", "kind"):
            object.__setattr__(self, name, read_only(getattr(self, name), np.int64))
        for name in ("travel_m", "reach_m", "reach_rad"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        return int(self.target.shape[0])

    def select(self, index: IntArray) -> Candidates:
        """Return the candidates at `index`."""
        return Candidates(**{name: getattr(self, name)[index] for name in self.__dataclass_fields__})

    @staticmethod
    def concatenate(parts: Sequence[Candidates]) -> Candidates:
        """Join several sets in the order given."""
        names = Candidates.__dataclass_fields__
        return Candidates(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def make_candidates(
    target: IntArray, source: IntArray, kind: ConstraintKind, travel_m: FloatArray, settings: ProposalSettings
) -> Candidates:
    """Attach the reach of the search, two sigmas of the drift over `travel_m` (M,)."""
    return Candidates(
        target=target,
        source=source,
        kind=np.full(len(target), int(kind)),
        travel_m=travel_m,
        reach_m=np.minimum(2 * drift_sigma_m(travel_m, settings) + 0.1, settings.drift_max_m),
        reach_rad=np.minimum(2 * settings.drift_rad_per_m * travel_m + 0.05, settings.drift_max_rad),
    )


def narrowed(candidates: Candidates, covariance: FloatArray) -> Candidates:
    """Bound the reach of each candidate by what the graph knows of it: `covariance` (M, 3, 3) of source in target."""
    sigma_m = np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1])
    sigma_rad = np.sqrt(covariance[:, 2, 2])
    return dataclasses.replace(
        candidates,
        reach_m=np.minimum(candidates.reach_m, REACH_SIGMAS * sigma_m + 0.1),
        reach_rad=np.minimum(candidates.reach_rad, REACH_SIGMAS * sigma_rad + 0.05),
    )


def drift_sigma_m(travel_m: FloatArray, settings: ProposalSettings) -> FloatArray:
    """One sigma (M,) of the position drift: proportional to the travel, plus what the heading's drift adds."""
    return np.asarray(settings.drift_per_m * travel_m + 0.25 * settings.drift_rad_per_m * travel_m**2)


def propose_fixed_interval(path_m: FloatArray, settings: ProposalSettings) -> Candidates:
    """Pair every n-th keyframe with the one n before it; `path_m` (K,) is the travel at each keyframe."""
    n = settings.fixed_interval
    source = np.arange(n, len(path_m), n) if n else np.zeros(0, dtype=np.int64)
    target = source - n
    return make_candidates(target, source, ConstraintKind.FIXED_INTERVAL, path_m[source] - path_m[target], settings)


def propose_start_end(path_m: FloatArray, settings: ProposalSettings) -> Candidates:
    """Pair the last keyframe with the first; robots do not end exactly where they started, so it is only tried."""
    far = len(path_m) > 1 and path_m[-1] - path_m[0] > settings.travel_min_m
    source = np.array([len(path_m) - 1] if far else [], dtype=np.int64)
    return make_candidates(
        np.zeros_like(source), source, ConstraintKind.START_END, path_m[source] - path_m[0], settings
    )


def places(path_m: FloatArray, settings: ProposalSettings) -> IntArray:
    """Pick one keyframe (S,) for each stretch of `segment_length_m` of travel."""
    stretch = np.floor((path_m - path_m[0]) / settings.segment_length_m)
    return np.flatnonzero(np.concatenate([[True], np.diff(stretch) > 0]))


def uncovered_travel(
    path_m: FloatArray, at: IntArray, pairs: IntArray, closures: Constraints, limit_m: float, cost_m: float
) -> FloatArray:
    """Shortest travel (P,) between the places of each pair (P, 2), along the path and through accepted closures.

    `at` (S,) are the keyframes of the places; a closure costs `cost_m`; travel beyond `limit_m` is inf.
    """
    place_of = np.clip(np.searchsorted(at, np.arange(len(path_m)), side="right") - 1, 0, len(at) - 1)
    a, b = place_of[closures.i], place_of[closures.j]
    rows = np.concatenate([np.arange(len(at) - 1), a[a != b]])
    columns = np.concatenate([np.arange(1, len(at)), b[a != b]])
    cost = np.concatenate([np.diff(path_m[at]), np.full(int(np.sum(a != b)), cost_m)])
    # of parallel edges the sparse constructor would add the costs: keep the cheapest
    order = np.lexsort((cost, columns, rows))
    rows, columns, cost = rows[order], columns[order], cost[order]
    first = np.concatenate([[True], (np.diff(rows) != 0) | (np.diff(columns) != 0)])[: len(rows)]
    graph = coo_array((cost[first], (rows[first], columns[first])), shape=(len(at), len(at))).tocsr()
    travel = np.full(len(pairs), np.inf)
    # some places at a time: the memory grows with the length of the log, not with its square
    for start in range(0, len(at), PLACES_AT_ONCE):
        stop = min(start + PLACES_AT_ONCE, len(at))
        here = np.flatnonzero((pairs[:, 0] >= start) & (pairs[:, 0] < stop))
        if len(here):
            distance = dijkstra(graph, directed=False, indices=np.arange(start, stop), limit=limit_m)
            travel[here] = distance[pairs[here, 0] - start, pairs[here, 1]]
    return travel


def propose_proximity(
    positions: FloatArray, path_m: FloatArray, closures: Constraints, travel_max_m: float, settings: ProposalSettings
) -> Candidates:
    """Pair places that lie within view of each other, up to drift, after `travel_min_m` to `travel_max_m` of travel.

    For each place the nearest target is taken, then the next that is not its neighbour on the path, and so on.
    """
    at = places(path_m, settings)
    drift = min(2 * float(drift_sigma_m(np.array(travel_max_m), settings)), settings.drift_max_m)
    pairs = np.sort(cKDTree(positions[at]).query_pairs(settings.view_distance_m + drift, output_type="ndarray"), axis=1)
    apart = path_m[at[pairs[:, 1]]] - path_m[at[pairs[:, 0]]] >= settings.travel_min_m
    pairs = pairs[apart & (at[pairs[:, 1]] - at[pairs[:, 0]] >= settings.keyframes_apart_min)]
    length = uncovered_travel(path_m, at, pairs, closures, travel_max_m, settings.segment_length_m)
    pairs, length = pairs[np.isfinite(length)], length[np.isfinite(length)]
    older, newer = at[pairs[:, 0]], at[pairs[:, 1]]
    distance = np.linalg.norm(positions[older] - positions[newer], axis=1)
    reach = np.minimum(2 * drift_sigma_m(length, settings), settings.drift_max_m)
    fits = np.flatnonzero((length >= settings.travel_min_m) & (distance <= settings.view_distance_m + reach))
    order = fits[np.lexsort((older[fits], distance[fits], newer[fits]))]
    pick = order[_spread(newer[order], path_m[older[order]], reach[order], settings)]
    return make_candidates(older[pick], newer[pick], ConstraintKind.PROXIMITY, length[pick], settings)


def _spread(group: IntArray, path_m: FloatArray, reach_m: FloatArray, settings: ProposalSettings) -> IntArray:
    """Of each group take the first row, then the next whose path is a view away from those taken, and so on."""
    taken: list[int] = []
    remaining = np.ones(len(group), dtype=np.bool_)
    for _ in range(settings.targets_max):
        rows = np.flatnonzero(remaining)
        if len(rows) == 0:
            break
        _, first = np.unique(group[rows], return_index=True)
        heads = rows[first]
        taken.extend(heads.tolist())
        head_of_row = heads[np.minimum(np.searchsorted(group[heads], group), len(heads) - 1)]
        valid = group[head_of_row] == group
        away = np.abs(path_m - path_m[head_of_row]) > np.maximum(settings.view_distance_m, reach_m)
        remaining &= away & valid
    return np.sort(np.array(taken, dtype=np.int64))
