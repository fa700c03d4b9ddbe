"""The chordal cost of SE-Sync and its derivatives at any rank, edge by edge in numba.

F = sum k |R_j - R_i R_ij|^2 + t |t_j - t_i - R_i t_ij|^2 (Rosen et al. 2019) is quadratic in X_i = [R_i t_i]: with T
the measurement and W = diag(k, ..., k, t) it is tr(X M X^T), where M has -T W at (i, j), and sums W at j and T W T^T
at i. At rank r the R_i are r x d with orthonormal columns: the first d columns of an orthogonal Q_i. Tangents are Q_i A
with A r x (d+1): a skew part and free rows below it for the rotation, a column for the translation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ChordalProblem:
    """Edges i, j (E,), measurements (E, d+1, d+1), weights W (E, d+1) and the blocks of M: (n, ...) and (E, ...)."""

    i: IntArray
    j: IntArray
    T_i_j: FloatArray
    weights: FloatArray
    diagonal: FloatArray
    off_diagonal: FloatArray

    @property
    def dimension(self) -> int:
        """The dimension d of space."""
        return int(self.T_i_j.shape[-1]) - 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lifted:
    """Poses at rank r: orthogonal Q (n, r, r), whose first d columns count, and translations (n, r)."""

    Q: FloatArray
    t: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tangents:
    """Basis of the tangent at a node: direction a is sign0 at (row0, column0) and sign1 at (row1, column1) of A."""

    row: IntArray
    column: IntArray
    sign: FloatArray


def chordal_weights(constraints: Constraints) -> FloatArray:
    """Return W (E, d+1) = [k ... k, t], the isotropic weights that SE-Sync takes from full information."""
    p = constraints.information.shape[-1]
    d = 2 if p == 3 else 3
    turn, shift = (slice(2, 3), slice(0, 2)) if d == 2 else (slice(0, 3), slice(3, 6))
    tau = d / np.trace(np.linalg.inv(constraints.information[:, shift, shift]), axis1=1, axis2=2)
    spread = np.trace(np.linalg.inv(constraints.information[:, turn, turn]), axis1=1, axis2=2)
    kappa = 1.0 / spread if d == 2 else 1.5 / spread
    return np.concatenate([np.repeat(kappa[:, None], d, axis=1), tau[:, None]], axis=1)


def chordal_problem(graph: PoseGraph) -> ChordalProblem:
    """Build the quadratic form of a graph."""
    c, weights = graph.constraints, chordal_weights(graph.constraints)
    off = -c.T_i_j * weights[:, None, :]
    at_i = -off @ np.swapaxes(c.T_i_j, 1, 2)
    at_j = weights[:, :, None] * np.eye(weights.shape[1])
    diagonal = np.zeros((len(graph), *off.shape[1:]))
    np.add.at(diagonal, c.i, at_i)
    np.add.at(diagonal, c.j, at_j)
    return ChordalProblem(
        i=np.array(c.i), j=np.array(c.j), T_i_j=np.array(c.T_i_j), weights=weights, diagonal=diagonal, off_diagonal=off
    )


def lifted_poses(poses: FloatArray) -> Lifted:
    """Return poses (n, d+1, d+1) at rank d."""
    d = poses.shape[-1] - 1
    return Lifted(Q=np.array(poses[:, :d, :d]), t=np.array(poses[:, :d, d]))


def tangents(dimension: int, rank: int) -> Tangents:
    """Return the basis: skew parts, rows beyond d, the translation."""
    skew = [((k, m, 1.0), (m, k, -1.0)) for m in range(dimension) for k in range(m)]
    free = [((k, m, 1.0), (k, m, 0.0)) for k in range(dimension, rank) for m in range(dimension)]
    shift = [((k, dimension, 1.0), (k, dimension, 0.0)) for k in range(rank)]
    table = np.array(skew + free + shift)
    return Tangents(row=table[..., 0].astype(np.int64), column=table[..., 1].astype(np.int64),
                    sign=np.ascontiguousarray(table[..., 2]))  # fmt: skip


def moved(at: Lifted, basis: Tangents, delta: FloatArray, dimension: int) -> Lifted:
    """Move by tangents `delta` (n, p): Cayley's transform on the rotations."""
    n, r = at.t.shape
    A = np.zeros((n, r, max(r, dimension + 1)))
    for k in range(2):
        A[:, basis.row[:, k], basis.column[:, k]] += basis.sign[:, k] * delta  # no place repeats within one k
    Z = np.zeros((n, r, r))
    Z[:, :, :dimension] = A[:, :, :dimension]
    Z[:, :dimension, dimension:] = -np.swapaxes(Z[:, dimension:, :dimension], 1, 2)
    one = np.eye(r)
    Q = at.Q @ np.linalg.solve(one - 0.5 * Z, one + 0.5 * Z)
    return Lifted(Q=Q, t=at.t + (at.Q @ A[:, :, dimension, None])[..., 0])


