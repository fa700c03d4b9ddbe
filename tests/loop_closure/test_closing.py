"""Loops close on simulated laps, wrong closures do not survive, and every decision is recorded."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.execution import SerialExecutor
from posegraph_slam.geometry import SE2, pose_from_xyt
from posegraph_slam.loop_closure import closing
from posegraph_slam.loop_closure.closing import close_loops, settle
from posegraph_slam.loop_closure.ledger import Ledger
from posegraph_slam.loop_closure.matching import Evidence, register_candidates
from posegraph_slam.loop_closure.proposals import Candidates, make_candidates
from posegraph_slam.loop_closure.settings import LoopClosureSettings, ProposalSettings, VerificationSettings
from posegraph_slam.loop_closure.verification import chi2_gate, count_support, rejection_reasons
from posegraph_slam.pipeline.executors import ThreadExecutor
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints
from posegraph_slam.pose_graph.robust import RobustLoss, RobustSettings
from posegraph_slam.pose_graph.solver_settings import SolverSettings

from .conftest import Laps

SOLVER = SolverSettings(robust=RobustSettings(loss=RobustLoss.HUBER))


def pairs_of(laps: Laps, near_m: float = 1.5) -> tuple[IntArray, IntArray]:
    """Target and source of pairs that truly lie near each other and face alike, more than 20 m of travel apart."""
    poses, path = laps.truth, laps.path_m
    i, j = np.triu_indices(len(poses), 1)
    near = np.linalg.norm(poses[i, :2, 2] - poses[j, :2, 2], axis=1) < near_m
    alike = np.trace(np.swapaxes(poses[i, :2, :2], 1, 2) @ poses[j, :2, :2], axis1=1, axis2=2) > 1.6
    rows = np.flatnonzero(near & alike & (path[j] - path[i] > 20))
    rows = rows[:: max(1, len(rows) // 25)]
    return i[rows], j[rows]


def candidates_of(target: IntArray, source: IntArray, reach_m: float) -> Candidates:
    n = len(target)
    return Candidates(
        target=target,
        source=source,
        kind=np.full(n, int(ConstraintKind.PROXIMITY)),
        travel_m=np.full(n, 50.0),
        reach_m=np.full(n, reach_m),
        reach_rad=np.full(n, 0.3),
    )


def test_a_bent_chain_is_straightened(laps: Laps) -> None:
    bent = laps.bent(0.004)
    assert laps.error_m(bent.poses) > 1.0
    result = close_loops(bent, laps.scans, LoopClosureSettings(), SOLVER)
    assert laps.error_m(result.graph.poses) < 0.06
    accepted = [record for record in result.records if record.accepted]
    assert len(accepted) == int(result.graph.constraints.is_loop.sum()) > 20
    for record in accepted:
        error = SE2.log(
            SE2.between(
                SE2.between(laps.truth[record.target], laps.truth[record.source]),
                SE2.between(result.graph.poses[record.target], result.graph.poses[record.source]),
            )
        )
        assert np.hypot(error[0], error[1]) < 0.1
    assert all(record.reason for record in result.records if not record.accepted)


def test_places_that_are_apart_are_never_joined(laps: Laps) -> None:
    half = len(laps.graph) // 2

    def apart(i: IntArray, j: IntArray, distance_m: FloatArray) -> BoolArray:
        assert (distance_m >= 0).all()
        return np.asarray((i < half) & (j >= half))

    result = close_loops(laps.graph, laps.scans, LoopClosureSettings(), SOLVER, apart=apart)
    refused = [record for record in result.records if record.reason == "on another level"]
    assert len(refused) > 10
    assert all(record.target < half <= record.source for record in refused)
    loops = result.graph.constraints.select(result.graph.constraints.is_loop)
    assert not ((loops.i < half) & (loops.j >= half)).any()


def test_two_workers_give_the_same_bytes(laps: Laps) -> None:
    one = close_loops(laps.graph, laps.scans, LoopClosureSettings(), SOLVER)
    with ThreadExecutor(2) as executor:
        two = close_loops(laps.graph, laps.scans, LoopClosureSettings(), SOLVER, executor=executor)
    assert one.graph.poses.tobytes() == two.graph.poses.tobytes()
    assert repr(one.records) == repr(two.records)


def test_switched_off_nothing_is_tried(laps: Laps) -> None:
    result = close_loops(laps.graph, laps.scans, LoopClosureSettings(enabled=False), SOLVER)
    assert not result.records
    assert not result.graph.constraints.is_loop.any()
    np.testing.assert_allclose(result.graph.poses, laps.graph.poses, atol=1e-9)


def test_true_pairs_pass_and_far_pairs_fail(laps: Laps) -> None:
    settings = VerificationSettings()
    lidar = laps.truth @ laps.scans.T_base_lidar
    true = candidates_of(*pairs_of(laps), reach_m=0.5)
    evidence = register_candidates(true, laps.scans, lidar, settings, SerialExecutor())
    reasons = rejection_reasons(true, evidence, settings)
    assert np.mean([not reason for reason in reasons]) > 0.8
    truth = SE2.between(lidar[true.target], lidar[true.source])
    error = SE2.local(truth, evidence.T_target_source)[[not reason for reason in reasons]]
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.08
    rng = np.random.default_rng(0)
    far_i, far_j = np.sort(rng.integers(0, len(laps.truth), (2, 200)), axis=0)
    far = np.linalg.norm(laps.truth[far_i, :2, 2] - laps.truth[far_j, :2, 2], axis=1) > 5.0
    wrong = candidates_of(far_i[far], far_j[far], reach_m=0.5)
    moved = np.array(lidar)
    evidence = register_candidates(wrong, laps.scans, place_on_targets(moved, wrong), settings, SerialExecutor())
    assert np.mean([not reason for reason in rejection_reasons(wrong, evidence, settings)]) < 0.06


def place_on_targets(poses: FloatArray, wrong: Candidates) -> FloatArray:
    """Put the sources of wrong pairs onto their targets, as a false proposal does."""
    placed = np.array(poses)
    placed[wrong.source] = poses[wrong.target]
    return placed


def test_a_wrong_closure_is_settled_out_and_a_right_one_taken_back(laps: Laps) -> None:
    graph = laps.bent(0.004)
    target, source = pairs_of(laps)
    measured = SE2.between(laps.truth[target], laps.truth[source])
    wrong = pose_from_xyt(np.array([1.5, 0.8, 0.4])) @ measured[:2]
    closures = Constraints(
        i=np.concatenate([target, target[:2] + 3]),
        j=np.concatenate([source, source[:2]]),
        T_i_j=np.concatenate([measured, wrong]),
        information=np.tile(np.diag([2500.0, 2500.0, 4e4]), (len(target) + 2, 1, 1)),
        kind=np.full(len(target) + 2, int(ConstraintKind.PROXIMITY)),
    )
    solved, sigmas, kept = settle(graph, graph.constraints, closures, SOLVER, 3.0)
    assert kept[:-2].all()
    assert not kept[-2:].any()
    assert sigmas[-2:].min() > 3
    assert laps.error_m(solved.poses) < 0.15


def test_support_counts_the_candidates_that_agree(laps: Laps) -> None:
    target, source = pairs_of(laps)
    T = SE2.between(laps.truth[target], laps.truth[source])
    T[0] = T[0] @ pose_from_xyt(np.array([2.0, 0.0, 0.5]))
    candidates = candidates_of(target, source, 1.0)
    eligible = np.ones(len(target), dtype=np.bool_)
    agree, disagree = count_support(candidates, T, laps.truth, laps.path_m, eligible, VerificationSettings())
    assert agree[0] == 0
    assert disagree[0] > 0
    assert (agree[1:] >= disagree[1:]).all()
    assert agree[1:].max() > 1


def test_an_empty_batch_has_empty_evidence(laps: Laps) -> None:
    none = make_candidates(
        np.zeros(0, np.int64), np.zeros(0, np.int64), ConstraintKind.PROXIMITY, np.zeros(0), ProposalSettings()
    )
    evidence = register_candidates(none, laps.scans, laps.graph.poses, VerificationSettings(), SerialExecutor())
    assert evidence.T_target_source.shape == (0, 3, 3)
    assert rejection_reasons(none, evidence, VerificationSettings()) == []


def test_a_pair_is_tried_again_only_with_a_much_better_guess() -> None:
    ledger = Ledger()
    first = candidates_of(np.array([0]), np.array([9]), 1.0)
    assert ledger.untried(first).tolist() == [0]
    evidence = Evidence(
        T_target_source=SE2.identity(1), hessian=np.eye(3)[None], score=np.zeros(1), matched_fraction=np.zeros(1),
        agreement=np.zeros(1), overlap=np.zeros(1), rmse_m=np.zeros(1),
        ambiguous=np.zeros(1, dtype=np.bool_), blind=np.zeros(1, dtype=np.bool_),
    )  # fmt: skip
    ledger.add(0, first, evidence, error_before=np.zeros((1, 3)), sigmas_before=np.zeros(1), reasons=["no"])
    assert ledger.untried(first).tolist() == []
    better = Candidates(**{**{n: getattr(first, n) for n in first.__dataclass_fields__}, "travel_m": np.array([20.0])})
    assert ledger.untried(better).tolist() == [0]


@pytest.mark.parametrize(("sigma", "dof", "value"), [(1.0, 1, 1.0), (3.0, 1, 9.0), (3.0, 3, 14.156)])
def test_gate_is_as_rare_as_a_gaussian(sigma: float, dof: int, value: float) -> None:
    assert chi2_gate(sigma, dof) == pytest.approx(value, rel=1e-4)


def test_settling_stops(laps: Laps, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where the kept set swings to and fro, the number of solutions is bounded and the gate holds."""
    monkeypatch.setattr(closing, "SETTLING_ROUNDS", 1)
    target, source = pairs_of(laps)
    measured = SE2.between(laps.truth[target], laps.truth[source]) @ pose_from_xyt(np.array([0.5, 0.0, 0.0]))
    closures = Constraints(
        i=target, j=source, T_i_j=measured, information=np.tile(np.eye(3) * 1e4, (len(target), 1, 1)),
        kind=np.full(len(target), 3),
    )  # fmt: skip
    _, sigmas, kept = settle(laps.graph, laps.graph.constraints, closures, SOLVER, 3.0)
    assert (sigmas[kept] <= 3.0 + 1e-9).all()
