"""Chi-square, normal equations and steps of a pose graph, in the plane and in space, on compiled loops over edges.

The same formulas as in `residuals`, which works on whole arrays and is what the tests compare with.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.graph import Constraints
from posegraph_slam.pose_graph.planar_edges import planar_chi2, planar_equations, planar_moves, planar_residuals
from posegraph_slam.pose_graph.spatial_edges import spatial_chi2, spatial_equations, spatial_moves, spatial_residuals


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NormalEquations:
    """Gradient (N, p), diagonal blocks (N, p, p) and blocks (i, j) (E, p, p) of the Gauss-Newton Hessian."""

    gradient: FloatArray
    diagonal: FloatArray
    off_diagonal: FloatArray


def residuals_at(poses: FloatArray, constraints: Constraints) -> FloatArray:
    """Return the residuals (E, p) of constraints at poses (N, d+1, d+1)."""
    c = constraints
    run = planar_residuals if poses.shape[-1] == 3 else spatial_residuals
    residuals = np.empty(c.information.shape[:2])
    run(_writable(poses), c.i, c.j, c.T_i_j, residuals)
    return residuals


def chi2_at(poses: FloatArray, constraints: Constraints) -> FloatArray:
    """Return the squared Mahalanobis length (E,) of the error of constraints at poses (N, d+1, d+1)."""
    c = constraints
    run = planar_chi2 if poses.shape[-1] == 3 else spatial_chi2
    result = np.empty(len(c))
    run(_writable(poses), c.i, c.j, c.T_i_j, c.information, result)
    return result


def normal_equations(poses: FloatArray, constraints: Constraints, weights: FloatArray) -> NormalEquations:
    """Sum up the normal equations at poses (N, d+1, d+1) with `weights` (E,) on the information of constraints."""
    c, p = constraints, constraints.information.shape[-1]
    run = planar_equations if poses.shape[-1] == 3 else spatial_equations
    gradient, diagonal = np.zeros((len(poses), p)), np.zeros((len(poses), p, p))
    off = np.empty(c.information.shape)
    run(_writable(poses), c.i, c.j, c.T_i_j, c.information, weights, gradient, diagonal, off)
    return NormalEquations(gradient=gradient, diagonal=diagonal, off_diagonal=off)


def moved_poses(poses: FloatArray, delta: FloatArray) -> FloatArray:
    """Return poses (N, d+1, d+1) updated on the right by exp(delta), delta (N, p); where it is zero, to the bit."""
    result = np.array(poses)
    run = planar_moves if poses.shape[-1] == 3 else spatial_moves
    run(result, delta)
    return result


@kernel
def block_decrease(gradient: FloatArray, diagonal: FloatArray, kept: BoolArray) -> float:
    """Return 1/2 sum g^T H^-1 g over the kept nodes with H their own blocks: what moving each alone would save."""
    p, total = gradient.shape[1], 0.0
    L, x = np.empty((p, p)), np.empty(p)
    for node in range(len(gradient)):
        if not kept[node]:
            continue
        H, trace = diagonal[node], 0.0
        for a in range(p):
            trace += H[a, a]
        for a in range(p):
            for b in range(a + 1):
                value = H[a, b]
                for k in range(b):
                    value -= L[a, k] * L[b, k]
                L[a, b] = value / L[b, b] if a > b else np.sqrt(max(value, 1e-12 * trace + 1e-300))
            x[a] = gradient[node, a]
            for k in range(a):
                x[a] -= L[a, k] * x[k]
            x[a] /= L[a, a]
            total += 0.5 * x[a] * x[a]
    return total


def _writable(poses: FloatArray) -> FloatArray:
    """Return a copy of read-only poses: numba would compile every kernel a second time for them."""
    return poses if poses.flags.writeable else np.array(poses)
