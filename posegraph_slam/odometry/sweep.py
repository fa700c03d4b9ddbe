"""What pairs of scans say of the duration of a sweep, in numba."""

from __future__ import annotations

import numpy as np

from posegraph_slam.jit import kernel
from posegraph_slam.registration.beam_matching import between, match_scan, nearest_return


@kernel
def sweep_terms(source, target, poses, motion, matching, points, lines, kind, thinned, geometry):  # type: ignore[no-untyped-def]
    """Match pairs of scans and return information and gradient (M, 2) of the share of the motion within a sweep.

    `poses` (N, 3) of the lidar, `motion` (N, 3) its step at each scan. Beam b of a sweep is measured (b + 1/2) / B -
    1/2 of the sweep after its middle. Residuals are point to line; the pose of each pair is eliminated (Schur).
    """
    terms = np.zeros((len(source), 2))
    refs, at, prior = np.zeros(1, np.int64), np.zeros((1, 3)), np.zeros((3, 3))
    beams = kind.shape[1]
    gate2, q, min_cosine = matching[1] ** 2, matching[3] ** 2, matching[5]
    H, g = np.zeros((4, 4)), np.zeros(4)
    J = np.zeros(4)
    for m in range(len(source)):
        s, t = source[m], target[m]
        refs[0] = t
        start = between(poses[t], poses[s])
        pose, _, stats = match_scan(s, refs, at, start, prior, matching, points, lines, kind, thinned, geometry)
        moved = between(start, pose)
        if stats[1] < 0.5 * stats[0] or np.hypot(moved[0], moved[1]) > 0.2 or abs(moved[2]) > 0.1:
            continue
        c, sn = np.cos(pose[2]), np.sin(pose[2])
        H[:], g[:] = 0.0, 0.0
        for b in range(beams):
            if not thinned[s, b] or kind[s, b] != 2:
                continue
            px, py = points[s, b, 0], points[s, b, 1]
            x, y = c * px - sn * py + pose[0], sn * px + c * py + pose[1]
            k = nearest_return(x, y, t, gate2, points, kind, geometry)
            if k < 0 or kind[t, k] != 2:
                continue
            nx, ny = lines[t, k, 0], lines[t, k, 1]
            J[0], J[1] = nx * c + ny * sn, -nx * sn + ny * c
            if lines[s, b, 0] * J[0] + lines[s, b, 1] * J[1] < min_cosine:
                continue
            J[2] = -J[0] * py + J[1] * px
            f, h = (b + 0.5) / beams - 0.5, (k + 0.5) / beams - 0.5
            qx, qy = points[t, k, 0], points[t, k, 1]
            J[3] = f * (J[0] * (motion[s, 0] - motion[s, 2] * py) + J[1] * (motion[s, 1] + motion[s, 2] * px)) - h * (
                nx * (motion[t, 0] - motion[t, 2] * qy) + ny * (motion[t, 1] + motion[t, 2] * qx)
            )
            e = nx * x + ny * y - lines[t, k, 2]
            w = (q / (q + e * e)) ** 2
            for i in range(4):
                g[i] += w * J[i] * e
                for j in range(4):
                    H[i, j] += w * J[i] * J[j]
        for i in range(3):
            H[i, i] += 1e-6 + 1e-3 * H[i, i]
        solved = np.linalg.solve(H[:3, :3].copy(), H[:3, 3].copy())
        terms[m, 0] = H[3, 3] - H[3, 0] * solved[0] - H[3, 1] * solved[1] - H[3, 2] * solved[2]
        terms[m, 1] = g[3] - g[0] * solved[0] - g[1] * solved[1] - g[2] * solved[2]
    return terms
