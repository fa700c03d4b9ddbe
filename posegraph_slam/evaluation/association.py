"""Pairing of two trajectories by their stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, Trajectory, planar_from_spatial


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pairs:
    """Indices (P,) into the estimate and the reference, in stamp order of the reference."""

    estimate: IntArray
    reference: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "estimate", read_only(self.estimate, np.int64))
        object.__setattr__(self, "reference", read_only(self.reference, np.int64))

    def __len__(self) -> int:
        return int(self.estimate.shape[0])


def pair_nearest(estimate_s: FloatArray, reference_s: FloatArray, *, max_dt_s: float = 0.02) -> Pairs:
    """Give each reference stamp (M,) the nearest estimate stamp (N,), where that is within `max_dt_s`.

    Neither needs to rise. An estimate pose may serve two reference stamps; of two equally near the earlier one serves.
    """
    order, reference_order = np.argsort(estimate_s, kind="stable"), np.argsort(reference_s, kind="stable")
    ordered, wanted = estimate_s[order], reference_s[reference_order]
    if len(ordered) == 0:
        return Pairs(estimate=order, reference=reference_order[:0])
    after = np.clip(np.searchsorted(ordered, wanted), 0, len(ordered) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(wanted - ordered[before] <= np.abs(ordered[after] - wanted), before, after)
    near = np.abs(ordered[nearest] - wanted) <= max_dt_s
    return Pairs(estimate=order[nearest[near]], reference=reference_order[near])


def paired_poses(
    estimate: Trajectory, reference: Trajectory, *, max_dt_s: float, minimum: int
) -> tuple[FloatArray, FloatArray]:
    """Poses (P, d+1, d+1) of both at paired stamps, planar when the estimate is planar, else spatial.

    Raises InputError when fewer than `minimum` stamps pair.
    """
    _, poses, true = paired(estimate, reference, max_dt_s=max_dt_s, minimum=minimum)
    return poses, true


def paired(
    estimate: Trajectory, reference: Trajectory, *, max_dt_s: float, minimum: int
) -> tuple[Pairs, FloatArray, FloatArray]:
    """Return the pairs and the poses that `paired_poses` returns."""
    pairs = pair_nearest(estimate.stamps_s, reference.stamps_s, max_dt_s=max_dt_s)
    if len(pairs) < minimum:
        raise InputError(
            "evaluation",
            f"only {len(pairs)} of {len(reference)} reference stamps have an estimate within {max_dt_s:g} s",
            "check that both use one clock",
        )
    if estimate.group is SE2:
        true = reference.poses if reference.group is SE2 else planar_from_spatial(reference.poses)
        return pairs, estimate.poses[pairs.estimate], true[pairs.reference]
    return pairs, estimate.poses[pairs.estimate], reference.spatial().poses[pairs.reference]


def rotation_angle_deg(poses: FloatArray) -> FloatArray:
    """Angle (N,) of the rotation of poses (N, d+1, d+1), in [0, 180] degrees, exact near 0 and near 180."""
    if poses.shape[-1] == 3:
        return np.degrees(np.abs(np.arctan2(poses[:, 1, 0], poses[:, 0, 0])))
    R = poses[:, :3, :3]
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=-1)
    return np.asarray(np.degrees(np.arctan2(np.linalg.norm(axis, axis=1), np.trace(R, axis1=1, axis2=2) - 1)))
