"""Rigid transforms in any dimension: inverse, action on points, and the planar forms used by 2D kernels."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray


def inverse_pose(T: FloatArray) -> FloatArray:
    """Invert stacked rigid transforms (..., d+1, d+1)."""
    d = T.shape[-1] - 1
    R_t = np.swapaxes(T[..., :d, :d], -1, -2)
    result = np.zeros_like(T)
    result[..., :d, :d] = R_t
    result[..., :d, d] = -(R_t @ T[..., :d, d, None])[..., 0]
    result[..., d, d] = 1.0
    return result


def transform_points(T_a_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """Map points (..., n, d) from frame b to frame a."""
    d = T_a_b.shape[-1] - 1
    return points_b @ np.swapaxes(T_a_b[..., :d, :d], -1, -2) + T_a_b[..., None, :d, d]


def pose_from_rotation_translation(R: FloatArray, t: FloatArray) -> FloatArray:
    """Stack rotations (..., d, d) and translations (..., d) into transforms (..., d+1, d+1)."""
    d = R.shape[-1]
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), d + 1, d + 1))
    T[..., :d, :d], T[..., :d, d], T[..., d, d] = R, t, 1.0
    return T


def pose_from_xyt(xyt: FloatArray) -> FloatArray:
    """Turn planar poses (..., 3) [x, y, theta] into matrices (..., 3, 3)."""
    xyt = np.asarray(xyt, dtype=np.float64)
    c, s = np.cos(xyt[..., 2]), np.sin(xyt[..., 2])
    T = np.zeros((*xyt.shape[:-1], 3, 3))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2] = c, -s, xyt[..., 0]
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2] = s, c, xyt[..., 1]
    T[..., 2, 2] = 1.0
    return T


def xyt_from_pose(T: FloatArray) -> FloatArray:
    """Turn planar (..., 3, 3) or spatial (..., 4, 4) poses into [x, y, theta] (..., 3); theta is the heading of x."""
    d = T.shape[-1] - 1
    return np.stack([T[..., 0, d], T[..., 1, d], np.arctan2(T[..., 1, 0], T[..., 0, 0])], axis=-1)


def planar_from_spatial(T: FloatArray) -> FloatArray:
    """Project poses (..., 4, 4) onto the xy-plane, keeping the heading: (..., 3, 3)."""
    return pose_from_xyt(xyt_from_pose(T))


def spatial_from_planar(T: FloatArray) -> FloatArray:
    """Lift planar poses (..., 3, 3) to (..., 4, 4) with z, roll and pitch zero."""
    result = np.zeros((*T.shape[:-2], 4, 4))
    result[..., :2, :2], result[..., :2, 3] = T[..., :2, :2], T[..., :2, 2]
    result[..., 2, 2] = result[..., 3, 3] = 1.0
    return result


def wrap_angle(angle_rad: FloatArray) -> FloatArray:
    """Wrap angles into [-pi, pi)."""
    return (np.asarray(angle_rad) + np.pi) % (2 * np.pi) - np.pi
