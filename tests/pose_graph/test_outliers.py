"""False loops are found, true ones kept, and scores and weights are what they say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.geometry import Group
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.marginals import scale_information
from posegraph_slam.pose_graph.optimum import OptimumSettings, find_optimum
from posegraph_slam.pose_graph.outliers import (
    OutlierMethod,
    OutlierSettings,
    _savings,
    classify_loops,
    gate_of,
    graduated,
    truncated_score,
    truncated_weights,
)
from posegraph_slam.pose_graph.residuals import chi2
from posegraph_slam.pose_graph.solve import solve
from posegraph_slam.pose_graph.solver_settings import SolverSettings


def with_false_loops(graph: PoseGraph, count: int, seed: int) -> PoseGraph:
    rng, c = np.random.default_rng(seed), graph.constraints
    i = rng.integers(0, len(graph) // 2 - 2, count)
    false = Constraints(
        i=i, j=i + rng.integers(len(graph) // 3, len(graph) // 2, count),
        T_i_j=graph.group.exp(rng.normal(size=(count, graph.group.dof))),
        information=np.repeat(c.information[-1:], count, axis=0),
        kind=np.full(count, int(ConstraintKind.EXTERNAL)))  # fmt: skip
    return graph.with_constraints(Constraints.concatenate([c, false]))


@pytest.fixture
def spoilt(group: Group, graph_maker) -> tuple[PoseGraph, np.ndarray, np.ndarray]:
    """A graph with 20 false among 50 loops, which are false, and the optimum without them."""
    clean = graph_maker(group, nodes=60, loops=30)
    graph = with_false_loops(clean, 20, 1)
    return graph, np.arange(len(graph.constraints)) >= len(clean.constraints), solve(clean).poses


@pytest.mark.parametrize("method", [OutlierMethod.GNC, OutlierMethod.AUTO])
def test_false_loops_are_rejected(spoilt, method: OutlierMethod) -> None:
    graph, false, truth = spoilt
    found = classify_loops(graph, OutlierSettings(method=method))
    assert not np.any(found.kept & false)
    assert np.mean(found.kept[~false]) > 0.95
    assert np.all(found.kept[~graph.constraints.is_loop])
    d = graph.group.dimension
    assert np.sqrt(np.mean((found.poses[:, :d, d] - truth[:, :d, d]) ** 2)) < 0.02
    assert found.winner in found.scores


def test_a_clean_graph_keeps_nearly_all_loops(graph: PoseGraph) -> None:
    optimum = find_optimum(graph, OptimumSettings(outliers=OutlierSettings(method=OutlierMethod.AUTO)))
    assert np.mean(optimum.kept) > 0.95
    assert optimum.certificate is not None
    assert optimum.certificate.holds


def test_everything_is_reported_for_every_edge(spoilt) -> None:
    graph, false, _ = spoilt
    optimum = find_optimum(graph, OptimumSettings(outliers=OutlierSettings(method=OutlierMethod.AUTO)))
    assert len(optimum.kept) == len(optimum.weights) == len(optimum.chi2) == len(graph.constraints)
    np.testing.assert_allclose(optimum.chi2, chi2(optimum.graph), rtol=1e-7, atol=1e-20)
    np.testing.assert_array_equal(optimum.weights > 0, optimum.kept)
    assert optimum.error == pytest.approx(0.5 * optimum.chi2[optimum.kept].sum(), rel=1e-9)
    assert np.all(optimum.chi2[false] > gate_of(graph, 0.99))


def test_a_loss_is_solved_as_asked_and_not_certified(spoilt) -> None:
    graph, false, _ = spoilt
    optimum = find_optimum(graph, OptimumSettings(outliers=OutlierSettings(method=OutlierMethod.DCS)))
    assert optimum.certificate is None
    assert optimum.kept.all()
    assert np.all(optimum.weights[false] < 0.1)


def test_graduated_weights_end_at_zero_or_one(spoilt) -> None:
    graph, _, _ = spoilt
    poses = graduated(graph, OutlierSettings(method=OutlierMethod.GNC), SolverSettings())
    gate = gate_of(graph, 0.99)
    assert truncated_score(graph.with_poses(poses), gate) < truncated_score(graph, gate)


@given(st.floats(1e-6, 1e6), st.floats(1e-3, 1e3), st.floats(1e-9, 1e5))
def test_truncated_weights_fall_with_the_error(chi2_value: float, gate: float, control: float) -> None:
    low, high = truncated_weights(np.array([chi2_value, 1.5 * chi2_value]), gate, control)
    assert 0.0 <= high <= low <= 1.0
    assert truncated_weights(np.array([gate * control / (control + 1)]), gate, control)[0] == pytest.approx(1.0)
    assert truncated_weights(np.array([gate * (control + 1) / control]), gate, control)[0] == pytest.approx(
        0.0, abs=1e-6 * (1 + control)
    )


def test_savings_foretell_the_cost_without_a_loop(group: Group, graph_maker) -> None:
    graph = graph_maker(group, noise=0.1)
    solved = graph.with_poses(solve(graph).poses)
    saved, loops = _savings(solved), np.flatnonzero(graph.constraints.is_loop)
    for k in (0, 7, 19):
        weights = np.ones(len(graph.constraints))
        weights[loops[k]] = 1e-12
        without = solve(solved.with_constraints(scale_information(graph.constraints, weights)))
        assert saved[k] == pytest.approx(2 * (solve(solved).cost - without.cost), rel=0.1)
