"""Proof that a solution is the best there is, on the chordal cost, and the way out where it is not.

A critical point X of F = tr(X M X^T) with multipliers L is a global minimum if S = M - L is positive semidefinite; for
any L whatsoever F >= tr L + n d min(0, smallest eigenvalue of S with translations eliminated) (Rosen et al. 2019). That
S + e I has a Cholesky factor proves the eigenvalue above -e. Where it has none, the eigenvector leads downhill at
one rank more (the Riemannian staircase, Boumal 2015); the optimum found there is rounded back.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

from posegraph_slam.arrays import BoolArray, FloatArray
from posegraph_slam.errors import GraphError
from posegraph_slam.execution import silent_progress
from posegraph_slam.geometry import pose_from_rotation_translation
from posegraph_slam.pose_graph.block_cholesky import factorize
from posegraph_slam.pose_graph.block_pattern import BlockPattern, block_pattern
from posegraph_slam.pose_graph.block_substitution import solve_factored
from posegraph_slam.pose_graph.checks import component_labels
from posegraph_slam.pose_graph.chordal import chordal_poses
from posegraph_slam.pose_graph.chordal_cost import (
    ChordalProblem,
    Lifted,
    certificate_diagonal,
    chordal_problem,
    lifted_poses,
    moved,
    multipliers,
    tangents,
    value,
)
from posegraph_slam.pose_graph.chordal_descent import Budget, minimize_chordal
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.solver_settings import SolverSettings
from posegraph_slam.pose_graph.sparse_solver import run_sparse

GAP_TOLERANCE = 1e-6
"""Largest relative gap between cost and lower bound that is called certified."""
PROOF_SHIFTS = (1e-10, 1e-9, 1e-8, 1e-7, 1e-6)
"""Shifts of S tried in turn, as the share of the cost that each takes from the lower bound."""
COST_FLOOR = 1e-9
"""Gap, as a cost, that counts as none in graphs that fit perfectly."""
CLIMB_WORK = 1e11
"""Multiplications (some five seconds of them) that may be spent on higher ranks: without a limit, large graphs whose
relaxation is not tight would take minutes."""
EXTRA_RANKS = 3


class CertificateStatus(StrEnum):
    """What is known of a solution."""

    CERTIFIED = "certified"
    """It lies in the basin of a proven optimum of the chordal cost."""
    SUBOPTIMAL = "suboptimal"
    """The solution found first was not the best: the one returned was reached from the proven optimum."""
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Certificate:
    """Chordal cost F of the poses (n, d+1, d+1), a lower bound of F over all poses, and what they prove.

    `poses` minimise F; `smallest_eigenvalue` is that of S with translations eliminated; `rank` is 0 where nothing was
    tried.
    """

    status: CertificateStatus
    chordal_cost: float
    lower_bound: float
    smallest_eigenvalue: float
    rank: int
    poses: FloatArray
    reason: str = ""

    @property
    def gap(self) -> float:
        """The relative gap (F - bound) / F."""
        return (self.chordal_cost - self.lower_bound) / max(self.chordal_cost, COST_FLOOR)

    @property
    def holds(self) -> bool:
        """Whether the solution that this certificate came with is the one that the proof leads to."""
        return self.rank > 0 and self.proven and self.status is not CertificateStatus.UNKNOWN

    @property
    def proven(self) -> bool:
        """Whether the chordal cost is proven to be the least."""
        return self.chordal_cost - self.lower_bound <= GAP_TOLERANCE * self.chordal_cost + COST_FLOOR


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Verdict:
    """Lower bound and smallest eigenvalue from S, with its eigenvector (n, d+1) where it is negative."""

    lower_bound: float
    eigenvalue: float
    direction: FloatArray | None


def certify(graph: PoseGraph, *, from_relaxation: bool = False) -> Certificate:
    """Minimise the chordal cost from a graph's poses and prove the minimum global, climbing ranks where it is not.

    `from_relaxation` says that the poses were reached from the chordal relaxation, which then is not tried again.

    The status is `CERTIFIED` if the minimum nearest to the poses is proven, `SUBOPTIMAL` if a better one is (its
    poses are in the answer), `UNKNOWN` with a reason otherwise. The gauge is that of the fixed nodes, one a part.
    """
    if (reason := _unfit(graph)) is not None:
        cost = value(chordal_problem(graph), lifted_poses(graph.poses))[0]
        return Certificate(status=CertificateStatus.UNKNOWN, chordal_cost=cost, lower_bound=0.0,
                           smallest_eigenvalue=float("nan"), rank=0, poses=graph.poses, reason=reason)  # fmt: skip
    problem, anchors = chordal_problem(graph), graph.fixed
    at, cost = minimize_chordal(problem, lifted_poses(graph.poses), anchors)
    pattern = block_pattern(len(graph), problem.i, problem.j, problem.dimension + 1)
    verdict = _verdict(problem, pattern, at, anchors)
    first = _certificate(problem, at, cost, verdict)
    if first.proven or verdict.direction is None:
        return first
    other = None if from_relaxation else _from_relaxation(graph, problem, pattern)
    if other is not None and other.proven:
        return with_status(other, CertificateStatus.SUBOPTIMAL, "a better basin was found")
    return _climb(problem, pattern, at, anchors, verdict, first)


def _from_relaxation(graph: PoseGraph, problem: ChordalProblem, pattern: BlockPattern) -> Certificate | None:
    """Try the minimum next to the linear relaxation of rotations: nearly always the right one, and much cheaper."""
    try:
        start = graph.with_poses(chordal_poses(graph))
    except GraphError:
        return None
    # The full cost first: Gauss-Newton steps find the basin that exact Newton steps wander about.
    begin = lifted_poses(run_sparse(start, SolverSettings(relative_tolerance=1e-6), silent_progress).poses)
    at, cost = minimize_chordal(problem, begin, graph.fixed)
    return _certificate(problem, at, cost, _verdict(problem, pattern, at, graph.fixed))


def _certificate(problem: ChordalProblem, at: Lifted, cost: float, verdict: _Verdict) -> Certificate:
    d = problem.dimension
    found = Certificate(
        status=CertificateStatus.CERTIFIED, chordal_cost=cost, lower_bound=min(verdict.lower_bound, cost),
        smallest_eigenvalue=verdict.eigenvalue, rank=at.Q.shape[1],
        poses=pose_from_rotation_translation(at.Q[:, :d, :d], at.t[:, :d]))  # fmt: skip
    if found.proven:
        return found
    return with_status(found, CertificateStatus.UNKNOWN, f"a gap of {found.gap:.2g} remains")


def with_status(found: Certificate, status: CertificateStatus, reason: str) -> Certificate:
    """Return a certificate with another status and reason."""
    return Certificate(status=status, chordal_cost=found.chordal_cost, lower_bound=found.lower_bound,
                       smallest_eigenvalue=found.smallest_eigenvalue, rank=found.rank, poses=found.poses,
                       reason=reason)  # fmt: skip


def _climb(problem: ChordalProblem, pattern: BlockPattern, at: Lifted, anchors: BoolArray, verdict: _Verdict,
           first: Certificate) -> Certificate:  # fmt: skip
    """Descend at higher and higher rank until S is positive semidefinite, then round back to poses."""
    budget = Budget(CLIMB_WORK)
    for _ in range(EXTRA_RANKS):
        if verdict.direction is None or budget.left <= 0:
            break
        at = _escape(problem, at, verdict.direction)
        at, _ = minimize_chordal(problem, at, anchors, budget=budget)
        verdict = _verdict(problem, pattern, at, anchors)
    begin = _rounded(problem, at, first.poses, anchors)
    rounded, cost = minimize_chordal(problem, begin, anchors, budget=budget)
    better = _certificate(problem, rounded, cost, verdict)
    found = better if cost < first.chordal_cost * (1 - 1e-9) else _certificate(
        problem, lifted_poses(first.poses), first.chordal_cost, verdict)  # fmt: skip
    if found.proven and found is better:
        return with_status(found, CertificateStatus.SUBOPTIMAL, "a better basin was found")
    if found.proven:
        return with_status(found, CertificateStatus.CERTIFIED, "")
    reason = f"the relaxation is not tight: a gap of {found.gap:.2g} remains at rank {at.Q.shape[1]}"
    return with_status(found, CertificateStatus.UNKNOWN, reason)


def _unfit(graph: PoseGraph) -> str | None:
    labels = component_labels(graph)
    if np.any(np.bincount(labels, weights=graph.fixed) > 1):
        return "more than one node of a part is fixed"
    if len(graph.constraints) == 0:
        return "the graph has no constraints"
    return None


def _verdict(problem: ChordalProblem, pattern: BlockPattern, at: Lifted, anchors: BoolArray) -> _Verdict:
    """Bound the smallest eigenvalue of S by Cholesky, and find it by Lanczos on the factor."""
    d = problem.dimension
    cost, G = value(problem, at)
    multiplier = multipliers(at, G)
    S = certificate_diagonal(problem, multiplier)
    S[anchors, d, d] += 1.0 * np.max(problem.weights[:, d])  # a translation of all costs nothing: hold one node
    total, count = float(np.trace(multiplier, axis1=1, axis2=2).sum()), d * len(S)
    rounding = 1e-15 * float(np.max(np.abs(S)))
    shifts = [max(cost, COST_FLOOR) * share / count for share in PROOF_SHIFTS]
    shifts += [shifts[-1] * 10.0**k for k in range(1, 16)]
    for shift in shifts:
        shifted = np.array(S)
        shifted[:, np.arange(d), np.arange(d)] += shift
        factor = factorize(pattern, shifted, problem.off_diagonal, 0.0)
        if factor is not None:
            break
    else:
        return _Verdict(lower_bound=0.0, eigenvalue=float("nan"), direction=None)
    eigenvalue, vector = _smallest(pattern, factor, shift, len(S), d)
    bound = total - count * (shift + rounding)
    proven = shift <= shifts[len(PROOF_SHIFTS) - 1]
    return _Verdict(lower_bound=max(bound, 0.0), eigenvalue=eigenvalue, direction=None if proven else vector)


def _smallest(pattern: BlockPattern, factor: FloatArray, shift: float, n: int, d: int) -> tuple[float, FloatArray]:
    """Return the smallest eigenvalue of S with translations eliminated, and the vector (n, d+1), by inverse Lanczos."""

    def inverse(x: FloatArray) -> FloatArray:
        right = np.zeros((n, d + 1))
        right[:, :d] = x.reshape(n, d)
        return solve_factored(pattern, factor, right)

    operator = LinearOperator((n * d, n * d), matvec=lambda x: inverse(x)[:, :d].ravel(), dtype=np.float64)
    rng = np.random.default_rng(0)
    begin = rng.normal(size=n * d)
    values, vectors = eigsh(operator, k=1, which="LM", v0=begin, tol=1e-6)
    full = inverse(vectors[:, 0])
    return float(1.0 / values[0] - shift), full / np.max(np.abs(full[:, :d]))


def _escape(problem: ChordalProblem, at: Lifted, direction: FloatArray) -> Lifted:
    """Add a rank and step along the direction of negative curvature, as far as the cost falls."""
    n, r = at.t.shape
    d = problem.dimension
    Q = np.zeros((n, r + 1, r + 1))
    Q[:, :r, :r], Q[:, r, r] = at.Q, 1.0
    raised = Lifted(Q=Q, t=np.concatenate([at.t, np.zeros((n, 1))], axis=1))
    basis = tangents(d, r + 1)
    delta = np.zeros((n, len(basis.row)))
    new = np.flatnonzero((basis.row[:, 0] == r) & (basis.column[:, 0] < d))
    delta[:, new] = direction[:, :d]
    delta[:, -1] = direction[:, d]
    trials = [moved(raised, basis, length * delta, d) for length in 0.5 ** np.arange(0.0, 12.0)]
    costs = [value(problem, trial)[0] for trial in trials]
    return trials[int(np.argmin(costs))]


def _rounded(problem: ChordalProblem, at: Lifted, poses: FloatArray, anchors: BoolArray) -> Lifted:
    """Project lifted poses to rank d, with the anchors of `poses` (n, d+1, d+1)."""
    d = problem.dimension
    Y = at.Q[:, :, :d]
    U = np.linalg.svd(np.concatenate(list(Y), axis=1), full_matrices=False)[0][:, :d]
    flat = U.T @ Y
    if np.mean(np.linalg.det(flat) < 0) > 0.5:
        U[:, -1] *= -1
        flat = U.T @ Y
    W, _, Vt = np.linalg.svd(flat)
    W[:, :, -1] *= np.linalg.det(W @ Vt)[:, None]
    R, t = W @ Vt, at.t @ U
    node = int(np.argmax(anchors))
    turn = poses[node, :d, :d] @ R[node].T
    shift = poses[node, :d, d] - turn @ t[node]
    return Lifted(Q=turn @ R, t=t @ turn.T + shift)
