"""Errors of an orientation over time against a true one: roll, pitch and yaw, tilt, heading, consistency."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.association import pair_nearest
from posegraph_slam.geometry import SO3, Trajectory, interpolate, wrap_angle

GIMBAL_PITCH_DEG = 80.0
"""Nearer to the pole than 10 degrees, roll and yaw amplify an error of tilt more than 5.8 times."""
MAX_GAP_S = 0.1
START_S = 1.0
"""The heading is aligned by its mean difference over this time."""
MIN_PAIRS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeErrors:
    """RMSE in degrees over `count` true stamps, after aligning the heading at the start.

    `roll_deg`, `pitch_deg`, `yaw_deg` are differences of ZYX Euler angles, wrapped; `_away` of those at which the true
    pitch is within 80 degrees of level (a share `away_share`). `tilt_deg` is the angle between the vertical axes and
    `heading_deg` the vertical component of the error's rotation vector in the world: neither has a pole. `nees` is the
    mean of e' C^-1 e, 3 for a consistent filter, and `nees_median` its median, 2.37 then; None without covariance.
    """

    count: int
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    roll_away_deg: float
    pitch_away_deg: float
    yaw_away_deg: float
    away_share: float
    tilt_deg: float
    heading_deg: float
    angle_deg: float
    nees: float | None
    nees_median: float | None

    def as_dict(self) -> dict[str, float | int | None]:
        """Return the fields for JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttitudePairs:
    """True rotations (M, 3, 3) and the estimate's, aligned, at `stamps_s` (M,)."""

    stamps_s: FloatArray
    estimate: FloatArray
    truth: FloatArray

    def __post_init__(self) -> None:
        for name in ("stamps_s", "estimate", "truth"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def euler_rpy(R: FloatArray) -> FloatArray:
    """Roll, pitch and yaw (N, 3) in rad of rotations (N, 3, 3) = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll, yaw = np.arctan2(R[:, 2, 1], R[:, 2, 2]), np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.stack([roll, np.arctan2(-R[:, 2, 0], np.hypot(R[:, 2, 1], R[:, 2, 2])), yaw], axis=1)


def align_heading(estimate: Trajectory, truth: Trajectory) -> AttitudePairs:
    """Interpolate the estimate at the true stamps that it covers, and turn it by the heading error of its first second.

    Truth keeps its own stamps; those in gaps of the estimate longer than 0.1 s are left out. Raises `InputError` when
    fewer than ten remain.
    """
    pairs = pair_nearest(estimate.stamps_s, truth.stamps_s, max_dt_s=MAX_GAP_S)
    stamps = truth.stamps_s[pairs.reference]
    inside = (stamps >= estimate.stamps_s.min()) & (stamps <= estimate.stamps_s.max()) if len(pairs) else stamps > 0
    if int(inside.sum()) < MIN_PAIRS:
        problem = f"only {int(inside.sum())} of {len(truth)} true stamps are covered by the estimate"
        raise InputError("evaluation", problem, "check that both use one clock")
    stamps, true = stamps[inside], truth.poses[pairs.reference[inside], :3, :3]
    R = interpolate(estimate, stamps).poses[:, :3, :3]
    first = stamps <= stamps[0] + START_S
    heading = Rotation.from_matrix(true[first] @ R[first].transpose(0, 2, 1)).mean().as_rotvec()[2]
    return AttitudePairs(stamps_s=stamps, estimate=SO3.exp(np.array([0.0, 0.0, heading])) @ R, truth=true)


def attitude_errors(estimate: Trajectory, truth: Trajectory, *, covariance: FloatArray | None = None) -> AttitudeErrors:
    """Compare orientations at the true stamps; `covariance` (N, 3, 3) is of the estimate's turn in the body, rad^2."""
    pairs = align_heading(estimate, truth)
    true_rpy = euler_rpy(pairs.truth)
    difference = np.degrees(wrap_angle(euler_rpy(pairs.estimate) - true_rpy))
    away = np.abs(np.degrees(true_rpy[:, 1])) <= GIMBAL_PITCH_DEG
    in_body = SO3.log(pairs.estimate.transpose(0, 2, 1) @ pairs.truth)
    in_world = SO3.log(pairs.truth @ pairs.estimate.transpose(0, 2, 1))
    nees = None if covariance is None else _nees(in_body, covariance, estimate.stamps_s, pairs.stamps_s)
    return AttitudeErrors(
        count=len(difference),
        **dict(zip(("roll_deg", "pitch_deg", "yaw_deg"), _rmse(difference), strict=True)),
        **dict(zip(("roll_away_deg", "pitch_away_deg", "yaw_away_deg"), _rmse(difference[away]), strict=True)),
        away_share=float(away.mean()),
        tilt_deg=_rmse(tilt_deg(pairs)[:, None])[0],
        heading_deg=_rmse(np.degrees(in_world[:, 2:]))[0],
        angle_deg=_rmse(np.degrees(np.linalg.norm(in_body, axis=1))[:, None])[0],
        nees=None if nees is None else float(nees.mean()),
        nees_median=None if nees is None else float(np.median(nees)),
    )


def tilt_deg(pairs: AttitudePairs) -> FloatArray:
    """Angle (M,) in degrees between the true and the estimated vertical, seen from the body."""
    a, b = pairs.estimate[:, 2], pairs.truth[:, 2]
    return np.asarray(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))))


def _rmse(errors: FloatArray) -> list[float]:
    """RMSE of each column of errors (n, k); zero without rows."""
    squares = np.square(errors)
    return [float(value) for value in np.sqrt(squares.sum(axis=0) / max(len(squares), 1))]


def _nees(errors: FloatArray, covariance: FloatArray, stamps_s: FloatArray, at_s: FloatArray) -> FloatArray:
    """Normalised squared errors (M,) with the covariance of the estimate nearest in time."""
    nearest = pair_nearest(stamps_s, at_s, max_dt_s=np.inf)
    C = covariance[nearest.estimate]
    return np.asarray(np.sum(errors * np.linalg.solve(C, errors[..., None])[..., 0], axis=1))
