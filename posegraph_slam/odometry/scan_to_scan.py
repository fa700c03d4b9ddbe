"""Scan-matching odometry by ICP between neighbouring scans, as in the course report (section III.D, eq. 35)."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.execution import Executor, Progress
from posegraph_slam.geometry import SE2
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.registration.beam_information import information_in_base, inverse
from posegraph_slam.registration.beam_scans import BeamScans
from posegraph_slam.registration.scan_pairs import PairResults, PointSets, match_consecutive
from posegraph_slam.registration.settings import IcpSettings


def chain_by_icp(
    scans: BeamScans, odometry: OdometryEstimate, settings: IcpSettings, *, executor: Executor, progress: Progress
) -> tuple[FloatArray, FloatArray, PairResults]:
    """Register each scan onto the one before it, starting at the odometry's motion, and chain the results.

    Returns the poses T_odom_base (N, 3, 3), the information of each step (N-1, 3, 3) in the base frame, and what the
    registrations found. Where one fails, the odometry's motion and its information take its place.
    """
    mounting = scans.T_base_lidar
    steps = odometry.steps
    guess = SE2.inverse(mounting) @ steps @ mounting
    pairs = match_consecutive(point_sets(scans), guess, settings, executor=executor, progress=progress)
    matched = mounting @ pairs.T_target_source @ SE2.inverse(mounting)
    usable = pairs.usable[:, None, None]
    steps = np.where(usable, matched, steps)
    information = np.where(usable, information_in_base(pairs.information, mounting), inverse(odometry.covariance))
    return chain(odometry.trajectory.poses[0], steps), information, pairs


def point_sets(scans: BeamScans) -> PointSets:
    """Return the returns of all scans, in the lidar frame, one set a scan."""
    hit = scans.kind > 0
    return PointSets(
        points=scans.points[hit].astype(np.float64), offsets=np.concatenate([[0], np.cumsum(hit.sum(axis=1))])
    )


def chain(start: FloatArray, steps: FloatArray) -> FloatArray:
    """Compose steps (M, 3, 3) onto `start` (3, 3): poses (M+1, 3, 3), by running sums instead of products."""
    heading = np.arctan2(start[1, 0], start[0, 0]) + np.concatenate(
        [[0.0], np.cumsum(np.arctan2(steps[:, 1, 0], steps[:, 0, 0]))]
    )
    poses = np.zeros((len(steps) + 1, 3, 3))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(heading)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(heading), -np.sin(heading)
    poses[:, 2, 2] = 1.0
    moved = (poses[:-1, :2, :2] @ steps[:, :2, 2, None])[..., 0]
    poses[:, :2, 2] = start[:2, 2] + np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    return poses
