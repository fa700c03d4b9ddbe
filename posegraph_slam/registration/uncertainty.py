"""Information and free directions of a registration from the Jacobian of its residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.geometry import SE2, SE3
from posegraph_slam.jit import kernel
from posegraph_slam.registration.cloud import Surface
from posegraph_slam.registration.settings import IcpSettings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """A tangent frame in which metres and radians compare: centred on the points, turns measured on their radius.

    A tangent d at the source origin and e in this frame are the same motion if d = `to_origin` e; `to_origin` (p, p).
    """

    to_origin: FloatArray


def balanced_frame(centre: FloatArray, radius_m: float) -> Frame:
    """Make the tangent frame about `centre` (d,) in which one unit of turn moves points at `radius_m` by 1 m."""
    d = len(centre)
    shift = np.eye(d + 1)
    shift[:d, d] = centre
    unit = np.ones(3 * (d - 1))
    unit[rotation_part(d)] = 1.0 / radius_m
    return Frame(to_origin=(SE2 if d == 2 else SE3).adjoint(shift) * unit)


def rotation_part(dimension: int) -> slice:
    """Where the rotation stands in a tangent: last in SE(2), first in SE(3)."""
    return slice(2, 3) if dimension == 2 else slice(0, 3)


def split_directions(hessian: FloatArray, ratio: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Eigenvectors that the Hessian (p, p) holds, as columns (p, k), their values (k,), and the free ones (p, p-k).

    Free are those whose eigenvalue is under `ratio` of the largest (Zhang, Kaess and Singh 2016).
    """
    values, vectors = np.linalg.eigh(hessian)
    held = values > max(ratio * values[-1], np.finfo(np.float64).tiny)
    return vectors[:, held], values[held], vectors[:, ~held]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """What a solution rests on: `jacobian` (m, p) in `frame`, robust `weights` and `residuals_m` (m,) of its pairs.

    `slope` is the mean curvature of the loss over its mean weight; `target` (m,) the target rows of the pairs.
    """

    frame: Frame
    jacobian: FloatArray
    weights: FloatArray
    residuals_m: FloatArray
    slope: float
    target: IntArray


def information_of(evidence: Evidence, surface: Surface, settings: IcpSettings) -> tuple[FloatArray, FloatArray]:
    """Information (p, p) at the source origin, and free unit directions (k, p), of a weighted least-squares solution.

    The covariance is H^-1 M H^-1 (Huber 1967; White 1980) with M the outer products of the scores of the source
    points, plus those of the target points, whose noise reaches every pair that leans on them. With independent
    residuals of one variance that is sigma^2 H^-1. Free directions get `free_sigma_m`.
    """
    weighted = evidence.jacobian * evidence.weights[:, None]
    basis, values, free = split_directions(evidence.jacobian.T @ weighted, settings.degeneracy_ratio)
    scores = weighted @ basis
    thickness = surface.thickness_m[evidence.target]
    by_pair = evidence.slope * scores * _sigma(thickness, settings)  # a score follows noise with the loss's curvature
    by_target = scores_of_targets(by_pair, evidence.target, surface.neighbours, surface.normals)
    by_source = scores * _sigma(evidence.residuals_m, settings)
    k = surface.neighbours.shape[1]  # the residuals hold the noise of an anchor too, 1/k of a point's
    middle = by_source.T @ by_source * (k / (k + 1)) + by_target.T @ by_target
    freedom = len(scores) / max(len(scores) - len(values), 1)
    inverse = 1.0 / (evidence.slope * values)
    covariance = freedom * inverse[:, None] * middle * inverse
    floor = 1.0 / settings.free_sigma_m**2
    held_values, held_vectors = np.linalg.eigh(covariance)
    held = basis @ held_vectors
    balanced = (held * np.maximum(1.0 / held_values, floor)) @ held.T + floor * free @ free.T
    from_origin = np.linalg.inv(evidence.frame.to_origin)
    information = from_origin.T @ balanced @ from_origin
    directions = (evidence.frame.to_origin @ free).T
    return (information + information.T) / 2, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _sigma(deviation_m: FloatArray, settings: IcpSettings) -> FloatArray:
    """Deviations (m,) no smaller than the floor, as a column."""
    return np.maximum(deviation_m, settings.sigma_floor_m)[:, None]


@kernel
def scores_of_targets(scores: FloatArray, target: IntArray, neighbours: IntArray, normals: FloatArray) -> FloatArray:
    """Score (n, k) of each target point's noise along its normal, from those of the pairs (m, k) that lean on it.

    A pair with target point t leans in equal shares on `neighbours[t]`; noise along the normal n_j of one of them
    moves its residual by n_t . n_j, which also settles the arbitrary signs of the normals.
    """
    result = np.zeros((neighbours.shape[0], scores.shape[1]))
    for row in range(len(target)):
        t = target[row]
        for j in neighbours[t]:
            share = 0.0
            for a in range(normals.shape[1]):
                share += normals[t, a] * normals[j, a]
            share /= neighbours.shape[1]
            for a in range(scores.shape[1]):
                result[j, a] += share * scores[row, a]
    return result
