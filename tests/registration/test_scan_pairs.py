"""Batches of pairs: the same as one at a time, whatever the executor."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, pose_from_xyt
from posegraph_slam.registration import PointSets, RegistrationStatus, icp, match_consecutive, match_pairs
from posegraph_slam.registration import scan_pairs as module


@pytest.fixture(scope="module")
def walk(simulated: SimpleNamespace) -> tuple[PointSets, np.ndarray]:
    """Ten scans along a curve, and the true pose of each."""
    rng, poses = np.random.default_rng(0), [np.eye(3)]
    for _ in range(9):
        poses.append(poses[-1] @ pose_from_xyt(np.array([0.1, 0.01, 0.05])))
    scans = [simulated.scan(T, simulated.room, 181, 0.01, rng) for T in poses]
    return PointSets.from_list(scans), np.array(poses)


def test_a_chain_follows_the_walk(walk: tuple[PointSets, np.ndarray]) -> None:
    sets, poses = walk
    results = match_consecutive(sets, SE2.identity(9))
    assert results.usable.all()
    truth = SE2.between(poses[:-1], poses[1:])
    assert np.abs(SE2.local(results.T_target_source, truth)).max() < 0.01
    assert not results.degenerate.any()
    assert (results.inliers <= np.diff(sets.offsets)[1:]).all()
    assert (results.inlier_fraction > 0.8).all()


def test_rows_equal_single_registrations(walk: tuple[PointSets, np.ndarray]) -> None:
    sets, _ = walk
    pairs = np.array([[0, 3], [5, 4], [2, 2]])
    results = match_pairs(sets, pairs, SE2.identity(3))
    for row, (t, s) in enumerate(pairs):
        single = icp(sets.points_of(s), sets.points_of(t), np.eye(3))
        assert results.T_target_source[row].tobytes() == single.T_target_source.tobytes()
        assert results.information[row].tobytes() == single.information.tobytes()
        assert results.status_of(row) is single.status


class Pool:
    """Two processes that take units of work."""

    workers = 2

    def __init__(self) -> None:
        self.pool = ProcessPoolExecutor(2)

    def map(self, function, items):  # type: ignore[no-untyped-def]
        return list(self.pool.map(function, items))


def test_processes_give_the_same_bytes(walk: tuple[PointSets, np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    sets, _ = walk
    whole = match_consecutive(sets, SE2.identity(9))
    monkeypatch.setattr(module, "CHUNK", 2)
    told: list[tuple[int, int]] = []
    executor = Pool()
    parts = match_consecutive(sets, SE2.identity(9), executor=executor, progress=lambda _, *n: told.append(n))
    executor.pool.shutdown()
    for name in ("T_target_source", "information", "status", "inliers", "rmse_m", "iterations"):
        assert getattr(whole, name).tobytes() == getattr(parts, name).tobytes()
    assert told[-1] == (9, 9)


def test_scans_without_returns_fail_alone(walk: tuple[PointSets, np.ndarray]) -> None:
    sets, _ = walk
    scans = [sets.points_of(k) for k in range(4)]
    scans[2] = np.zeros((0, 2))
    results = match_consecutive(PointSets.from_list(scans), SE2.identity(3))
    assert results.usable.tolist() == [True, False, False]
    assert results.status_of(1) is RegistrationStatus.TOO_FEW_POINTS
    assert np.isnan(results.T_target_source[1:]).all()


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_scans_make_no_pairs(count: int) -> None:
    sets = PointSets(points=np.zeros((5 * count, 2)), offsets=np.arange(count + 1) * 5)
    results = match_consecutive(sets, np.zeros((0, 3, 3)))
    assert len(results) == 0
    assert results.T_target_source.shape == (0, 3, 3)
    assert results.information.shape == (0, 3, 3)


def test_shapes_that_do_not_fit_are_refused(walk: tuple[PointSets, np.ndarray]) -> None:
    sets, _ = walk
    with pytest.raises(InputError, match="do not fit"):
        match_consecutive(sets, SE2.identity(8))
    with pytest.raises(InputError, match="name set 10"):
        match_pairs(sets, np.array([[0, 10]]), SE2.identity(1))
    with pytest.raises(InputError, match="offsets must rise"):
        PointSets(points=np.zeros((5, 2)), offsets=np.array([0, 4]))


def test_selected_sets_keep_their_points(walk: tuple[PointSets, np.ndarray]) -> None:
    sets, _ = walk
    chosen = sets.select(np.array([7, 0, 7]))
    for row, index in enumerate((7, 0, 7)):
        np.testing.assert_array_equal(chosen.points_of(row), sets.points_of(index))
