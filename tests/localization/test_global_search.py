"""Search of a whole map: the best of all poses, and what unknown space counts."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.localization.global_search import SearchStack, build_search_stack, find_places
from posegraph_slam.localization.map_field import FREE, UNKNOWN, MapField, build_map_field
from posegraph_slam.localization.settings import BeamModelSettings, GlobalSearchSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.registration.correlative import FIELD_MAX, likelihood_field

SETTINGS = GlobalSearchSettings(range_max_m=3.0, angle_step_rad=0.2, candidates_max=5)


def room(rng: np.random.Generator, *, unknown_from: int = 10_000) -> OccupancyGrid:
    """A walled room of 4 by 3 m with pillars, its cells unknown from a column on, in cells of 0.1 m."""
    log_odds = np.full((30, 40), -5.0)
    log_odds[[0, -1]], log_odds[:, [0, -1]] = 5.0, 5.0
    log_odds[rng.integers(3, 27, 8), rng.integers(3, 37, 8)] = 5.0
    observed = np.ones(log_odds.shape, dtype=bool)
    log_odds[:, unknown_from:], observed[:, unknown_from:] = 0.0, False
    geometry = GridGeometry(origin_m=np.zeros(2), resolution_m=0.1, shape=log_odds.shape)
    return OccupancyGrid(geometry=geometry, log_odds=log_odds, observed=observed)


def scores_everywhere(field: MapField, points: np.ndarray) -> dict[tuple[int, int, int], float]:
    """Score of each pose on the grid of the search whose cell is free, cell by cell."""
    rows, columns = field.kind.shape
    obstacles = (np.argwhere(field.kind == 2)[:, ::-1] + 0.5) * 0.1
    hit = likelihood_field(obstacles, np.zeros(2), 0.1, rows, columns, 0, SETTINGS.sigma_m) / FIELD_MAX
    unknown = round(SETTINGS.unknown_likelihood * FIELD_MAX) / FIELD_MAX
    value = np.where(field.kind == FREE, hit, np.maximum(hit, unknown))
    turn = max(0.1 / max(np.hypot(*points.T).max(), 1.0), SETTINGS.angle_step_rad)
    scores = {}
    for a in range(int(np.ceil(2 * np.pi / turn))):
        c, s = np.cos(a * turn), np.sin(a * turn)
        turned = np.floor((points @ np.array([[c, s], [-s, c]]) + 0.05) / 0.1).astype(int)
        for y, x in np.argwhere(field.kind == FREE):
            at = turned + np.array([x, y])
            inside = ((at >= 0) & (at < [columns, rows])).all(axis=1)
            seen = at[inside]
            scores[a, x, y] = float((value[seen[:, 1], seen[:, 0]].sum() + unknown * (~inside).sum()) / len(points))
    return scores


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_best_place_is_the_best_of_all_poses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    field = build_map_field(room(rng, unknown_from=25), BeamModelSettings())
    points = rng.uniform(-2.0, 2.0, (30, 2))
    places, scores = find_places(build_search_stack(field, SETTINGS), points, SETTINGS)
    expected = scores_everywhere(field, points)
    assert scores[0] == pytest.approx(max(expected.values()), abs=1e-9)
    turn = max(0.1 / max(np.hypot(*points.T).max(), 1.0), SETTINGS.angle_step_rad)
    for place, score in zip(places, scores, strict=True):
        key = (round(place[2] / turn), round(place[0] / 0.1 - 0.5), round(place[1] / 0.1 - 0.5))
        assert score == pytest.approx(expected[key], abs=1e-9)


def test_unknown_space_neither_fits_nor_conflicts() -> None:
    """Of a room that is mapped to its middle only, the returns beyond count neither as hits nor as conflicts."""
    rng = np.random.default_rng(3)
    whole = build_map_field(room(rng), BeamModelSettings())
    pose = np.array([2.05, 1.55, 0.0])
    seen = (np.argwhere(whole.kind == 2)[:, ::-1] + 0.5) * 0.1 - pose[:2]
    half = build_map_field(room(np.random.default_rng(3), unknown_from=24), BeamModelSettings())
    known = seen[:, 0] + pose[0] < 2.4
    assert (half.kind[:, 24:] == UNKNOWN).all()

    def score_at_pose(field: MapField, settings: GlobalSearchSettings) -> float:
        stack: SearchStack = build_search_stack(field, settings)
        places, scores = find_places(stack, seen, settings)
        here = np.hypot(*(places[:, :2] - pose[:2]).T) < 0.15
        return float(scores[here].max(initial=0.0))

    settings = SETTINGS.model_copy(update={"points_max": 1000})
    assert score_at_pose(whole, settings) == pytest.approx(1.0, abs=0.01)
    expected = known.mean() + settings.unknown_likelihood * (1 - known.mean())
    assert score_at_pose(half, settings) == pytest.approx(expected, abs=0.03)
    assert score_at_pose(half, settings.model_copy(update={"unknown_likelihood": 0.0})) < expected - 0.05
