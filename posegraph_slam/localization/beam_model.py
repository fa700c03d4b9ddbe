"""Scans against a known map, in numba: likelihood of particles, refinement of one pose, and agreement with the map."""

from __future__ import annotations

import numpy as np

from posegraph_slam.jit import kernel
from posegraph_slam.registration.beam_matching import between, compose, solve3


@kernel
def add_log_likelihoods(particles, points, table, outside, resolution, weight, log_weights):  # type: ignore[no-untyped-def]
    """Add to `log_weights` (N,) the log-likelihood of `points` (n, 2) (base frame) seen from `particles` (N, 3).

    `table` (R, C) holds the log-likelihood of a return in each cell, `outside` that of one beyond the map.
    """
    rows, columns = table.shape
    scale = 1.0 / resolution
    for k in range(len(particles)):
        c, s = np.cos(particles[k, 2]) * scale, np.sin(particles[k, 2]) * scale
        x0, y0 = particles[k, 0] * scale, particles[k, 1] * scale
        total = 0.0
        for b in range(len(points)):
            x = int(np.floor(c * points[b, 0] - s * points[b, 1] + x0))
            y = int(np.floor(s * points[b, 0] + c * points[b, 1] + y0))
            total += table[y, x] if 0 <= x < columns and 0 <= y < rows else outside
        log_weights[k] += weight * total


@kernel
def refine(points, normals, start, prior, settings, nearest, lines, distance, resolution):  # type: ignore[no-untyped-def]
    """Find the pose (3,) at which `points` (n, 2) lie on the map's lines, starting at `start` with information `prior`.

    `normals` (n, 3) are the normals of the scan's own surfaces, with 1 where there is one: a surface that runs
    another way than the line is not matched. `settings` as in `beam_matching`. Returns the pose, its information
    (3, 3) with the prior's, and how many points found a line.
    """
    rows, columns = distance.shape
    sigma2 = settings[4] ** 2
    pose = start.copy()
    H, g = np.zeros((3, 3)), np.zeros(3)
    matched = 0
    for iteration in range(int(settings[6])):
        shrink = 0.5**iteration
        gate = settings[1] + (settings[0] - settings[1]) * shrink
        robust2 = (settings[3] + (settings[2] - settings[3]) * shrink) ** 2
        H[:] = 0.0
        g[:] = 0.0
        matched = 0
        c, s = np.cos(pose[2]), np.sin(pose[2])
        for b in range(len(points)):
            px, py = points[b, 0], points[b, 1]
            x, y = c * px - s * py + pose[0], s * px + c * py + pose[1]
            column, row = int(np.floor(x / resolution)), int(np.floor(y / resolution))
            if column < 0 or row < 0 or column >= columns or row >= rows or distance[row, column] > gate:
                continue
            line = nearest[row, column]
            if lines[line, 3] == 0.0:
                continue
            nx, ny = lines[line, 0], lines[line, 1]
            if normals[b, 2] > 0.0:
                mx, my = c * normals[b, 0] - s * normals[b, 1], s * normals[b, 0] + c * normals[b, 1]
                if abs(nx * mx + ny * my) < settings[5]:
                    continue
            e = nx * x + ny * y - lines[line, 2]
            w = (robust2 / (robust2 + e * e)) ** 2
            j0, j1 = nx * c + ny * s, -nx * s + ny * c
            j2 = -j0 * py + j1 * px
            H[0, 0] += w * j0 * j0
            H[0, 1] += w * j0 * j1
            H[0, 2] += w * j0 * j2
            H[1, 1] += w * j1 * j1
            H[1, 2] += w * j1 * j2
            H[2, 2] += w * j2 * j2
            g[0] += w * j0 * e
            g[1] += w * j1 * e
            g[2] += w * j2 * e
            matched += 1
        H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
        A = H / sigma2 + prior
        rhs = g / sigma2 + prior @ between(start, pose)
        for k in range(3):
            A[k, k] += 1e-6
        d0, d1, d2 = solve3(A, rhs)
        pose = compose(pose, np.array([-d0, -d1, -d2]))
        if iteration >= 3 and abs(d2) < settings[7] and np.hypot(d0, d1) < settings[8]:
            break
    return pose, H / sigma2 + prior, matched


@kernel
def agreement(points, sensor, pose, reach, kind, distance, resolution):  # type: ignore[no-untyped-def]
    """Count returns (n, 2) (base frame) that agree and that conflict with the map at `pose` (3,).

    A return agrees within `reach` of an obstacle that its beam did not have to pass a wall for; it conflicts in known
    free space, or behind a wall. Others, in unknown space, say nothing. `sensor` (2,) is the sensor in the base frame.
    """
    rows, columns = distance.shape
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x0, y0 = c * sensor[0] - s * sensor[1] + pose[0], s * sensor[0] + c * sensor[1] + pose[1]
    agree, conflict = 0, 0
    for b in range(len(points)):
        x, y = c * points[b, 0] - s * points[b, 1] + pose[0], s * points[b, 0] + c * points[b, 1] + pose[1]
        length = np.hypot(x - x0, y - y0)
        # Steps of the distance to the next obstacle are safe; within half a cell of one the beam goes through it.
        travelled, blocked = 0.0, False
        while travelled < length - 2 * reach:
            fx, fy = x0 + (x - x0) * travelled / length, y0 + (y - y0) * travelled / length
            column, row = int(np.floor(fx / resolution)), int(np.floor(fy / resolution))
            if column < 0 or row < 0 or column >= columns or row >= rows:
                travelled += 1.0
                continue
            if kind[row, column] == 2:
                blocked = True
                break
            travelled += max(distance[row, column] - resolution, 0.5 * resolution)
        column, row = int(np.floor(x / resolution)), int(np.floor(y / resolution))
        if blocked:
            conflict += 1
        elif 0 <= column < columns and 0 <= row < rows:
            if distance[row, column] <= reach:
                agree += 1
            elif kind[row, column] == 1:
                conflict += 1
    return agree, conflict
