"""Rotations spread evenly over SO(3), and a frame of a cloud that turns with it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray

PSI = 1.533751168755204288118041413
"""Root of psi^4 = psi + 4 of the spiral (Alexa 2022)."""


def spread_rotations(count: int) -> FloatArray:
    """Return `count` rotations (count, 3, 3) evenly over all orientations, the same at every call.

    The super-Fibonacci spiral on unit quaternions (Alexa 2022, algorithm 1); 2000 of them leave no orientation
    farther than 14 degrees from one.
    """
    s = np.arange(count) + 0.5
    t = s / max(count, 1)
    d = 2.0 * np.pi * s
    r, big_r = np.sqrt(t), np.sqrt(1.0 - t)
    alpha, beta = d / np.sqrt(2.0), d / PSI
    quat_xyzw = np.column_stack([r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)])
    return np.asarray(Rotation.from_quat(quat_xyzw.reshape(-1, 4)).as_matrix()).reshape(-1, 3, 3)


def yaw_rotations(count: int) -> FloatArray:
    """Return `count` turns (count, 3, 3) about z, from 0 in equal steps."""
    return np.asarray(Rotation.from_euler("z", 2 * np.pi * np.arange(count)[:, None] / count).as_matrix())


def principal_frame(points: FloatArray) -> FloatArray:
    """Return T_cloud_principal (4, 4): origin at the mean of points (n, 3), axes along their variances, falling.

    The signs of the first two axes make the third moments along them positive, the third axis completes a right hand.
    A cloud that is moved as a whole moves this frame with it, rounding and exact symmetries apart.
    """
    centre = points.mean(axis=0)
    centred = points - centre
    _, vectors = np.linalg.eigh(centred.T @ centred)
    axes = vectors[:, ::-1].copy()
    along = centred @ axes
    skewness = np.sum(along * along * along, axis=0)
    axes *= np.where(skewness < 0, -1.0, 1.0)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = axes, centre
    return T
