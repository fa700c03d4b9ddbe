"""Absolute pose error of a trajectory against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.association import paired_poses, rotation_angle_deg
from posegraph_slam.evaluation.statistics import ErrorStatistics, summarise
from posegraph_slam.geometry import SE2, Trajectory, align_points, inverse_pose, planar_from_spatial

Alignment = Literal["auto", "none", "origin", "se2", "se3"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AbsolutePoseError:
    """Errors of position (m) and heading or attitude (degrees) at `paired` stamps of `reference` known ones."""

    translation_m: ErrorStatistics
    rotation_deg: ErrorStatistics
    alignment: str
    paired: int
    reference: int

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "translation_m": self.translation_m.as_dict(),
            "rotation_deg": self.rotation_deg.as_dict(),
            "alignment": self.alignment,
            "paired": self.paired,
            "reference": self.reference,
        }


def absolute_pose_error(
    estimate: Trajectory, reference: Trajectory, *, alignment: Alignment = "auto", max_dt_s: float = 0.02
) -> AbsolutePoseError:
    """Compare positions and rotations at paired stamps after a rigid alignment (Umeyama 1991, without scale).

    `alignment`: none; origin (the first pair coincides); se2 (in the plane: spatial poses are projected) or se3; auto
    is se2 for a planar estimate, else se3. Paths that leave the rotation open (a robot that never moves) fall back
    to origin, and the result says so. Raises InputError when fewer than three stamps pair.
    """
    if alignment == "auto":
        alignment = "se2" if estimate.group is SE2 else "se3"
    poses, true = paired_poses(estimate, reference, max_dt_s=max_dt_s, minimum=3)
    if alignment == "se2" and poses.shape[-1] == 4:
        poses, true = planar_from_spatial(poses), planar_from_spatial(true)
    if alignment == "se3" and poses.shape[-1] == 3:
        raise InputError("evaluation", "a planar trajectory cannot be aligned in space", "use alignment se2")
    T_reference_estimate, used = _alignment(poses, true, alignment)
    aligned = T_reference_estimate @ poses
    translation = np.linalg.norm(aligned[:, :-1, -1] - true[:, :-1, -1], axis=1)
    rotation = rotation_angle_deg(inverse_pose(true) @ aligned)
    translation_m, rotation_deg = summarise(translation), summarise(rotation)
    assert translation_m is not None
    assert rotation_deg is not None
    return AbsolutePoseError(
        translation_m=translation_m, rotation_deg=rotation_deg, alignment=used, paired=len(poses),
        reference=len(reference),
    )  # fmt: skip


def _alignment(poses: FloatArray, true: FloatArray, alignment: Alignment) -> tuple[FloatArray, str]:
    """Transform from the frame of `poses` to that of `true`, and the alignment that was possible."""
    if alignment == "none":
        return np.eye(poses.shape[-1]), "none"
    if alignment in ("se2", "se3"):
        T, _, determined = align_points(poses[:, :-1, -1], true[:, :-1, -1])
        if determined:
            return T, alignment
    return true[0] @ inverse_pose(poses[0]), "origin"
