"""Relative pose error of a trajectory against the truth: its drift over a frame and over given distances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.evaluation.association import paired_poses, rotation_angle_deg
from posegraph_slam.evaluation.statistics import ErrorStatistics, optional_dict, summarise
from posegraph_slam.geometry import Trajectory, inverse_pose

DISTANCE_TOLERANCE = 0.1
"""A pair of poses counts for a distance when their path length apart is within this part of it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativeError:
    """Drift over `distance_m` of the true path (None: from one paired stamp to the next); None where no pair is."""

    distance_m: float | None
    translation_m: ErrorStatistics | None
    rotation_deg: ErrorStatistics | None

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "distance_m": self.distance_m,
            "translation_m": optional_dict(self.translation_m),
            "rotation_deg": optional_dict(self.rotation_deg),
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativePoseError:
    """Drift from frame to frame and over each of the distances."""

    per_frame: RelativeError
    over_distance: tuple[RelativeError, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "per_frame": self.per_frame.as_dict(),
            "over_distance": [error.as_dict() for error in self.over_distance],
        }

    def over(self, distance_m: float) -> RelativeError | None:
        """Return the drift over `distance_m`, None when it was not computed."""
        return next((error for error in self.over_distance if error.distance_m == distance_m), None)


def relative_pose_error(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    distances_m: tuple[float, ...] = (1.0, 5.0, 10.0),
    max_dt_s: float = 0.02,
) -> RelativePoseError:
    """Compare motions at paired stamps: E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) (Sturm et al. 2012, eq. 2).

    Per frame j is the next stamp; for a distance j is the stamp whose true path length from i is nearest to it, for
    every i for which one is within a tenth. Raises InputError when fewer than two stamps pair.
    """
    poses, true = paired_poses(estimate, reference, max_dt_s=max_dt_s, minimum=2)
    steps = np.linalg.norm(np.diff(true[:, :-1, -1], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    frames = np.arange(len(poses) - 1)
    return RelativePoseError(
        per_frame=_errors(poses, true, None, (frames, frames + 1)),
        over_distance=tuple(_errors(poses, true, d, _pairs_apart(travelled, d)) for d in distances_m),
    )


def _pairs_apart(travelled: FloatArray, distance_m: float) -> tuple[IntArray, IntArray]:
    """Indices i and j > i of poses whose path length apart is nearest to `distance_m`, and near enough."""
    wanted = travelled + distance_m
    after = np.minimum(np.searchsorted(travelled, wanted), len(travelled) - 1)
    before = np.maximum(after - 1, 0)
    j = np.where(wanted - travelled[before] <= travelled[after] - wanted, before, after)
    j = np.where(travelled[after] < wanted, after, j)
    i = np.arange(len(travelled))
    kept = (j > i) & (np.abs(travelled[j] - wanted) <= DISTANCE_TOLERANCE * distance_m)
    return i[kept], j[kept]


def _errors(
    poses: FloatArray, true: FloatArray, distance_m: float | None, pairs: tuple[IntArray, IntArray]
) -> RelativeError:
    i, j = pairs
    motion, true_motion = inverse_pose(poses[i]) @ poses[j], inverse_pose(true[i]) @ true[j]
    error = inverse_pose(true_motion) @ motion
    return RelativeError(
        distance_m=distance_m,
        translation_m=summarise(np.linalg.norm(error[:, :-1, -1], axis=1)),
        rotation_deg=summarise(rotation_angle_deg(error)),
    )
