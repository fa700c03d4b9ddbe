"""Residuals, chi-square and Jacobians of the constraints of a pose graph, on whole arrays.

The error of a constraint is r = log(T_i_j^-1 T_i^-1 T_j), the full logarithm of SE(2) or SE(3), as in GTSAM 4.3's
BetweenFactor; chi-square is r^T information r. With updates on the right, T exp(d), its derivatives are
dr/dj = Jr^-1(r) and dr/di = -Jr^-1(r) Ad((T_i^-1 T_j)^-1) (Sola et al. 2018, section IV).
"""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.pose_graph.graph import PoseGraph


def constraint_residuals(graph: PoseGraph) -> FloatArray:
    """Return the tangent error (E, p) of every constraint at the graph's poses, in GTSAM's order (m, rad)."""
    c, group = graph.constraints, graph.group
    return group.local(c.T_i_j, group.between(graph.poses[c.i], graph.poses[c.j]))


def chi2_of_residuals(residuals: FloatArray, information: FloatArray) -> FloatArray:
    """Return r^T information r (E,) for residuals (E, p) and information (E, p, p)."""
    return np.asarray(np.einsum("ep,epq,eq->e", residuals, information, residuals))


def chi2(graph: PoseGraph) -> FloatArray:
    """Return the squared Mahalanobis length (E,) of every constraint's error at the graph's poses."""
    return chi2_of_residuals(constraint_residuals(graph), graph.constraints.information)


def constraint_jacobians(graph: PoseGraph) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (E, p) and their derivatives (E, p, p) by the right update of node i and of node j."""
    c, group = graph.constraints, graph.group
    T_ij_now = group.between(graph.poses[c.i], graph.poses[c.j])
    residuals = group.local(c.T_i_j, T_ij_now)
    by_j = np.asarray(np.linalg.inv(group.right_jacobian(residuals)), dtype=np.float64)
    by_i = np.negative(by_j @ group.adjoint(group.inverse(T_ij_now)))
    return residuals, by_i, by_j
