"""The motion between two sets of paired features: random triples, refined on all pairs that agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.features import Features
from posegraph_slam.registration.rgbd_frame import depth_sigma
from posegraph_slam.registration.rgbd_kernels import left_update

TRIALS = 2000
"""Triples of matches that are tried; with 30 % right ones at least one triple is right with 1 - 1e-6."""
PIXELS_OFF = 3.0
"""A match supports a motion if it lands this near in the image, at the level of the finest octave."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureMotion:
    """T_target_source (4, 4) that `inliers` of `matches` support; meaningless where `found` is False."""

    T_target_source: FloatArray
    matches: int
    inliers: int
    found: bool


def motion_of_matches(
    target: Features, source: Features, pairs: IntArray, *, inliers_min: int, seed: int = 0
) -> FeatureMotion:
    """Find the motion that most matches agree on: random triples (Fischler and Bolles 1981), promising ones refined.

    A match agrees when its point lands within a few pixels in both images and at a depth that noise explains; refining
    minimises those distances in pixels and depths over the matches that agree (Chum et al. 2003).
    """
    if len(pairs) >= max(inliers_min, 3):
        p, q = target.points[pairs[:, 0]], source.points[pairs[:, 1]]
        rng = np.random.default_rng(seed)
        triples = rng.integers(0, len(pairs), (TRIALS, 3))
        T, count = best_motion(p, q, triples, target.camera, source.camera, PIXELS_OFF)
        if count >= inliers_min:
            return FeatureMotion(T_target_source=T, matches=len(pairs), inliers=count, found=True)
    return FeatureMotion(T_target_source=np.eye(4), matches=len(pairs), inliers=0, found=False)


