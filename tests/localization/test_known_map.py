"""Localisation in a known map: tracking, finding itself, kidnapping, determinism."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, pose_from_xyt, wrap_angle, xyt_from_pose
from posegraph_slam.localization.beam_model import add_log_likelihoods, agreement, refine
from posegraph_slam.localization.global_search import build_search_stack, find_places
from posegraph_slam.localization.health import Evidence, Health, HealthState, assess
from posegraph_slam.localization.known_map import (
    LocalizationResult,
    initial_state,
    localize,
    predict,
    prepare_map,
    update,
)
from posegraph_slam.localization.map_field import build_map_field
from posegraph_slam.localization.recovery import compare
from posegraph_slam.localization.scan_points import scan_points
from posegraph_slam.localization.settings import BeamModelSettings, HealthSettings, LocalizationSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.registration.beam_scans import BeamScanSettings, prepare_beam_scans

SETTINGS = LocalizationSettings()
Tracked = tuple[LocalizationResult, np.ndarray, np.ndarray]
"""A result, its position errors and heading errors."""


def run(world: Any, *, start: bool = True, seed: int = 0, grid: OccupancyGrid | None = None, turn: float = 0.0,
        settings: LocalizationSettings = SETTINGS) -> Tracked:  # fmt: skip
    """Localise; return the result, its position errors and heading errors against the (turned) truth."""
    c, s = np.cos(turn), np.sin(turn)
    truth = np.column_stack([world.truth[:, :2] @ np.array([[c, s], [-s, c]]), world.truth[:, 2] + turn])
    beams = prepare_beam_scans(world.scans, BeamScanSettings())
    result = localize(
        prepare_map(grid or world.grid, settings), beams, world.odometry, settings,
        rng=np.random.default_rng(seed), start=truth[0] if start else None,
    )  # fmt: skip
    found = xyt_from_pose(result.trajectory.poses)
    return result, np.linalg.norm(found[:, :2] - truth[:, :2], axis=1), np.abs(wrap_angle(found[:, 2] - truth[:, 2]))


@pytest.fixture(scope="module")
def tracked(world: Any) -> Tracked:
    return run(world)


@pytest.fixture(scope="module")
def abducted(kidnapped: Any) -> Tracked:
    return run(kidnapped)


def test_tracks_to_centimetres(tracked: Tracked) -> None:
    result, position, heading = tracked
    assert (result.health == Health.OK).all()
    assert np.median(position) < 0.015
    assert position[5:].max() < 0.06
    assert np.median(heading) < np.deg2rad(0.3)
    assert result.particles.max() <= SETTINGS.number.maximum
    assert result.particles[-1] < 300  # as few as a known pose needs


def test_covariance_is_that_of_the_error(world: Any, tracked: Tracked) -> None:
    result, _, _ = tracked
    error = SE2.log(SE2.between(result.trajectory.poses, pose_from_xyt(world.truth)))
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(result.covariance), error)
    assert 0.05 < nees[5:].mean() < 6  # 3 when exact; the map's own error is known only roughly
    np.testing.assert_allclose(result.covariance, np.swapaxes(result.covariance, 1, 2), atol=1e-12)
    assert (np.linalg.eigvalsh(result.covariance) > 0).all()


def test_a_turned_map_gives_turned_poses(world: Any, turned_map: OccupancyGrid) -> None:
    _, position, heading = run(world, grid=turned_map, turn=0.6)
    assert np.median(position) < 0.02
    assert np.median(heading) < np.deg2rad(0.4)


@pytest.mark.parametrize("seed", [0, 1])
def test_finds_itself_without_a_start(world: Any, seed: int) -> None:
    result, position, _ = run(world, start=False, seed=seed)
    assert result.health[0] != Health.OK  # one scan is no proof
    known = np.flatnonzero(result.health == Health.OK)
    assert known[0] < 60
    assert (result.health[known[0] :] == Health.OK).all()
    assert position[known].max() < 0.3
    assert np.median(position[known]) < 0.02


def test_a_kidnapped_robot_says_so_and_recovers(abducted: Tracked) -> None:
    result, position, _ = abducted
    assert (result.health[:90] == Health.OK).all()
    unknown = np.flatnonzero(result.health != Health.OK)
    assert 90 <= unknown[0] < 125
    assert (position[100 : unknown[0]] > 1).all()  # it was astray, and then said so
    believed = unknown[-1] + 1
    assert believed < len(position) - 20
    assert position[believed:].max() < 0.3


def test_the_covariance_grows_while_the_pose_is_not_known(abducted: Tracked) -> None:
    result, _, _ = abducted
    lost = np.flatnonzero(result.health != Health.OK)
    trace = np.trace(result.covariance[:, :2, :2], axis1=1, axis2=2)
    assert trace[lost[-1]] > trace[lost[0]]


def test_in_a_strange_place_it_never_claims_to_know(world: Any) -> None:
    """A map of one long wall: nothing that the scans show explains it."""
    log_odds = np.full((220, 320), -5.0)
    log_odds[110] = 5.0
    geometry = GridGeometry(origin_m=np.zeros(2), resolution_m=0.05, shape=log_odds.shape)
    grid = OccupancyGrid(geometry=geometry, log_odds=log_odds, observed=np.ones(log_odds.shape, dtype=bool))
    result, _, _ = run(world, start=False, grid=grid)
    assert not (result.health == Health.OK).any()


def test_a_place_like_the_estimate_is_a_rival_and_others_are_not(world: Any) -> None:
    """A map that holds the same hall twice: the other hall fits as well, other places in this one do not."""
    log_odds = np.concatenate([world.grid.log_odds] * 2, axis=1)
    geometry = GridGeometry(origin_m=world.grid.geometry.origin_m, resolution_m=0.05, shape=log_odds.shape)
    known = prepare_map(OccupancyGrid(geometry=geometry, log_odds=log_odds, observed=log_odds != 0), SETTINGS)
    beams, rng = prepare_beam_scans(world.scans, BeamScanSettings()), np.random.default_rng(0)
    path = xyt_from_pose(world.odometry.poses)
    state = initial_state(known, path[0], SETTINGS, rng=rng, start=world.truth[0])
    for k in range(30):
        scan = scan_points(beams, k, SETTINGS.beam_model.points_max)
        state, found = update(predict(state, path[k], SETTINGS, rng), known, scan, SETTINGS, rng)
    here = found.pose
    assert np.linalg.norm(known.field.from_grid(here)[:2] - world.truth[29, :2]) < 0.1
    other_hall, elsewhere = here + np.array([16.0, 0.0, 0.0]), known.field.to_grid(world.truth[[100, 150, 200]])
    near = here + np.array([0.1, 0.1, 0.03])
    alone = compare(state, known, found, np.concatenate([elsewhere, near[None]]), SETTINGS)
    assert alone.margin > 2 * SETTINGS.health.rival_margin
    assert alone.rival_agreement < 0.7
    rivalled = compare(state, known, found, np.concatenate([elsewhere, other_hall[None]]), SETTINGS)
    assert abs(rivalled.margin) < 0.02
    assert rivalled.favourite == found.hypothesis
    assert rivalled.rival_agreement > SETTINGS.health.found_above


def test_same_seed_same_bytes_other_seed_other_bytes(world: Any, tracked: Tracked) -> None:
    first, second, third = tracked[0], run(world, seed=0)[0], run(world, seed=4)[0]
    assert first.trajectory.poses.tobytes() == second.trajectory.poses.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()
    assert first.trajectory.poses.tobytes() != third.trajectory.poses.tobytes()


@pytest.mark.parametrize("scheme", ["low_variance", "stratified", "multinomial"])
def test_every_scheme_tracks(world: Any, scheme: str) -> None:
    changed = SETTINGS.model_copy(update={"resampling": SETTINGS.resampling.model_copy(update={"scheme": scheme})})
    _, position, _ = run(world, settings=changed)
    assert np.median(position) < 0.02


def test_likelihood_matches_a_slow_sum(world: Any) -> None:
    field = build_map_field(world.grid, BeamModelSettings())
    rng = np.random.default_rng(0)
    particles = np.column_stack([rng.uniform(0, 15, (7, 2)), rng.uniform(-3, 3, 7)])
    points = rng.uniform(-6, 6, (30, 2))
    log_weights = np.zeros(7)
    add_log_likelihoods(particles, points, field.log_likelihood, field.outside, 0.05, 0.5, log_weights)
    for particle, value in zip(particles, log_weights, strict=True):
        placed = points @ pose_from_xyt(particle)[:2, :2].T + particle[:2]
        cells = np.floor(placed / 0.05).astype(int)[:, ::-1]
        inside = ((cells >= 0) & (cells < field.kind.shape)).all(axis=1)
        terms = np.full(30, field.outside)
        terms[inside] = field.log_likelihood[cells[inside, 0], cells[inside, 1]]
        assert value == pytest.approx(0.5 * terms.sum(), rel=1e-6)


def test_refinement_undoes_a_shift(world: Any) -> None:
    field = build_map_field(world.grid, SETTINGS.beam_model)
    beams = prepare_beam_scans(world.scans, BeamScanSettings())
    errors = []
    for k in range(0, len(beams), 20):
        scan = scan_points(beams, k, 100)
        truth = field.to_grid(world.truth[k])
        pose, information, matched = refine(
            scan.points, scan.normals, truth + np.array([0.12, -0.1, 0.04]), np.eye(3) * 1e-3, SETTINGS.match.vector(),
            field.nearest, field.lines, field.distance_m, 0.05,
        )  # fmt: skip
        errors.append(np.hypot(*(pose - truth)[:2]))
        assert matched > 20
        assert (np.linalg.eigvalsh(information) > 0).all()
    assert np.median(errors) < 0.015
    assert max(errors) < 0.05


def test_agreement_counts_walls_passed_through_as_conflicts(world: Any) -> None:
    field = build_map_field(world.grid, SETTINGS.beam_model)
    pose = field.to_grid(np.array([2.0, 4.3, 0.0]))
    look = (field.kind, field.distance_m, 0.05)
    onto, short = np.array([[0.0, -4.3]]), np.array([[0.0, -2.0]])
    beyond = np.array([[6.98, 3.7]])  # on the wall at x = 9, behind the one at x = 4
    outside = np.array([[0.0, -5.0]])  # behind the outer wall
    sensor = np.zeros(2)
    assert agreement(onto, sensor, pose, 0.25, *look) == (1, 0)
    assert agreement(short, sensor, pose, 0.25, *look) == (0, 1)
    assert agreement(beyond, sensor, pose, 0.25, *look) == (0, 1)
    assert agreement(outside, sensor, pose, 0.25, *look) == (0, 1)


def test_search_finds_the_best_place_and_others_apart_from_it(world: Any) -> None:
    field = build_map_field(world.grid, SETTINGS.beam_model)
    stack = build_search_stack(field, SETTINGS.search)
    beams = prepare_beam_scans(world.scans, BeamScanSettings())
    for k in (10, 100, 180):
        places, scores = find_places(stack, scan_points(beams, k, 200).points, SETTINGS.search)
        truth = field.to_grid(world.truth[k])
        assert np.hypot(*(places[0] - truth)[:2]) < 0.25
        assert (np.diff(scores) <= 0).all()
        near = np.hypot(*(places[:, None, :2] - places[None, :, :2]).transpose(2, 0, 1)) < 0.75
        turned = np.abs(wrap_angle(places[:, None, 2] - places[None, :, 2])) < 0.3
        assert not np.triu(near & turned, 1).any()


def test_too_few_points_are_not_searched(world: Any) -> None:
    stack = build_search_stack(build_map_field(world.grid, SETTINGS.beam_model), SETTINGS.search)
    assert len(find_places(stack, np.ones((5, 2)), SETTINGS.search)[0]) == 0


def judged(state: HealthState, updates: int, **changes: Any) -> HealthState:
    """Assess the same evidence several times."""
    evidence = {"hypothesis": 0, "share": 1.0, "sigma_m": 0.05, "returns": 60, "agree": 55, "conflict": 5} | changes
    for _ in range(updates):
        state = assess(state, Evidence(**evidence), HealthSettings())
    return state


def test_health_follows_the_evidence() -> None:
    settings = HealthSettings()
    fresh = HealthState(health=Health.LOST)
    assert judged(fresh, settings.updates_min - 1).health is Health.AMBIGUOUS
    known = judged(fresh, settings.updates_min)
    assert known.health is Health.OK
    assert judged(known, 2, agree=0, conflict=60).health is Health.OK  # someone walks by
    assert judged(known, 20, agree=0, conflict=60).health is Health.LOST
    assert judged(known, 50, agree=2, conflict=8).health is Health.OK  # off the map: nothing can be told
    assert judged(known, 1, sigma_m=2.0).health is Health.AMBIGUOUS
    assert judged(known, 1, share=0.6).health is Health.AMBIGUOUS
    assert judged(fresh, 50, margin=0.1).health is Health.AMBIGUOUS  # somewhere else fits nearly as well
    assert judged(known, 50, margin=0.1).health is Health.OK  # which does not end a track
    assert judged(fresh, 50, agree=25, conflict=3).health is not Health.OK  # most of the scan is unexplained
    assert judged(fresh, 50, agree=40, conflict=20).health is not Health.OK  # enough to keep a track, not to begin one
    assert judged(fresh, 50, agree=45, conflict=15).health is Health.OK  # but where it leads all others by far
    assert judged(fresh, 50, agree=45, conflict=15, margin=0.4).health is not Health.OK
    assert judged(fresh, 50, margin=0.3, rival_agreement=0.7).health is Health.OK
    assert judged(fresh, 50, margin=0.3, rival_agreement=0.85).health is Health.AMBIGUOUS  # two places to believe
    assert judged(known, 50, agree=45, conflict=15).health is Health.OK


def test_unusable_inputs_are_refused(world: Any) -> None:
    empty = OccupancyGrid(
        geometry=world.grid.geometry, log_odds=np.zeros(world.grid.geometry.shape), observed=world.grid.observed
    )
    with pytest.raises(InputError, match="no cell is occupied"):
        prepare_map(empty, SETTINGS)
    beams = prepare_beam_scans(world.scans, BeamScanSettings())
    with pytest.raises(InputError, match="do not fit"):
        localize(prepare_map(world.grid, SETTINGS), beams, world.odometry.select(np.arange(3)), SETTINGS,
                 rng=np.random.default_rng(0))  # fmt: skip
