"""Absolute pose error of a trajectory against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.association import paired, rotation_angle_deg
from posegraph_slam.evaluation.statistics import ErrorStatistics, summarise
from posegraph_slam.geometry import SE2, Trajectory, align_points, inverse_pose, planar_from_spatial

Alignment = Literal["auto", "none", "origin", "first", "se2", "se3", "sim3"]
UNSURE_TURN_DEG = 1.0
"""An alignment whose turn is less certain than this makes errors of rotation that are not the estimate's."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AbsolutePoseError:
    """Errors of position (m) and heading or attitude (degrees) at `paired` stamps of `reference` known ones.

    `turn_sigma_deg` is how well the positions tell the alignment's rotation; see `AlignedPaths`.
    """

    translation_m: ErrorStatistics
    rotation_deg: ErrorStatistics
    alignment: str
    paired: int
    reference: int
    scale: float = 1.0
    turn_sigma_deg: float = 0.0

    @property
    def remark(self) -> str:
        """What to know before the errors of rotation are read; empty where they mean what they say."""
        if self.turn_sigma_deg <= UNSURE_TURN_DEG:
            return ""
        return (
            f"the positions tell the rotation of the alignment to {self.turn_sigma_deg:.1f} deg only (they lie in a "
            "line, or far off), and APE of rotation means no more; look at RPE, or align the first poses"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "translation_m": self.translation_m.as_dict(),
            "rotation_deg": self.rotation_deg.as_dict(),
            "alignment": self.alignment,
            "scale": self.scale,
            "turn_sigma_deg": self.turn_sigma_deg,
            "paired": self.paired,
            "reference": self.reference,
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlignedPaths:
    """Poses (P, d+1, d+1) of an estimate in the frame of the truth, and the true ones, at the same `stamps_s` (P,).

    `alignment` is what was possible; `scale` what the estimate was multiplied by (1 but for sim3).
    """

    stamps_s: FloatArray
    estimate: FloatArray
    true: FloatArray
    alignment: str
    scale: float

    def __post_init__(self) -> None:
        for name in ("stamps_s", "estimate", "true"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def translation_m(self) -> FloatArray:
        """Distance (P,) of each position from the true one."""
        return np.asarray(np.linalg.norm(self.estimate[:, :-1, -1] - self.true[:, :-1, -1], axis=1))

    @property
    def rotation_deg(self) -> FloatArray:
        """Angle (P,) between each rotation and the true one."""
        return rotation_angle_deg(inverse_pose(self.true) @ self.estimate)

    @property
    def turn_sigma_deg(self) -> float:
        """Deviation of the alignment's least certain turn, as the distances that it leaves tell it; 0 without one.

        Positions in a line say nothing of a turn about it: the lever arms are those across the longest direction.
        """
        if self.alignment in ("none", "origin"):
            return 0.0
        count, d = len(self.stamps_s), self.true.shape[-1] - 1
        centred = self.true[:, :d, d] - self.true[:, :d, d].mean(axis=0)
        moments = np.linalg.eigvalsh(centred.T @ centred)
        arms = moments.sum() - (moments[-1] if d == 3 else 0.0)
        variance = np.sum(self.translation_m**2) / max(count * d - d * (d + 1) // 2, 1)
        return float(np.rad2deg(np.sqrt(variance / arms))) if arms > 0 else 180.0


def align_paths(
    estimate: Trajectory, reference: Trajectory, *, alignment: Alignment = "auto", max_dt_s: float = 0.02
) -> AlignedPaths:
    """Bring an estimate into the frame of the truth at paired stamps (Umeyama 1991).

    `alignment`: none; origin or first (the first pair coincides); se2 (in the plane: spatial poses are projected), se3,
    or sim3 with a scale; auto is se2 for a planar estimate, else se3. Paths that leave the rotation open (a robot that
    never moves) fall back to origin, and the result says so. Raises InputError when fewer than three stamps pair.
    """
    if alignment == "auto":
        alignment = "se2" if estimate.group is SE2 else "se3"
    if alignment == "se3" and estimate.group is SE2:
        raise InputError("evaluation", "a planar trajectory cannot be aligned in space", "use alignment se2")
    pairs, poses, true = paired(estimate, reference, max_dt_s=max_dt_s, minimum=3)
    if alignment == "se2" and poses.shape[-1] == 4:
        poses, true = planar_from_spatial(poses), planar_from_spatial(true)
    T_reference_estimate, scale, used = _alignment(poses, true, alignment)
    scaled = np.array(poses)
    scaled[:, :-1, -1] *= scale
    return AlignedPaths(
        stamps_s=reference.stamps_s[pairs.reference],
        estimate=T_reference_estimate @ scaled,
        true=true,
        alignment=used,
        scale=scale,
    )


def absolute_pose_error(
    estimate: Trajectory, reference: Trajectory, *, alignment: Alignment = "auto", max_dt_s: float = 0.02
) -> AbsolutePoseError:
    """Compare positions and rotations at paired stamps after the alignment that `align_paths` describes.

    Raises InputError when fewer than three stamps pair.
    """
    return error_of(align_paths(estimate, reference, alignment=alignment, max_dt_s=max_dt_s), len(reference))


def error_of(paths: AlignedPaths, reference: int) -> AbsolutePoseError:
    """Summarise the errors of aligned paths; `reference` is how many true poses there are in all."""
    translation_m, rotation_deg = summarise(paths.translation_m), summarise(paths.rotation_deg)
    assert translation_m is not None
    assert rotation_deg is not None
    return AbsolutePoseError(
        translation_m=translation_m,
        rotation_deg=rotation_deg,
        alignment=paths.alignment,
        scale=paths.scale,
        turn_sigma_deg=paths.turn_sigma_deg,
        paired=len(paths.stamps_s),
        reference=reference,
    )


def _alignment(poses: FloatArray, true: FloatArray, alignment: Alignment) -> tuple[FloatArray, float, str]:
    """Rigid transform from the frame of the scaled `poses` to that of `true`, the scale, and what was possible."""
    d = poses.shape[-1] - 1
    if alignment == "none":
        return np.eye(d + 1), 1.0, "none"
    if alignment in ("se2", "se3", "sim3"):
        T, scale, determined = align_points(poses[:, :d, d], true[:, :d, d], with_scale=alignment == "sim3")
        if determined and scale > 0:
            T[:d, :d] /= scale
            return T, scale, alignment
    return true[0] @ inverse_pose(poses[0]), 1.0, "origin"
