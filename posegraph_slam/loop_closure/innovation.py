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
from scipy.sparse.linalg import SuperLU, splu

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.geometry import SE2
from posegraph_slam.loop_closure.settings import DriftSettings
from posegraph_slam.pose_graph.graph import Constraints, PoseGraph
from posegraph_slam.pose_graph.residuals import constraint_jacobians
from posegraph_slam.registration.beam_information import inverse

RATES = 2
"""Systematic unknowns: heading per metre of travel, heading per radian of turn."""
AT_ONCE = 64
"""Pairs whose covariances are computed in one solve, to bound the memory."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearGraph:
    """A graph linearised at its poses, factorised, with the rates of systematic drift beside the poses.

    `rates` (2,) are the most likely heading bias (rad/m) and turn scale of the chain, and `covariance` theirs.
    """

    graph: PoseGraph
    factor: SuperLU
    rates: FloatArray
    rates_covariance: FloatArray

    def relative_covariance(self, i: IntArray, j: IntArray) -> FloatArray:
        """Covariance (M, 3, 3) of the motion from node i (M,) to node j (M,), in the tangent of its right update."""
        group, poses = self.graph.group, self.graph.poses
        by_i = -group.adjoint(group.between(poses[j], poses[i]))
        size = 3 * len(self.graph) + RATES
        result = np.zeros((len(i), 3, 3))
        for start in range(0, len(i), AT_ONCE):
            rows = np.arange(start, min(start + AT_ONCE, len(i)))
            pair = np.arange(len(rows))[:, None]
            at_i, at_j = 3 * i[rows, None] + np.arange(3), 3 * j[rows, None] + np.arange(3)
            columns = np.zeros((size, len(rows), 3))
            columns[at_i, pair] = np.swapaxes(by_i[rows], 1, 2)
            columns[at_j, pair] = np.eye(3)
            solved = self.factor.solve(columns.reshape(size, -1)).reshape(size, len(rows), 3)
            result[rows] = by_i[rows] @ solved[at_i, pair] + solved[at_j, pair]
        return 0.5 * (result + np.swapaxes(result, 1, 2))


def linearise(graph: PoseGraph, settings: DriftSettings) -> LinearGraph:
    """Factorise the information of a connected SE(2) graph with fixed nodes, at its poses."""
    c, count = graph.constraints, len(graph)
    residuals, by_i, by_j = constraint_jacobians(graph)
    chain = np.flatnonzero(~c.is_loop)
    by_rate = np.zeros((len(c), 3, RATES))
    by_rate[chain, 2] = -_exposure(c.select(chain))
    blocks = ((by_i, 3 * c.i, 3), (by_j, 3 * c.j, 3), (by_rate, np.full(len(c), 3 * count), RATES))
    rows, columns, values = [], [], []
    gradient = np.zeros(3 * count + RATES)
    for left, left_at, left_size in blocks:
        weighted = np.swapaxes(left, 1, 2) @ c.information
        at = left_at[:, None] + np.arange(left_size)
        np.add.at(gradient, at, (weighted @ residuals[..., None])[..., 0])
        for right, right_at, right_size in blocks:
            block = weighted @ right
            shape = (len(c), left_size, right_size)
            rows.append(np.broadcast_to(at[:, :, None], shape).ravel())
            to = right_at[:, None] + np.arange(right_size)
            columns.append(np.broadcast_to(to[:, None, :], shape).ravel())
            values.append(block.ravel())
    held = np.concatenate([np.repeat(np.where(graph.fixed, 1e12, 1e-9), 3), _prior(settings)])
    diagonal = np.arange(3 * count + RATES)
    system = coo_array(
        (np.concatenate([*values, held]), (np.concatenate([*rows, diagonal]), np.concatenate([*columns, diagonal]))),
        shape=(3 * count + RATES,) * 2,
    ).tocsc()
    factor = splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    unit = np.zeros((3 * count + RATES, RATES))
    unit[-RATES:] = np.eye(RATES)
    return LinearGraph(
        graph=graph,
        factor=factor,
        rates=-factor.solve(gradient)[-RATES:],
        rates_covariance=factor.solve(unit)[-RATES:],
    )


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
