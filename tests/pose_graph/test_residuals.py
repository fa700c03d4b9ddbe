from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from posegraph_slam.geometry import SE2, SE3, Group
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph
from posegraph_slam.pose_graph.gtsam_solver import from_values, to_factor_graph, to_values
from posegraph_slam.pose_graph.residuals import chi2, constraint_jacobians, constraint_residuals
from posegraph_slam.pose_graph.robust import RobustLoss, RobustSettings, robust_costs, robust_weights
from posegraph_slam.pose_graph.solve import graph_cost


def scattered(graph: PoseGraph, seed: int) -> PoseGraph:
    """The graph with every pose but the fixed ones moved far, rotations of any angle included."""
    delta = np.random.default_rng(seed).normal(size=(len(graph), graph.group.dof)) * ~graph.fixed[:, None]
    return graph.with_poses(graph.group.retract(graph.poses, delta))


@given(st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3))
def test_the_chart_of_pose2_is_the_logarithm(tangent: list[float]) -> None:
    a, b = gtsam.Pose2(1.0, 2.0, 3.0), gtsam.Pose2(1.0, 2.0, 3.0) * gtsam.Pose2.Expmap(np.array(tangent))
    np.testing.assert_allclose(a.localCoordinates(b), tangent, atol=1e-9)
    np.testing.assert_allclose(SE2.exp(np.array(tangent)), gtsam.Pose2.Expmap(np.array(tangent)).matrix(), atol=1e-12)


@given(st.lists(st.floats(-1.7, 1.7), min_size=6, max_size=6))
def test_the_chart_of_pose3_is_the_logarithm(tangent: list[float]) -> None:
    b = gtsam.Pose3.Expmap(np.array(tangent))
    np.testing.assert_allclose(gtsam.Pose3().localCoordinates(b), tangent, atol=1e-9)
    np.testing.assert_allclose(SE3.exp(np.array(tangent)), b.matrix(), atol=1e-12)


@given(st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_cost_equals_gtsam_far_from_the_optimum(seed: int) -> None:
    for group in (SE2, SE3):
        graph = scattered(_graph(group), seed)
        for loss in RobustLoss:
            robust = RobustSettings(loss=loss, parameter=2.0)
            ours, theirs = graph_cost(graph, robust), to_factor_graph(graph, robust).error(to_values(graph.poses))
            assert ours == pytest.approx(theirs, rel=1e-9)


def _graph(group: Group) -> PoseGraph:
    i = np.arange(8)
    rng = np.random.default_rng(5)
    mix = rng.normal(size=(8, group.dof, group.dof))
    information = mix @ np.swapaxes(mix, 1, 2) + np.eye(group.dof)
    information = 0.5 * (information + np.swapaxes(information, 1, 2))
    T_i_j = group.exp(rng.normal(size=(8, group.dof)))
    constraints = Constraints(i=i, j=i + 1, T_i_j=T_i_j, information=information, kind=np.where(i % 2 == 0, 0, 3))
    return PoseGraph(
        poses=group.identity(9),
        session=np.zeros(9),
        index=np.arange(9),
        fixed=np.arange(9) == 0,
        constraints=constraints,
    )


def test_values_round_trip(graph: PoseGraph) -> None:
    graph = scattered(graph, 3)
    np.testing.assert_allclose(from_values(to_values(graph.poses), graph.group.matrix_size), graph.poses, atol=1e-15)


def test_jacobians_match_numerical_ones(graph: PoseGraph) -> None:
    graph, group, h = scattered(graph, 1), graph.group, 1e-6
    residuals, by_i, by_j = constraint_jacobians(graph)
    np.testing.assert_allclose(residuals, constraint_residuals(graph))
    c = graph.constraints
    for k, direction in enumerate(np.eye(group.dof)):
        for ends, jacobian in ((c.i, by_i), (c.j, by_j)):
            for edge in range(0, len(c), 7):
                moved = []
                for sign in (h, -h):
                    poses = np.array(graph.poses)
                    poses[ends[edge]] = group.retract(poses[ends[edge]], sign * direction)
                    one = graph.with_poses(poses).with_constraints(c.select(np.array([edge])))
                    moved.append(constraint_residuals(one)[0])
                numerical = (moved[0] - moved[1]) / (2 * h)
                np.testing.assert_allclose(jacobian[edge, :, k], numerical, atol=2e-6 * (1 + np.abs(numerical).max()))


def test_chi2_is_invariant_to_the_frame(graph: PoseGraph, graph_maker: Callable[..., PoseGraph]) -> None:
    motion = graph.group.exp(np.linspace(-1, 2, graph.group.dof))
    np.testing.assert_allclose(chi2(graph), chi2(graph.with_poses(motion @ graph.poses)), rtol=1e-6, atol=1e-9)
    exact = graph_maker(graph.group, noise=0.0)
    np.testing.assert_allclose(chi2(exact), 0, atol=1e-18)


@pytest.mark.parametrize("loss", list(RobustLoss))
@pytest.mark.parametrize("parameter", [0.5, 1.0, 3.0])
def test_losses_match_gtsam(loss: RobustLoss, parameter: float) -> None:
    settings_ = RobustSettings(loss=loss, parameter=parameter)
    e = np.linspace(0, 20, 101)
    weights, costs = robust_weights(e**2, settings_), robust_costs(e**2, settings_)
    names = {"huber": "Huber", "cauchy": "Cauchy", "geman_mcclure": "GemanMcClure", "dcs": "DCS"}
    if loss is RobustLoss.NONE:
        np.testing.assert_array_equal(weights, 1)
        np.testing.assert_allclose(costs, e**2 / 2)
    else:
        oracle = getattr(gtsam.noiseModel.mEstimator, names[loss])(parameter)
        np.testing.assert_allclose(weights, [oracle.weight(x) for x in e], atol=1e-12)
        np.testing.assert_allclose(costs, [oracle.loss(x) for x in e], atol=1e-12)
    assert np.all((weights >= 0) & (weights <= 1))
