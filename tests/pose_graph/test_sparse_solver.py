from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.errors import ConfigurationError
from posegraph_slam.geometry import SE3, Group
from posegraph_slam.pose_graph.block_cholesky import factorize
from posegraph_slam.pose_graph.block_pattern import block_pattern
from posegraph_slam.pose_graph.block_substitution import solve_factored, solve_many
from posegraph_slam.pose_graph.elimination import analyze, elimination_work, minimum_degree, nested_dissection
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph
from posegraph_slam.pose_graph.linearization import chi2_at, moved_poses, normal_equations, residuals_at
from posegraph_slam.pose_graph.residuals import chi2, constraint_jacobians, constraint_residuals
from posegraph_slam.pose_graph.robust import RobustLoss, RobustSettings
from posegraph_slam.pose_graph.solve import solve
from posegraph_slam.pose_graph.solver_settings import SolverKind, SolverMethod, SolverSettings, StopReason

Maker = Callable[..., PoseGraph]


def random_blocks(count: int, edges: int, p: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A random diagonally dominant block matrix as (i, j, diagonal, off-diagonal), repeated places included."""
    rng = np.random.default_rng(seed)
    i = rng.integers(0, count, edges)
    j = (i + rng.integers(1, count, edges)) % count
    off = rng.normal(size=(edges, p, p))
    half = rng.normal(size=(count, p, p))
    weight = np.bincount(np.concatenate([i, j]), minlength=count)
    return i, j, half @ np.swapaxes(half, 1, 2) + (3 * p * weight + 1)[:, None, None] * np.eye(p), off


def dense(count: int, i: np.ndarray, j: np.ndarray, diagonal: np.ndarray, off: np.ndarray) -> np.ndarray:
    p = diagonal.shape[1]
    M = np.zeros((count, p, count, p))
    M[np.arange(count), :, np.arange(count)] = diagonal
    for a, b, block in zip(i, j, off, strict=True):
        M[a, :, b] += block
        M[b, :, a] += block.T
    return M.reshape(count * p, count * p)


@given(st.integers(2, 40), st.integers(0, 120), st.sampled_from([1, 2, 3, 6]), st.integers(0, 10_000))
def test_factorisation_solves_what_the_dense_one_solves(count: int, edges: int, p: int, seed: int) -> None:
    i, j, diagonal, off = random_blocks(count, edges, p, seed)
    pattern = block_pattern(count, i, j, p)
    factor = factorize(pattern, diagonal, off, 0.5)
    assert factor is not None
    right = np.random.default_rng(seed).normal(size=(count, p))
    expected = np.linalg.solve(dense(count, i, j, diagonal, off) + 0.5 * np.eye(count * p), right.ravel())
    np.testing.assert_allclose(solve_factored(pattern, factor, right).ravel(), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("count", "edges", "p"), [(60, 1500, 6), (200, 4000, 3)])
def test_large_fronts_use_the_blocked_path(count: int, edges: int, p: int) -> None:
    i, j, diagonal, off = random_blocks(count, edges, p, 1)
    pattern = block_pattern(count, i, j, p)
    assert pattern.largest_front > 200
    factor = factorize(pattern, diagonal, off, 0.0)
    assert factor is not None
    right = np.random.default_rng(0).normal(size=(count, p))
    expected = np.linalg.solve(dense(count, i, j, diagonal, off), right.ravel())
    np.testing.assert_allclose(solve_factored(pattern, factor, right).ravel(), expected, rtol=1e-9, atol=1e-12)


@given(st.integers(2, 30), st.integers(0, 80), st.integers(0, 10_000))
def test_rows_can_be_left_out(count: int, edges: int, seed: int) -> None:
    i, j, diagonal, off = random_blocks(count, edges, 3, seed)
    rng = np.random.default_rng(seed)
    kept = rng.random(count) < 0.7
    kept[0] = True
    pattern = block_pattern(count, i, j, 3, kept=kept)
    factor = factorize(pattern, diagonal, off, 0.0)
    assert factor is not None
    right = rng.normal(size=(count, 3, 2))
    inside = np.repeat(kept, 3)
    part = dense(count, i, j, diagonal, off)[np.ix_(inside, inside)]
    expected = np.zeros((count, 3, 2))
    expected[kept] = np.linalg.solve(part, right[kept].reshape(-1, 2)).reshape(-1, 3, 2)
    np.testing.assert_allclose(solve_many(pattern, factor, right), expected, rtol=1e-9, atol=1e-12)
    first = np.ascontiguousarray(right[..., 0])
    np.testing.assert_allclose(solve_factored(pattern, factor, first), expected[..., 0], rtol=1e-9, atol=1e-12)


def test_indefinite_matrices_are_refused() -> None:
    i, j, diagonal, off = random_blocks(20, 40, 3, 3)
    pattern = block_pattern(20, i, j, 3)
    diagonal[7, 1, 1] = -1.0
    assert factorize(pattern, diagonal, off, 0.0) is None
    diagonal[7, 1, 1] = np.nan
    assert factorize(pattern, diagonal, off, 0.0) is None


@given(st.integers(1, 60), st.integers(0, 150), st.integers(0, 10_000))
def test_the_analysis_is_a_permutation_with_postordered_supernodes(count: int, edges: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    i = rng.integers(0, count, edges if count > 1 else 0)
    j = (i + rng.integers(1, max(count, 2), len(i))) % count
    tree = analyze(count, i, j, 3)
    assert sorted(tree.position.tolist()) == list(range(count))
    assert sorted(minimum_degree(count, i, j).tolist()) == list(range(count))
    assert tree.start[0] == 0
    assert tree.start[-1] == count
    above = tree.parent >= 0
    assert np.all(tree.parent[above] > np.flatnonzero(above))
    for node in range(len(tree.parent)):
        rows = tree.rows[tree.row_start[node] : tree.row_start[node + 1]]
        assert np.all(np.diff(rows) > 0)
        assert np.all(rows >= tree.start[node + 1])


def test_nested_dissection_orders_every_node_and_saves_work_on_a_cube() -> None:
    side = 9
    number = np.arange(side**3).reshape(side, side, side)
    ends = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:]), (number[:, :, :-1], number[:, :, 1:])]
    i, j = (np.concatenate([pair[k].ravel() for pair in ends]) for k in range(2))
    count = side**3 + 2  # two nodes without any edge
    orders = minimum_degree(count, i, j), nested_dissection(count, i, j)
    for order in orders:
        assert sorted(order.tolist()) == list(range(count))
    assert elimination_work(count, i, j, orders[1]) < elimination_work(count, i, j, np.arange(count))
    dense_work = elimination_work(count, i, j, np.argsort(np.random.default_rng(0).random(count)))
    assert elimination_work(count, i, j, orders[1]) < 0.5 * dense_work


@pytest.mark.parametrize("scale", [1e-9, 1e-5, 1e-3, 0.09, 0.11, 0.5, 1.2])
def test_compiled_residuals_match_the_formulas_on_arrays(group: Group, graph_maker: Maker, scale: float) -> None:
    noisy = disturbed(graph_maker(group, noise=0.0), scale)
    np.testing.assert_allclose(residuals_at(noisy.poses, noisy.constraints), constraint_residuals(noisy), atol=1e-11)
    np.testing.assert_allclose(chi2_at(noisy.poses, noisy.constraints), chi2(noisy), rtol=1e-9, atol=1e-11)


def disturbed(graph: PoseGraph, scale: float) -> PoseGraph:
    """Move every measurement by a random tangent of this size."""
    c = graph.constraints
    delta = scale * np.random.default_rng(0).normal(size=(len(c), graph.group.dof))
    T = graph.group.retract(c.T_i_j, delta)
    return graph.with_constraints(Constraints(i=c.i, j=c.j, T_i_j=T, information=c.information, kind=c.kind))


def test_rotations_by_nearly_half_a_turn_have_residuals(graph_maker: Maker) -> None:
    graph, axis = graph_maker(SE3, nodes=2, loops=0), np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, -0.8, 0]])
    c = graph.constraints
    for direction in axis:
        for angle in (np.pi - 1e-9, np.pi - 1e-3, 3.0, 2.2):
            turn = SE3.exp(np.concatenate([angle * direction, [0.3, 0.2, 0.1]]))
            T = SE3.inverse(graph.poses[0]) @ graph.poses[1] @ SE3.inverse(turn)
            one = Constraints(i=c.i, j=c.j, T_i_j=T[None], information=c.information, kind=c.kind)
            residual = residuals_at(graph.poses, one)
            np.testing.assert_allclose(SE3.exp(residual[0]), T_error(graph, T), atol=1e-7)
            assert np.linalg.norm(residual[0, :3]) == pytest.approx(angle, abs=1e-7)


def T_error(graph: PoseGraph, T: np.ndarray) -> np.ndarray:  # noqa: N802
    return SE3.inverse(T) @ SE3.between(graph.poses[0], graph.poses[1])


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-5, 1e-3, 0.09, 0.11, 0.5, 1.2])
def test_normal_equations_are_those_of_the_dense_jacobian(group: Group, graph_maker: Maker, scale: float) -> None:
    graph = disturbed(graph_maker(group, nodes=12, loops=10, noise=0.0), scale)
    c, n, p = graph.constraints, len(graph), graph.group.dof
    residuals, by_i, by_j = constraint_jacobians(graph)
    weights = np.linspace(0.1, 1, len(c))
    J = np.zeros((len(c), p, n, p))
    J[np.arange(len(c)), :, c.i], J[np.arange(len(c)), :, c.j] = by_i, by_j
    J, W = J.reshape(len(c), p, n * p), c.information * weights[:, None, None]
    found = normal_equations(np.array(graph.poses), c, weights)
    gradient = np.einsum("eak,eab,eb->k", J, W, residuals)
    np.testing.assert_allclose(found.gradient.ravel(), gradient, rtol=1e-8, atol=1e-9 * np.abs(gradient).max() + 1e-9)
    H = np.einsum("eak,eab,ebm->km", J, W, J, optimize=True)
    ours = dense(n, c.i, c.j, found.diagonal, found.off_diagonal)
    np.testing.assert_allclose(ours, H, rtol=1e-9, atol=1e-11 * np.abs(H).max())


@pytest.mark.parametrize("loss", list(RobustLoss))
def test_both_solvers_find_the_same_optimum(graph: PoseGraph, loss: RobustLoss) -> None:
    robust = RobustSettings(loss=loss, parameter=5.0)
    ours = solve(graph, SolverSettings(kind=SolverKind.SPARSE, robust=robust))
    theirs = solve(graph, SolverSettings(kind=SolverKind.GTSAM, robust=robust))
    assert ours.converged
    assert ours.cost == pytest.approx(theirs.cost, rel=1e-8)
    np.testing.assert_allclose(ours.weights, theirs.weights, atol=1e-3)
    np.testing.assert_allclose(ours.record.cost[:4], theirs.record.cost[:4], rtol=1e-6)  # the same walk


def test_the_last_step_reuses_the_factor_and_reaches_the_optimum(graph: PoseGraph) -> None:
    run = solve(graph, SolverSettings(kind=SolverKind.SPARSE))
    tight = solve(graph.with_poses(run.poses), SolverSettings(kind=SolverKind.GTSAM, relative_tolerance=1e-14))
    assert run.record.cost[-1] == pytest.approx(run.cost, rel=1e-12)
    assert np.all(np.diff(run.record.cost) <= 0)
    assert run.cost == pytest.approx(tight.cost, rel=1e-10)


def test_dogleg_is_gtsams(graph: PoseGraph) -> None:
    with pytest.raises(ConfigurationError, match=r"solver.method: the sparse solver knows no dogleg"):
        solve(graph, SolverSettings(kind=SolverKind.SPARSE, method=SolverMethod.DOGLEG))


def test_a_graph_of_fixed_nodes_is_left_alone(graph: PoseGraph) -> None:
    held = PoseGraph(
        poses=graph.poses,
        session=graph.session,
        index=graph.index,
        fixed=np.ones(len(graph)),
        constraints=graph.constraints,
    )
    result = solve(held)
    assert result.stop_reason is StopReason.ALREADY_OPTIMAL
    np.testing.assert_array_equal(result.poses, held.poses)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-4, 0.05, 0.2, 1.0, 3.0])
def test_moves_are_right_updates(group: Group, scale: float) -> None:
    rng = np.random.default_rng(0)
    poses = group.exp(rng.normal(size=(50, group.dof)))
    delta = scale * rng.normal(size=(50, group.dof))
    delta[7] = 0.0
    moved = moved_poses(poses, delta)
    np.testing.assert_allclose(moved, group.retract(poses, delta), rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(moved[7], poses[7])
