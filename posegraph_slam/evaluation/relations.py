"""Error of a trajectory against relative poses that are known to be true (Kuemmerle et al. 2009)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.statistics import ErrorStatistics, optional_dict, summarise
from posegraph_slam.geometry import Relations, Trajectory, wrap_angle, xyt_from_pose

NEAR_S = 10.0
"""Relations less far apart are met by raw odometry already; those farther apart tell whether the map is right."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelationGroup:
    """Errors of position (m) and heading (degrees) of a group of relations; None for an empty group."""

    translation_m: ErrorStatistics | None
    rotation_deg: ErrorStatistics | None

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {"translation_m": optional_dict(self.translation_m), "rotation_deg": optional_dict(self.rotation_deg)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelationErrors:
    """Errors of all relations, of the near (at most 10 s apart) and the far ones; `missing` lie outside the path."""

    all: RelationGroup
    near: RelationGroup
    far: RelationGroup
    used: int
    missing: int

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "all": self.all.as_dict(),
            "near": self.near.as_dict(),
            "far": self.far.as_dict(),
            "used": self.used,
            "missing": self.missing,
        }


def relation_errors(trajectory: Trajectory, relations: Relations, *, tolerance_s: float = 2e-3) -> RelationErrors:
    """Compare the motion between the two stamps of each relation with the true one, in the plane.

    A stamp within `tolerance_s` of a pose takes that pose; between poses x and y are interpolated linearly and the
    heading along the shorter arc. E = ref^-1 (P(t1)^-1 P(t2)): |E.t| in x and y, |E.theta|. Raises InputError when
    no relation lies within the trajectory.
    """
    if len(trajectory) == 0:
        raise InputError("evaluation", "the trajectory is empty")
    first, inside_1 = _poses_at(trajectory, relations.stamps_1_s, tolerance_s)
    second, inside_2 = _poses_at(trajectory, relations.stamps_2_s, tolerance_s)
    true = xyt_from_pose(relations.T_1_2)
    used = inside_1 & inside_2
    if not used.any():
        raise InputError(
            "evaluation", f"none of {len(relations)} relations lies within the trajectory", "check that clocks agree"
        )
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    dx, dy = second[:, 0] - first[:, 0], second[:, 1] - first[:, 1]
    translation = np.hypot(c * dx + s * dy - true[:, 0], -s * dx + c * dy - true[:, 1])
    rotation = np.degrees(np.abs(wrap_angle(second[:, 2] - first[:, 2] - true[:, 2])))
    far = np.abs(relations.stamps_2_s - relations.stamps_1_s) > NEAR_S

    def group(chosen: BoolArray) -> RelationGroup:
        return RelationGroup(translation_m=summarise(translation[chosen]), rotation_deg=summarise(rotation[chosen]))

    return RelationErrors(
        all=group(used), near=group(used & ~far), far=group(used & far),
        used=int(used.sum()), missing=int((~used).sum()),
    )  # fmt: skip


def _poses_at(trajectory: Trajectory, stamps_s: FloatArray, tolerance_s: float) -> tuple[FloatArray, BoolArray]:
    """Planar poses [x, y, theta] (M, 3) at `stamps_s` (M,) and whether these lie within the trajectory.

    Of poses with equal stamps the first recorded one counts.
    """
    order = np.argsort(trajectory.stamps_s, kind="stable")
    order = order[np.concatenate([[True], np.diff(trajectory.stamps_s[order]) > 0])]
    known, xyt = trajectory.stamps_s[order], xyt_from_pose(trajectory.poses[order])
    inside = (stamps_s >= known[0] - tolerance_s) & (stamps_s <= known[-1] + tolerance_s)
    after = np.clip(np.searchsorted(known, stamps_s), min(1, len(known) - 1), len(known) - 1)
    before = np.maximum(after - 1, 0)
    duration = known[after] - known[before]
    weight = np.divide(stamps_s - known[before], duration, out=np.zeros_like(stamps_s), where=duration > 0)
    before_gap, after_gap = np.abs(stamps_s - known[before]), np.abs(stamps_s - known[after])
    at_pose = np.minimum(before_gap, after_gap) <= tolerance_s
    weight = np.where(at_pose, (after_gap < before_gap).astype(np.float64), np.clip(weight, 0.0, 1.0))
    step = xyt[after] - xyt[before]
    step[:, 2] = wrap_angle(step[:, 2])
    return xyt[before] + weight[:, None] * step, np.asarray(inside)