@kernel
def rigid_of_triple(p: FloatArray, q: FloatArray, rows: IntArray, T: FloatArray) -> bool:
    """Write the pose (4, 4) that takes three points q to p, by the frames that they span; False if nearly in line."""
    frames = np.zeros((2, 3, 3))
    for side in range(2):
        points = p if side == 0 else q
        a = points[rows[1]] - points[rows[0]]
        b = points[rows[2]] - points[rows[0]]
        length = np.sqrt(a[0] ** 2 + a[1] ** 2 + a[2] ** 2)
        if length < 0.05:
            return False
        a = a / length
        along = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
        b = b - along * a
        height = np.sqrt(b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
        if height < 0.05:
            return False
        b = b / height
        frames[side, :, 0] = a
        frames[side, :, 1] = b
        frames[side, 0, 2] = a[1] * b[2] - a[2] * b[1]
        frames[side, 1, 2] = a[2] * b[0] - a[0] * b[2]
        frames[side, 2, 2] = a[0] * b[1] - a[1] * b[0]
    for r in range(3):
        for c in range(3):
            T[r, c] = 0.0
            for k in range(3):
                T[r, c] += frames[0, r, k] * frames[1, c, k]
    for r in range(3):
        T[r, 3] = 0.0
        for k in range(3):
            T[r, 3] += p[rows[k], r] / 3.0
            for c in range(3):
                T[r, 3] -= T[r, c] * q[rows[k], c] / 3.0
    return True


@kernel
def agreeing(
    p: FloatArray, q: FloatArray, T: FloatArray, camera_p: FloatArray, camera_q: FloatArray, pixels: float
) -> np.ndarray:
    """Which pairs (n,) land within `pixels` of each other in both images, at depths that fit within four deviations."""
    inside = np.zeros(len(p), np.bool_)
    moved = np.zeros(3)
    for k in range(len(p)):
        fits = True
        for side in range(2):
            camera = camera_p if side == 0 else camera_q
            goal = p[k] if side == 0 else q[k]
            for r in range(3):
                if side == 0:
                    moved[r] = T[r, 0] * q[k, 0] + T[r, 1] * q[k, 1] + T[r, 2] * q[k, 2] + T[r, 3]
                else:
                    moved[r] = (
                        T[0, r] * (p[k, 0] - T[0, 3]) + T[1, r] * (p[k, 1] - T[1, 3]) + T[2, r] * (p[k, 2] - T[2, 3])
                    )
            if moved[2] <= 0.05:
                fits = False
                break
            du = camera[0] * (moved[0] / moved[2] - goal[0] / goal[2])
            dv = camera[1] * (moved[1] / moved[2] - goal[1] / goal[2])
            sigma = depth_sigma(max(goal[2], moved[2])) + 0.005 * goal[2]
            if du * du + dv * dv > pixels * pixels or abs(moved[2] - goal[2]) > 4.0 * sigma:
                fits = False
                break
        inside[k] = fits
    return inside


@kernel
def refined_motion(
    p: FloatArray, q: FloatArray, T: FloatArray, inside: np.ndarray, camera: FloatArray, pixels: float
) -> FloatArray:
    """Gauss-Newton from T on [column, row, depth] of the points q seen in the target, over the pairs inside (n,)."""
    J, e = np.zeros((3, 6)), np.zeros(3)
    for _ in range(3):
        H, g = np.zeros((6, 6)), np.zeros(6)
        for k in range(len(p)):
            if not inside[k]:
                continue
            x = T[0, 0] * q[k, 0] + T[0, 1] * q[k, 1] + T[0, 2] * q[k, 2] + T[0, 3]
            y = T[1, 0] * q[k, 0] + T[1, 1] * q[k, 1] + T[1, 2] * q[k, 2] + T[1, 3]
            z = T[2, 0] * q[k, 0] + T[2, 1] * q[k, 1] + T[2, 2] * q[k, 2] + T[2, 3]
            if z <= 0.05:
                continue
            sigma = np.sqrt(2.0) * depth_sigma(p[k, 2]) + 0.002 * p[k, 2]
            a, b, c = camera[0] / (z * pixels), camera[1] / (z * pixels), 1.0 / (3.0 * sigma)
            e[0], e[1], e[2] = a * x - a * z * p[k, 0] / p[k, 2], b * y - b * z * p[k, 1] / p[k, 2], c * (z - p[k, 2])
            J[:] = 0.0
            J[0, 3], J[0, 5] = a, -a * x / z
            J[1, 4], J[1, 5] = b, -b * y / z
            J[2, 5] = c
            for r in range(3):
                J[r, 0] = y * J[r, 5] - z * J[r, 4]
                J[r, 1] = z * J[r, 3] - x * J[r, 5]
                J[r, 2] = x * J[r, 4] - y * J[r, 3]
                weight = 1.0 / (1.0 + e[r] * e[r])
                for i in range(6):
                    g[i] += weight * e[r] * J[r, i]
                    for j in range(6):
                        H[i, j] += weight * J[r, i] * J[r, j]
        for i in range(6):
            H[i, i] += 1e-6 * H[i, i] + 1e-9
        step = np.asarray(-np.linalg.solve(H, g))
        if not np.isfinite(step).all():
            break
        T = left_update(T, step)
    return T


@kernel
def best_motion(
    p: FloatArray, q: FloatArray, triples: IntArray, camera_p: FloatArray, camera_q: FloatArray, pixels: float
) -> tuple[FloatArray, int]:
    """Pose (4, 4) with the most agreeing pairs, the first of equals, and their number.

    Triples (trials, 3) that come near the best so far are refined on their agreeing pairs while these grow in number.
    """
    best, most, raw, needed = np.eye(4), 0, 0, float(len(triples))
    T = np.eye(4)
    for trial in range(len(triples)):
        if trial >= needed:
            break
        if not rigid_of_triple(p, q, triples[trial], T):
            continue
        inside = agreeing(p, q, T, camera_p, camera_q, pixels)
        count = int(inside.sum())
        if count < 4 or count < 0.7 * raw:
            continue
        raw = max(raw, count)
        now = T.copy()
        for _ in range(6):
            refined = refined_motion(p, q, now, inside, camera_p, pixels)
            again = agreeing(p, q, refined, camera_p, camera_q, pixels)
            grown = int(again.sum())
            if grown < count:
                break
            done = grown == count
            now, inside, count = refined, again, grown
            if done:
                break
        if count > most:
            most = count
            best[:] = now
            # triples that it takes to meet one of right matches with a chance of 1 - 1e-6, three times over
            right = min((most / len(p)) ** 3, 0.999)
            needed = 3.0 * np.log(1e-6) / np.log(1.0 - right)
    return best, most
