"""Scan matching against one growing map of hit counts: predict by odometry, match, count the scan's returns."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, pose_from_xyt, xyt_from_pose
from posegraph_slam.jit import kernel
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.registration.beam_matching import compose
from posegraph_slam.registration.beam_scans import BeamScans
from posegraph_slam.registration.hit_map_matching import (
    HitMapSettings,
    add_hits,
    match_scan_on_hits,
    prior_of,
    share_on_hits,
)

CELLS_MAX = 400_000_000
"""One byte each."""
ROOM_M = 5.0
"""Beyond what the odometry and the farthest returns reach, for what the odometry errs."""


def track_on_hits(
    scans: BeamScans, odometry: OdometryEstimate, settings: HitMapSettings, size_m: float
) -> tuple[FloatArray, FloatArray]:
    """Match all scans (N) one after the other; base poses (N, 3, 3) from the first of the odometry on, and the share
    (N,) of each scan's points on cells that were hit before.

    The map is a square of side `size_m` about the start, or fits odometry and returns where that is 0. Raises
    InputError for a map that would be too large.
    """
    poses = odometry.trajectory.poses
    steps = np.zeros((len(poses), 3))
    steps[1:] = xyt_from_pose(SE2.between(poses[:-1], poses[1:]))
    low, high = _bounds(scans, poses, size_m)
    shape = np.ceil((high - low) / settings.resolution_m).astype(np.int64)
    if int(shape[0]) * int(shape[1]) > CELLS_MAX:
        raise InputError("scan matching", f"needs a hit map of {shape[0]} x {shape[1]} cells", "take larger cells")
    hits = np.zeros((int(shape[1]), int(shape[0])), dtype=np.uint8)
    xyt, share = _track(
        scans.points,
        scans.kind,
        xyt_from_pose(scans.T_base_lidar),
        xyt_from_pose(poses[0]),
        steps,
        hits,
        np.array([*low, settings.resolution_m]),
        settings.window(settings.coarse),
        settings.window(settings.fine),
        prior_of(settings),
    )
    return pose_from_xyt(xyt), share


def _bounds(scans: BeamScans, poses: FloatArray, size_m: float) -> tuple[FloatArray, FloatArray]:
    """Corners (2,) of the map."""
    if size_m > 0:
        return poses[0, :2, 2] - 0.5 * size_m, poses[0, :2, 2] + 0.5 * size_m
    reach = float(np.sqrt(np.max(np.sum(scans.points.astype(np.float64) ** 2, axis=2), initial=0.0))) + ROOM_M
    return poses[:, :2, 2].min(axis=0) - reach, poses[:, :2, 2].max(axis=0) + reach


@kernel
def _track(points, kind, mount, start, steps, hits, frame, coarse, fine, prior):  # type: ignore[no-untyped-def]
    """Poses (N, 3) of the base and shares (N,); `hits` (R, C) grows. Scans are turned about the base, as it turns."""
    count, beams = kind.shape
    poses, shares = np.zeros((count, 3)), np.ones(count)
    c, s = np.cos(mount[2]), np.sin(mount[2])
    buffer = np.empty((beams, 2))
    poses[0] = start
    for i in range(count):
        known = 0
        for b in range(beams):
            if kind[i, b] > 0:
                buffer[known, 0] = c * points[i, b, 0] - s * points[i, b, 1] + mount[0]
                buffer[known, 1] = s * points[i, b, 0] + c * points[i, b, 1] + mount[1]
                known += 1
        scan = buffer[:known]
        if i > 0:
            predicted = compose(poses[i - 1], steps[i])
            poses[i] = predicted
            if known > 0:
                poses[i], _ = match_scan_on_hits(scan, hits, frame, predicted, coarse, fine, prior)
                shares[i] = share_on_hits(scan, hits, frame, poses[i])
        add_hits(hits, frame, scan, poses[i], prior[1])
    return poses, shares
