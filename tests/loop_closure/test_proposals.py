"""Which pairs are proposed."""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import floyd_warshall

from posegraph_slam.geometry import SE2
from posegraph_slam.loop_closure.proposals import (
    drift_sigma_m,
    places,
    propose_fixed_interval,
    propose_proximity,
    propose_start_end,
    uncovered_travel,
)
from posegraph_slam.loop_closure.settings import ProposalSettings
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints

SETTINGS = ProposalSettings()


def circle(laps: float, radius: float = 10.0, step: float = 0.3):  # type: ignore[no-untyped-def]
    angle = np.arange(0, laps * 2 * np.pi, step / radius)
    positions = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return positions, radius * angle


def closures(pairs: list[tuple[int, int]]) -> Constraints:
    i, j = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    n = len(i)
    return Constraints(i=i, j=j, T_i_j=SE2.identity(n), information=np.tile(np.eye(3), (n, 1, 1)), kind=np.full(n, 3))


def test_fixed_interval_pairs_every_nth_keyframe() -> None:
    path = np.arange(35) * 0.3
    found = propose_fixed_interval(path, ProposalSettings(fixed_interval=10))
    assert found.source.tolist() == [10, 20, 30]
    assert found.target.tolist() == [0, 10, 20]
    np.testing.assert_allclose(found.travel_m, 3.0)
    assert len(propose_fixed_interval(path, ProposalSettings(fixed_interval=0))) == 0
    assert len(propose_fixed_interval(path[:5], ProposalSettings(fixed_interval=10))) == 0


def test_start_and_end_are_only_proposed_after_enough_travel() -> None:
    found = propose_start_end(np.linspace(0, 50, 100), SETTINGS)
    assert (found.target[0], found.source[0], found.kind[0]) == (0, 99, ConstraintKind.START_END)
    assert len(propose_start_end(np.linspace(0, 1, 10), SETTINGS)) == 0
    assert len(propose_start_end(np.zeros(1), SETTINGS)) == 0


def test_places_are_a_segment_apart() -> None:
    path = np.cumsum(np.random.default_rng(0).uniform(0, 0.4, 400))
    at = places(path, SETTINGS)
    assert at[0] == 0
    assert (np.diff(path[at]) > 0.5).all()
    assert (np.diff(path[at]) < 2.0).all()


def test_travel_is_the_shortest_way_through_closures() -> None:
    path = np.arange(60) * 0.5
    at = places(path, SETTINGS)
    pairs = np.stack(np.triu_indices(len(at), 1), axis=1)
    loops = closures([(2, 50), (2, 50), (10, 30)])
    got = uncovered_travel(path, at, pairs, loops, 1e9, 1.0)
    place = np.searchsorted(at, np.arange(60), side="right") - 1
    dense = np.full((len(at), len(at)), np.inf)
    for k in range(len(at) - 1):
        dense[k, k + 1] = path[at[k + 1]] - path[at[k]]
    for i, j in zip(loops.i, loops.j, strict=True):
        dense[place[i], place[j]] = min(dense[place[i], place[j]], 1.0)
    expected = floyd_warshall(dense, directed=False)
    np.testing.assert_allclose(got, expected[pairs[:, 0], pairs[:, 1]])
    limited = uncovered_travel(path, at, pairs, loops, 5.0, 1.0)
    assert np.isinf(limited[got > 5.0]).all()
    np.testing.assert_allclose(limited[got <= 5.0], got[got <= 5.0])


def test_a_second_lap_is_proposed_against_the_first() -> None:
    positions, path = circle(2.0)
    found = propose_proximity(positions, path, closures([]), 100.0, SETTINGS)
    second_lap = found.source[path[found.source] > 2 * np.pi * 10 + 3]
    assert len(np.unique(second_lap)) > 40
    assert (path[found.source] - path[found.target] >= SETTINGS.travel_min_m).all()
    assert (found.reach_m <= SETTINGS.drift_max_m).all()
    assert (found.reach_rad <= SETTINGS.drift_max_rad).all()


def test_what_closures_cover_is_not_proposed_again() -> None:
    positions, path = circle(2.0)
    lap = round(2 * np.pi * 10 / 0.3)
    loops = closures([(k, k + lap) for k in range(0, len(path) - lap, 3)])
    assert len(propose_proximity(positions, path, closures([]), 100.0, SETTINGS)) > 0
    again = propose_proximity(positions, path, loops, 100.0, SETTINGS)
    assert (path[again.source] - path[again.target] < 30).all()


def test_longer_travel_than_the_limit_waits_for_a_later_round() -> None:
    positions, path = circle(2.0)
    found = propose_proximity(positions, path, closures([]), 30.0, SETTINGS)
    assert (found.travel_m <= 30.0).all()


def test_targets_of_one_place_lie_apart_and_are_few() -> None:
    positions, path = circle(5.0)
    found = propose_proximity(positions, path, closures([]), 400.0, SETTINGS)
    for source in np.unique(found.source):
        targets = np.sort(path[found.target[found.source == source]])
        assert len(targets) <= SETTINGS.targets_max
        assert (np.diff(targets) > SETTINGS.view_distance_m).all()


def test_minimum_age_in_keyframes() -> None:
    positions, path = circle(2.0)
    found = propose_proximity(positions, path, closures([]), 100.0, ProposalSettings(keyframes_apart_min=200))
    assert (found.source - found.target >= 200).all()


def test_drift_grows_with_travel() -> None:
    travel = np.array([0.0, 10.0, 100.0])
    assert (np.diff(drift_sigma_m(travel, SETTINGS)) > 0).all()
    assert drift_sigma_m(travel, SETTINGS)[0] == 0
