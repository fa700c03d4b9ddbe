"""Certificates: known optima, bounds that hold, and the way out of poor basins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from posegraph_slam.geometry import SE2, SE3, Group
from posegraph_slam.pose_graph.certificate import CertificateStatus, certify
from posegraph_slam.pose_graph.chordal_cost import (
    certificate_diagonal,
    chordal_problem,
    chordal_weights,
    lifted_poses,
    moved,
    multipliers,
    tangent_gradient,
    tangent_hessian,
    tangents,
    value,
)
from posegraph_slam.pose_graph.files import read_graph
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.noise import information_isotropic
from posegraph_slam.pose_graph.optimum import OptimumSettings, find_optimum
from posegraph_slam.pose_graph.starts import Start

CHORDAL = {"intel": 52.3482, "manhattan": 6431.39, "sphere2500": 1687.01, "parking-garage": 1.26249,
           "smallGrid3D": 1025.40}  # fmt: skip


def ring(nodes: int) -> PoseGraph:
    """A loop of nodes whose measured turns vanish, started wound once around: a local minimum."""
    wound = np.zeros((nodes, 3))
    wound[:, 2] = 2 * np.pi * np.arange(nodes) / nodes
    i = np.arange(nodes)
    constraints = Constraints(
        i=i, j=(i + 1) % nodes, T_i_j=SE2.identity(nodes), kind=np.full(nodes, int(ConstraintKind.ODOMETRY)),
        information=np.repeat(information_isotropic(SE2, sigma_translation_m=1.0, sigma_rotation_rad=1.0)[None],
                              nodes, axis=0))  # fmt: skip
    return PoseGraph(poses=SE2.exp(wound * [0, 0, 1]), session=np.zeros(nodes, np.int64), index=i, fixed=i == 0,
                     constraints=constraints)  # fmt: skip


def dense(problem) -> np.ndarray:
    n, size = problem.diagonal.shape[:2]
    M = np.zeros((n, size, n, size))
    for k in range(n):
        M[k, :, k] += problem.diagonal[k]
    for e, (a, b) in enumerate(zip(problem.i, problem.j, strict=True)):
        M[a, :, b] += problem.off_diagonal[e]
        M[b, :, a] += problem.off_diagonal[e].T
    return M.reshape(n * size, n * size)


def test_cost_is_the_quadratic_form_and_the_sum_of_its_definition(graph: PoseGraph) -> None:
    problem, at = chordal_problem(graph), lifted_poses(graph.poses)
    cost, G = value(problem, at)
    d = problem.dimension
    X = np.concatenate([at.Q, at.t[..., None]], axis=2).transpose(1, 0, 2).reshape(d, -1)
    assert cost == pytest.approx(np.trace(X @ dense(problem) @ X.T), rel=1e-9)
    np.testing.assert_allclose(G.transpose(1, 0, 2).reshape(d, -1), X @ dense(problem), atol=1e-8 * np.abs(X).max())
    W, c, total = chordal_weights(graph.constraints), graph.constraints, 0.0
    for e in range(len(c)):
        R_i, R_j, T = graph.poses[c.i[e], :d, :d], graph.poses[c.j[e], :d, :d], c.T_i_j[e]
        shift = graph.poses[c.j[e], :d, d] - graph.poses[c.i[e], :d, d] - R_i @ T[:d, d]
        total += W[e, 0] * np.sum((R_j - R_i @ T[:d, :d]) ** 2) + W[e, d] * shift @ shift
    assert cost == pytest.approx(total, rel=1e-12)


@pytest.mark.parametrize("extra", [0, 1])
def test_derivatives_are_those_of_the_cost(group: Group, graph: PoseGraph, extra: int) -> None:
    problem, d, rng = chordal_problem(graph), group.dimension, np.random.default_rng(3)
    at = lifted_poses(graph.poses)
    if extra:
        Q = np.zeros((len(graph), d + 1, d + 1))
        Q[:, :d, :d], Q[:, d, d] = at.Q, 1.0
        at = type(at)(Q=Q, t=np.concatenate([at.t, np.zeros((len(graph), 1))], axis=1))
    basis = tangents(d, d + extra)
    at = moved(at, basis, 0.3 * rng.normal(size=(len(graph), len(basis.row))), d)
    delta = rng.normal(size=(len(graph), len(basis.row)))
    h = 1e-4
    ahead, behind = (value(problem, moved(at, basis, s * h * delta, d))[0] for s in (1, -1))
    cost, G = value(problem, at)
    gradient = tangent_gradient(at.Q, G, basis.row, basis.column, basis.sign)
    assert 2 * np.sum(gradient * delta) == pytest.approx((ahead - behind) / (2 * h), rel=1e-6)
    orthonormal = at.Q.swapaxes(1, 2) @ at.Q
    np.testing.assert_allclose(orthonormal, np.broadcast_to(np.eye(d + extra), orthonormal.shape), atol=1e-12)
    assert cost > 0


def test_hessian_at_an_optimum_is_that_of_the_cost(graph: PoseGraph) -> None:
    problem, d, rng = chordal_problem(graph), graph.group.dimension, np.random.default_rng(1)
    at = lifted_poses(certify(graph).poses)
    basis = tangents(d, d)
    cost, G = value(problem, at)
    S = certificate_diagonal(problem, multipliers(at, G))
    diagonal, off = tangent_hessian(at.Q, problem.i, problem.j, S, problem.off_diagonal, basis.row, basis.column,
                                    basis.sign)  # fmt: skip
    delta = rng.normal(size=(len(graph), len(basis.row)))
    quadratic = np.einsum("na,nab,nb->", delta, diagonal, delta)
    quadratic += 2 * np.einsum("ea,eab,eb->", delta[problem.i], off, delta[problem.j])
    h = 1e-4
    ahead, behind = (value(problem, moved(at, basis, s * h * delta, d))[0] for s in (1, -1))
    assert quadratic == pytest.approx((ahead + behind - 2 * cost) / (2 * h * h), rel=1e-4)


def test_small_noise_is_certified_and_the_bound_holds(graph: PoseGraph) -> None:
    found = certify(graph)
    assert found.status is CertificateStatus.CERTIFIED
    assert found.lower_bound <= found.chordal_cost
    assert found.gap < 1e-6
    rng = np.random.default_rng(0)
    for scale in (1e-3, 0.1, 1.0):
        other = graph.group.retract(found.poses, scale * rng.normal(size=(len(graph), graph.group.dof)))
        assert value(chordal_problem(graph), lifted_poses(other))[0] > found.lower_bound


def test_smallest_eigenvalue_is_that_of_the_dense_matrix(graph_maker) -> None:
    graph = graph_maker(SE3, nodes=12, loops=8)
    found = certify(graph)
    problem = chordal_problem(graph)
    at = lifted_poses(found.poses)
    S = np.array(dense(problem))
    for k, L in enumerate(multipliers(at, value(problem, at)[1])):
        S[4 * k : 4 * k + 3, 4 * k : 4 * k + 3] -= L
    turns = np.arange(len(S)) % 4 < 3
    schur = S[np.ix_(turns, turns)] - S[np.ix_(turns, ~turns)] @ np.linalg.pinv(S[np.ix_(~turns, ~turns)]) @ S[
        np.ix_(~turns, turns)]  # fmt: skip
    least = np.linalg.eigvalsh(schur)[0]
    assert found.smallest_eigenvalue == pytest.approx(least, abs=1e-6 * np.abs(schur).max())


@pytest.mark.parametrize("climb", [False, True])
def test_a_wound_ring_is_recognised_and_unwound(monkeypatch: pytest.MonkeyPatch, climb: bool) -> None:
    if climb:  # without the relaxation the way out leads over a higher rank
        monkeypatch.setattr("posegraph_slam.pose_graph.certificate._from_relaxation", lambda *_: None)
    optimum = find_optimum(ring(12), OptimumSettings(start=Start.GIVEN))
    assert optimum.certificate is not None
    assert optimum.certificate.status is CertificateStatus.SUBOPTIMAL
    assert optimum.certificate.holds
    assert optimum.error == pytest.approx(0.0, abs=1e-9)
    assert optimum.error_initial > 0.5


def test_two_fixed_nodes_are_not_certified(graph: PoseGraph) -> None:
    held = PoseGraph(poses=graph.poses, session=graph.session, index=graph.index, fixed=graph.index < 2,
                     constraints=graph.constraints)  # fmt: skip
    found = certify(held)
    assert found.status is CertificateStatus.UNKNOWN
    assert "fixed" in found.reason
    assert not found.holds


@pytest.mark.data
@pytest.mark.parametrize("name", CHORDAL)
def test_reference_graphs_are_certified(psg_data: Path, name: str) -> None:
    optimum = find_optimum(read_graph(psg_data / "g2o" / f"{name}.g2o"))
    assert optimum.certificate is not None
    assert optimum.certificate.status is CertificateStatus.CERTIFIED
    assert optimum.certificate.holds
    assert optimum.certificate.chordal_cost == pytest.approx(CHORDAL[name], rel=1e-4)
    assert 0 <= optimum.certificate.gap <= 1e-6
