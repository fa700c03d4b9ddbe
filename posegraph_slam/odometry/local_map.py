"""Scan-matching odometry: every scan matched to the map of the last keyframes, in one numba kernel."""

from __future__ import annotations

import numpy as np

from posegraph_slam.jit import kernel
from posegraph_slam.registration.beam_matching import between, compose, match_scan
from posegraph_slam.registration.local_search import search_pose

STATISTICS = 7
"""Columns of the statistics of a scan: seen, matched, weight, rmse, iterations, last step, 1 when searched."""


@kernel
def track(increments, sigmas, scheme, search, matching, points, lines, kind, thinned, geometry):  # type: ignore[no-untyped-def]
    """Chain the scans: predict by odometry, match to the last keyframes, add a keyframe after enough motion.

    `increments` (N, 3) and `sigmas` (N, 3) are the odometry step to each scan in the lidar frame; `scheme` holds the
    number of references, keyframe distance and turn, the least matched fraction, and reach in metres and radians of
    the search that is made when fewer match or the odometry leaps (sigma of the turn beyond its reach), and 1 where
    there is no odometry, so that the last motion is taken to go on (stamps of old loggers are useless for a velocity).
    Returns lidar poses (N, 3), statistics (N, 7), Hessians (N, 3, 3) and the scans that are keyframes.
    """
    count = len(increments)
    poses, hessians, stats = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, STATISTICS))
    keyframes = np.zeros(count, np.int64)
    keyposes = np.zeros((count, 3))
    references, known, coasting = int(scheme[0]), 1, scheme[6] > 0
    stride = int(scheme[7])
    chosen = np.zeros(references, np.int64)
    prior = np.zeros((3, 3))
    for i in range(1, count):
        if coasting and i > 1:
            start = compose(poses[i - 1], between(poses[i - 2], poses[i - 1]))
        else:
            start = compose(poses[i - 1], increments[i])
        for r in range(references):
            # the last two, then further back in strides: a longer stretch of the map at the same cost
            chosen[r] = max(known - 1 - (r if r < 2 else 1 + (r - 1) * stride), 0)
        used = 1
        while used < references and chosen[used] < chosen[used - 1]:
            used += 1
        refs, ref_poses = keyframes[chosen[:used]], keyposes[chosen[:used]]
        for k in range(3):
            prior[k, k] = 1.0 / sigmas[i, k] ** 2
        pose, hessian, stat = match_scan(
            i, refs, ref_poses, start, prior, matching, points, lines, kind, thinned, geometry
        )
        leap = sigmas[i, 2] > 0.5 * scheme[5]
        if leap or stat[1] < scheme[3] * stat[0]:
            best, score, _ = search_pose(
                i, refs, ref_poses, start, scheme[4], scheme[5], 0.4, search, points, kind, thinned
            )
            stats[i, 6] = 1.0
            again, hessian2, stat2 = match_scan(
                i, refs, ref_poses, best, 1e-2 * prior, matching, points, lines, kind, thinned, geometry
            )
            if score > 0.0 and stat2[2] > 1.2 * stat[2]:
                pose, hessian, stat = again, hessian2, stat2
        poses[i], hessians[i], stats[i, :6] = pose, hessian / used, stat
        moved = between(keyposes[known - 1], pose)
        if np.hypot(moved[0], moved[1]) >= scheme[1] or abs(moved[2]) >= scheme[2]:
            keyframes[known], keyposes[known] = i, pose
            known += 1
    poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return poses, stats, hessians, keyframes[:known].copy()
