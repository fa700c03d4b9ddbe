"""Exact motion of a differential-drive robot from the travel of its sides."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE2, pose_from_xyt


def motion_steps(distance_m: FloatArray, turn_rad: FloatArray) -> FloatArray:
    """Motions (N, 3, 3) exp([d, 0, a]) of a robot that drives an arc of length d (N,) and turns by a (N,) on it."""
    return SE2.exp(np.stack([distance_m, np.zeros_like(distance_m), turn_rad], axis=-1))


def integrate_motion(distance_m: FloatArray, turn_rad: FloatArray) -> FloatArray:
    """Poses (N+1, 3, 3), the first the identity, of T_k+1 = T_k exp([d_k, 0, a_k]), exact for arcs.

    With tau the duration of a step and [v, 0, omega] its twist, d = tau v and a = tau omega. In the plane headings
    add and displacements add once turned by the heading before them, so that no loop over poses is needed.
    """
    step = motion_steps(distance_m, turn_rad)[:, :2, 2]
    heading = np.concatenate([[0.0], np.cumsum(turn_rad)])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    xyt = np.zeros((len(heading), 3))
    np.cumsum(c * step[:, 0] - s * step[:, 1], out=xyt[1:, 0])
    np.cumsum(s * step[:, 0] + c * step[:, 1], out=xyt[1:, 1])
    xyt[:, 2] = heading
    return pose_from_xyt(xyt)


def wheel_distance(travel_m: FloatArray) -> FloatArray:
    """Distance (N,) of the robot's middle from the travel (N, 2) of its left and right side."""
    return np.asarray(travel_m.mean(axis=1))


def wheel_difference(travel_m: FloatArray) -> FloatArray:
    """Travel (N,) of the right side beyond the left; over the track width it is the turn, positive to the left."""
    return np.asarray(travel_m[:, 1] - travel_m[:, 0])
