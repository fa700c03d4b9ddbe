"""Tangent frames in which metres and radians compare, and the directions that a Hessian leaves free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE2, SE3


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
