"""How surprising a closure is: covariances against dense algebra, drift rates against what was put in."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.geometry import SE2, pose_from_xyt
from posegraph_slam.loop_closure.innovation import innovation, linearise
from posegraph_slam.loop_closure.settings import DriftSettings
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.marginals import relative_covariance

TINY = DriftSettings(heading_sigma_rad_per_m=1e-9, turn_scale_sigma=1e-9)


def chain(steps: np.ndarray, sigmas: tuple[float, float, float]) -> PoseGraph:
    T = SE2.exp(np.asarray(steps, dtype=np.float64))
    poses = [np.eye(3)]
    for step in T:
        poses.append(poses[-1] @ step)
    count = len(poses)
    return PoseGraph(
        poses=np.array(poses),
        session=np.zeros(count),
        index=np.arange(count),
        fixed=np.arange(count) == 0,
        constraints=Constraints(
            i=np.arange(count - 1),
            j=np.arange(1, count),
            T_i_j=T,
            information=np.tile(np.diag(np.array(sigmas) ** -2.0), (count - 1, 1, 1)),
            kind=np.full(count - 1, int(ConstraintKind.SCAN_MATCHING)),
        ),
    )


def closure(graph: PoseGraph, i: int, j: int, offset: list[float], sigma: float = 0.02) -> Constraints:
    T = SE2.between(graph.poses[i], graph.poses[j]) @ pose_from_xyt(np.array(offset))
    return Constraints(
        i=np.array([i]), j=np.array([j]), T_i_j=T[None], information=np.eye(3)[None] / sigma**2,
        kind=np.array([int(ConstraintKind.PROXIMITY)]),
    )  # fmt: skip


def test_covariance_equals_the_graphs_marginals_without_drift() -> None:
    rng = np.random.default_rng(0)
    graph = chain(rng.normal([0.3, 0, 0.05], 0.1, (40, 3)), (0.02, 0.03, 0.01))
    loop = closure(graph, 5, 33, [0.0, 0.0, 0.0])
    graph = graph.with_constraints(Constraints.concatenate([graph.constraints, loop]))
    i, j = np.array([0, 3, 10]), np.array([40, 20, 11])
    got = linearise(graph, TINY).relative_covariance(i, j)
    for k in range(3):
        expected = relative_covariance(graph, int(i[k]), int(j[k]))
        np.testing.assert_allclose(got[k], expected, rtol=1e-3, atol=1e-9)


def test_a_shared_drift_widens_long_loops_more_than_random_steps_do() -> None:
    graph = chain(np.tile([0.3, 0.0, 0.0], (300, 1)), (0.01, 0.01, 0.003))
    random = linearise(graph, TINY).relative_covariance(np.array([0]), np.array([300]))[0]
    shared = linearise(graph, DriftSettings()).relative_covariance(np.array([0]), np.array([300]))[0]
    assert shared[2, 2] == pytest.approx(random[2, 2] + (0.0015 * 90) ** 2, rel=1e-3)
    # a heading that drifts by b per metre bends 90 m into a bow of b 90^2 / 2
    assert shared[1, 1] - random[1, 1] == pytest.approx((0.0015 * 90**2 / 2) ** 2, rel=0.02)


def test_a_right_closure_is_no_surprise_and_a_wrong_one_is() -> None:
    graph = chain(np.tile([0.3, 0.0, 2 * np.pi / 200], (200, 1)), (0.01, 0.01, 0.003))
    linear = linearise(graph, DriftSettings())
    i, j = np.array([0]), np.array([200])
    covariance = linear.relative_covariance(i, j)
    right, wrong = closure(graph, 0, 200, [0.1, 0.1, 0.02]), closure(graph, 0, 200, [7.0, 0.0, 0.0])
    assert innovation(linear, right, covariance)[0] < 5
    assert innovation(linear, wrong, covariance)[0] > 14


def test_drift_rates_are_found_from_closures() -> None:
    rate = 0.001
    length = np.tile([0.3, 0.0, 2 * np.pi / 200], (400, 1))
    truth = chain(length, (0.01, 0.01, 0.003))
    bent = length.copy()
    bent[:, 2] -= rate * 0.3
    graph = chain(bent, (0.01, 0.01, 0.003))
    loops = [closure(truth, k, k + 200, [0.0, 0.0, 0.0], sigma=0.005) for k in range(0, 200, 10)]
    measured = Constraints.concatenate([graph.constraints, *loops])
    solved = graph.with_poses(truth.poses).with_constraints(measured)
    linear = linearise(solved, DriftSettings())
    # one turn in 60 m: a rate per metre and a scale of the turn do the same here, and share the drift
    drift = linear.rates[0] * 0.3 + linear.rates[1] * 2 * np.pi / 200
    assert drift == pytest.approx(rate * 0.3, rel=0.1)
    assert (np.diag(linear.rates_covariance) > 0).all()
