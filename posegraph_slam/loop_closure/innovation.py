"""How surprising a closure is to the graph, and what the closures say of a systematic drift.

The chain of scan matches errs in two ways: at random from step to step, and systematically, by a heading bias per metre
and by a share of every turn (a sweep that is skewed by the motion, a beam spacing that is a little off). The two
systematic rates are unknowns beside the poses, so that a closure a hundred metres on is neither taken for granted nor
refused for a drift that all steps share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.geometry import SE2
from posegraph_slam.loop_closure.settings import DriftSettings
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph
from posegraph_slam.pose_graph.marginals import Marginals, factored_marginals
from posegraph_slam.pose_graph.residuals import constraint_jacobians
from posegraph_slam.registration.beam_information import inverse

RATES = 2
"""Systematic unknowns: heading per metre of travel, heading per radian of turn."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearGraph:
    """A graph linearised at its poses, factorised, with the rates of systematic drift beside the poses.

    `rates` (2,) are the most likely heading bias (rad/m) and turn scale of the chain, `rates_covariance` (2, 2) theirs;
    `shift` (N, 3, 2) says how far each pose moves with the rates.
    """

    graph: PoseGraph
    marginals: Marginals
    shift: FloatArray
    rates: FloatArray
    rates_covariance: FloatArray

    def relative_covariance(self, i: IntArray, j: IntArray) -> FloatArray:
        """Covariance (M, 3, 3) of the motion from node i (M,) to node j (M,), in the tangent of its right update.

        That of the poses given the rates, plus what the uncertain rates add to it (bordered system).
        """
        group, poses = self.graph.group, self.graph.poses
        by_i = -group.adjoint(group.between(poses[j], poses[i]))
        moved = by_i @ self.shift[i] + self.shift[j]
        shared = moved @ self.rates_covariance @ np.swapaxes(moved, 1, 2)
        return np.asarray(self.marginals.relative(i, j) + shared)


def linearise(graph: PoseGraph, settings: DriftSettings) -> LinearGraph:
    """Factorise the information of a connected SE(2) graph with fixed nodes, at its poses.

    With the system [[A, B], [B^T, C]] over poses and rates, the rates have information C - B^T A^-1 B, and the poses
    move by -A^-1 B with them.
    """
    c, count = graph.constraints, len(graph)
    residuals, by_i, by_j = constraint_jacobians(graph)
    chain = np.flatnonzero(~c.is_loop)
    by_rate = np.zeros((len(c), 3, RATES))
    by_rate[chain, 2] = -_exposure(c.select(chain))
    border, gradient = np.zeros((count, 3, RATES)), np.zeros((count, 3))
    for rows, jacobian in ((c.i, by_i), (c.j, by_j)):
        weighted = np.swapaxes(jacobian, 1, 2) @ c.information
        np.add.at(border, rows, weighted @ by_rate)
        np.add.at(gradient, rows, (weighted @ residuals[..., None])[..., 0])
    weighted = np.swapaxes(by_rate, 1, 2) @ c.information
    corner = np.sum(weighted @ by_rate, axis=0) + np.diag(_prior(settings))
    corner_gradient = np.sum(weighted @ residuals[..., None], axis=0)[:, 0]
    solved = _solve_poses(graph, by_i, by_j, np.concatenate([border, gradient[..., None]], axis=2))
    shift = -solved[..., :RATES]
    information = corner + np.einsum("npr,nps->rs", border, shift)
    covariance = np.linalg.inv(0.5 * (information + information.T))
    left = corner_gradient + np.einsum("npr,np->r", shift, gradient)
    return LinearGraph(
        graph=graph,
        marginals=factored_marginals(graph),
        shift=shift,
        rates=-covariance @ left,
        rates_covariance=covariance,
    )


def _solve_poses(graph: PoseGraph, by_i: FloatArray, by_j: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations of the poses for right sides (N, 3, k); fixed nodes stay."""
    c, count = graph.constraints, len(graph)
    parts = ((by_i, 3 * c.i), (by_j, 3 * c.j))
    rows, columns, values = [], [], []
    for left, left_at in parts:
        weighted = np.swapaxes(left, 1, 2) @ c.information
        for other, other_at in parts:
            block = weighted @ other
            rows.append(np.broadcast_to((left_at[:, None] + np.arange(3))[:, :, None], block.shape).ravel())
            columns.append(np.broadcast_to((other_at[:, None] + np.arange(3))[:, None, :], block.shape).ravel())
            values.append(block.ravel())
    free = np.flatnonzero(np.repeat(~graph.fixed, 3))
    size = 3 * count
    system = coo_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(size, size)
    ).tocsc()[free][:, free]
    result = np.zeros((size, right.shape[2]))
    if len(free):
        factor = splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        result[free] = factor.solve(right.reshape(size, -1)[free])
    return result.reshape(count, 3, -1)


def innovation(linear: LinearGraph, constraints: Constraints, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis distance (M,) between constraints and what the graph says of the same motions.

    `covariance` (M, 3, 3) is the graph's, of `relative_covariance`; that of the constraints is added.
    """
    poses, group = linear.graph.poses, linear.graph.group
    predicted = group.between(poses[constraints.i], poses[constraints.j])
    error = group.local(predicted, constraints.T_i_j)
    weight = inverse(covariance + inverse(constraints.information))
    return np.asarray(np.einsum("ep,epq,eq->e", error, weight, error))


def _exposure(chain: Constraints) -> FloatArray:
    """Metres and radians (E, 2) of each step, by which the rates turn it."""
    step = SE2.log(chain.T_i_j)
    return np.stack([np.hypot(step[:, 0], step[:, 1]), step[:, 2]], axis=1)


def _prior(settings: DriftSettings) -> FloatArray:
    return np.array([settings.heading_sigma_rad_per_m, settings.turn_scale_sigma]) ** -2.0