def value(problem: ChordalProblem, at: Lifted) -> tuple[float, FloatArray]:
    """Return F and half its derivative X M (n, r, d+1)."""
    d = problem.dimension
    X = np.concatenate([at.Q[:, :, :d], at.t[..., None]], axis=2)
    G = np.zeros_like(X)
    return _value(X, problem.i, problem.j, problem.T_i_j, problem.weights, G), G


def multipliers(at: Lifted, G: FloatArray) -> FloatArray:
    """Return the symmetric multipliers (n, d, d) of the orthonormality of each rotation."""
    d = G.shape[2] - 1
    product = np.swapaxes(at.Q[:, :, :d], 1, 2) @ G[:, :, :d]
    return np.asarray(0.5 * (product + np.swapaxes(product, 1, 2)))


def certificate_diagonal(problem: ChordalProblem, multiplier: FloatArray) -> FloatArray:
    """Return the diagonal blocks (n, d+1, d+1) of S = M - diag(multipliers, 0)."""
    d = problem.dimension
    diagonal = np.array(problem.diagonal)
    diagonal[:, :d, :d] -= multiplier
    return diagonal


@kernel
def _value(X: FloatArray, i: IntArray, j: IntArray, T: FloatArray, W: FloatArray, G: FloatArray) -> float:
    rank, size = X.shape[1], X.shape[2]
    total = 0.0
    pull = np.empty(size)
    for e in range(len(i)):
        a, b = i[e], j[e]
        part = 0.0
        for u in range(rank):
            for v in range(size):
                error = X[b, u, v]
                for w in range(size):
                    error -= X[a, u, w] * T[e, w, v]
                pull[v] = error * W[e, v]
                part += error * pull[v]
                G[b, u, v] += pull[v]
            for v in range(size):
                back = 0.0
                for w in range(size):
                    back += pull[w] * T[e, v, w]
                G[a, u, v] -= back
        total += part
    return total


@kernel
def tangent_gradient(Q: FloatArray, G: FloatArray, row: IntArray, column: IntArray, sign: FloatArray) -> FloatArray:
    """Return the derivative (n, p) along the basis."""
    count, rank, p = len(Q), Q.shape[1], len(row)
    result = np.zeros((count, p))
    for node in range(count):
        for a in range(p):
            for k in range(2):
                inner = 0.0
                for u in range(rank):
                    inner += Q[node, u, row[a, k]] * G[node, u, column[a, k]]
                result[node, a] += sign[a, k] * inner
    return result


@kernel
def tangent_hessian(Q: FloatArray, i: IntArray, j: IntArray, S_diagonal: FloatArray, S_off: FloatArray, row: IntArray,
                    column: IntArray, sign: FloatArray) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return diagonal (n, p, p) and off-diagonal blocks (E, p, p) of V -> tr(V S V^T) in the basis."""
    count, rank, p, edges = len(Q), Q.shape[1], len(row), len(i)
    diagonal, off = np.zeros((count, p, p)), np.zeros((edges, p, p))
    turn = np.empty((rank, rank))
    for node in range(count):
        for a in range(p):
            for b in range(p):
                for k in range(2):
                    for m in range(2):
                        if row[a, k] == row[b, m]:
                            diagonal[node, a, b] += (
                                sign[a, k] * sign[b, m] * S_diagonal[node, column[a, k], column[b, m]]
                            )
    for e in range(edges):
        for u in range(rank):
            for v in range(rank):
                turn[u, v] = 0.0
                for w in range(rank):
                    turn[u, v] += Q[i[e], w, u] * Q[j[e], w, v]
        for a in range(p):
            for b in range(p):
                for k in range(2):
                    for m in range(2):
                        off[e, a, b] += (
                            sign[a, k] * sign[b, m] * turn[row[a, k], row[b, m]] * S_off[e, column[a, k], column[b, m]]
                        )
    return diagonal, off
