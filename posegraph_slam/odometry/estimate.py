"""What every odometry returns, and its step covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, Trajectory, interpolate
from posegraph_slam.odometry.settings import StepNoise


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OdometryEstimate:
    """Poses T_odom_base with the noise between them.

    `trajectory` (N, 3, 3) odom -> base; `covariance` (N-1, 3, 3) of step k, from pose k to pose k+1 in recorded
    order, in the tangent [x, y, theta] of the right update at pose k+1 (m, rad); steps are independent of each
    other. `source` names where it came from; `remarks` are plain sentences on what had to be done.
    """

    trajectory: Trajectory
    covariance: FloatArray
    source: str
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        covariance = read_only(self.covariance)
        if covariance.shape != (max(len(self.trajectory) - 1, 0), 3, 3) or self.trajectory.group is not SE2:
            raise InputError("odometry", f"covariance {covariance.shape} does not fit {len(self.trajectory)} poses")
        object.__setattr__(self, "covariance", covariance)

    @property
    def steps(self) -> FloatArray:
        """Motion T_k_k+1 (N-1, 3, 3) between consecutive poses."""
        return SE2.between(self.trajectory.poses[:-1], self.trajectory.poses[1:])

    def part(self, rows: slice) -> OdometryEstimate:
        """Return consecutive poses (at least one) with the noise between them."""
        rows = slice(*rows.indices(len(self.trajectory)))
        return replace(
            self,
            trajectory=self.trajectory.select(np.arange(rows.start, rows.stop)),
            covariance=self.covariance[rows.start : rows.stop - 1],
        )


def step_covariance(distance_m: FloatArray, turn_rad: FloatArray, noise: StepNoise) -> FloatArray:
    """Covariance (N, 3, 3) of steps of length `distance_m` (N,) that turn by `turn_rad` (N,); signs do not matter."""
    distance, turn = np.abs(distance_m), np.abs(turn_rad)
    position = noise.translation_per_sqrt_m**2 * distance + noise.translation_per_sqrt_rad**2 * turn + noise.floor_m**2
    heading = noise.rotation_per_sqrt_m**2 * distance + noise.rotation_per_sqrt_rad**2 * turn + noise.floor_rad**2
    return diagonal_covariance(position, heading)


def diagonal_covariance(position_m2: FloatArray, heading_rad2: FloatArray) -> FloatArray:
    """Covariance (N, 3, 3) from the variance (N,) of x and y alike and of the heading."""
    covariance = np.zeros((*np.shape(position_m2), 3, 3))
    covariance[..., 0, 0] = covariance[..., 1, 1] = position_m2
    covariance[..., 2, 2] = heading_rad2
    return covariance


def covariance_between(poses: FloatArray, covariance: FloatArray, start: IntArray, end: IntArray) -> FloatArray:
    """Compose step covariances into those of the motions from pose `start` (M,) to `end` (M,), exact to first order.

    `poses` (N, 3, 3), `covariance` (N-1, 3, 3) of the steps. The noise of a step, seen from the end b of the motion,
    is Ad(T_b_k+1) C_k Ad(T_b_k+1)^T; the sum over the steps between is a difference of running sums in one common
    frame. A motion may run backwards: the noise of its steps, seen from its own end, is then the same sum.
    """
    # a common frame amid the path keeps the lever arms, and with them the rounding of the running sums, small
    centre = np.eye(3)
    centre[:2, 2] = poses[:, :2, 2].mean(axis=0)
    centred = SE2.between(np.broadcast_to(centre, poses.shape), poses)
    to_common = SE2.adjoint(centred[1:])
    running = np.zeros((len(poses), 3, 3))
    np.cumsum(to_common @ covariance @ np.swapaxes(to_common, -1, -2), axis=0, out=running[1:])
    between = running[np.maximum(start, end)] - running[np.minimum(start, end)]
    to_end = SE2.adjoint(SE2.inverse(centred[end]))
    result = to_end @ between @ np.swapaxes(to_end, -1, -2)
    return np.asarray((result + np.swapaxes(result, -1, -2)) / 2)


def resample(
    estimate: OdometryEstimate, stamps_s: FloatArray, *, unknown_per_s: FloatArray, floor: StepNoise
) -> OdometryEstimate:
    """Return the estimate at `stamps_s` (M,), which need not rise, with the noise between them in that order.

    Poses are interpolated along the geodesic and held before the first and after the last; a part of a step takes
    its part of the step's covariance, and time outside the estimate takes `unknown_per_s` (3, 3) a second. The
    floor of `floor` is added to each step, so that none, two scans with one stamp for example, is without noise.
    """
    known, steps = _rising(estimate)
    grid = np.union1d(known.stamps_s, stamps_s)
    fine = interpolate(known, grid)
    step = np.searchsorted(known.stamps_s, grid[:-1], side="right") - 1
    outside = (step < 0) | (step >= len(known) - 1)
    per_second = np.concatenate([steps / np.diff(known.stamps_s)[:, None, None], unknown_per_s[None]])
    fine_covariance = per_second[np.where(outside, -1, step)] * np.diff(grid)[:, None, None]
    index = np.searchsorted(grid, stamps_s)
    covariance = covariance_between(fine.poses, fine_covariance, index[:-1], index[1:])
    return OdometryEstimate(
        trajectory=fine.select(index),
        covariance=covariance + np.diag([floor.floor_m**2, floor.floor_m**2, floor.floor_rad**2]),
        source=estimate.source,
        remarks=estimate.remarks,
    )


def _rising(estimate: OdometryEstimate) -> tuple[Trajectory, FloatArray]:
    """Merge steps of no duration into their predecessors: rising stamps, and the covariance of the merged steps."""
    trajectory = estimate.trajectory
    if len(trajectory) == 0 or np.any(np.diff(trajectory.stamps_s) < 0):
        raise InputError("odometry", "has no poses, or its stamps run backwards", "sort the poses by stamp")
    kept = np.flatnonzero(np.concatenate([np.diff(trajectory.stamps_s) > 0, [True]]))
    if len(kept) == len(trajectory):
        return trajectory, estimate.covariance
    return trajectory.select(kept), covariance_between(trajectory.poses, estimate.covariance, kept[:-1], kept[1:])
