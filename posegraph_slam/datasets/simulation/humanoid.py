"""A simulated walk of the humanoid, in the files that the course ships."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.io import savemat

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.files import replacing
from posegraph_slam.geometry import Trajectory, pose_from_xyt, spatial_from_planar
from posegraph_slam.sensors.humanoid import lidar_on_level_body

WALLS = np.array([
    [-3.0, -2.0, 9.0, -2.0], [9.0, -2.0, 9.0, 5.0], [9.0, 5.0, -3.0, 5.0], [-3.0, 5.0, -3.0, -2.0],
    [2.0, 1.0, 3.0, 1.0], [3.0, 1.0, 3.0, 2.0], [3.0, 2.0, 2.0, 2.0], [2.0, 2.0, 2.0, 1.0], [6.0, 5.0, 6.0, 3.2],
])  # fmt: skip
"""Walls (W, 4) [x0, y0, x1, y1]: a hall with a pillar and a spur."""
RESOLUTION_RAD, START_S, RATE_HZ = 0.00436332312998582, 1.3e9, 20.0
NO_RETURN_M = 0.0


def write_humanoid_log(
    folder: Path,
    *,
    rng: np.random.Generator,
    scans: int = 200,
    beams: int = 1081,
    noise_m: float = 0.01,
    steps: bool = False,
) -> Path:
    """Write `train_lidar0.mat`, `train_joint0.mat` and `truth.tum` of a walk; return the path of the LiDAR file.

    The body walks an ellipse about the pillar, rolling and pitching with its steps while the head pans and nods far
    enough to see the ground. The odometry's yaw drifts, the IMU's does not; the joints have a clock of their own.
    With `steps` the file has the form with `delta_pose`, which knows no IMU: the body then stays upright.
    """
    time = np.arange(scans) / RATE_HZ
    path = _walk(time)
    roll, pitch = 0.03 * np.sin(9 * time), 0.02 * np.cos(7 * time)
    if steps:
        roll, pitch = np.zeros(scans), np.zeros(scans)
    joint_time = np.arange(-0.05, time[-1] + 0.05, 0.0083) + 0.0011
    neck, head = 0.6 * np.sin(0.8 * joint_time), 0.15 + 0.15 * np.sin(0.5 * joint_time)
    nearest = np.abs(joint_time[None] - time[:, None]).argmin(axis=1)
    T_base_lidar = lidar_on_level_body(neck[nearest], head[nearest], roll, pitch)
    T = spatial_from_planar(pose_from_xyt(path)) @ T_base_lidar
    angles: FloatArray = RESOLUTION_RAD * (np.arange(beams, dtype=np.float64) - (beams - 1) / 2)
    ranges = _cast(T, angles)
    hit = ranges < 30.0
    ranges = np.where(hit, ranges + noise_m * rng.standard_normal(ranges.shape), NO_RETURN_M)
    odometry = _drifting(path, rng)
    cells = np.empty((1, scans), dtype=object)
    for k in range(scans):
        common = {"t": np.array([[START_S + time[k]]]), "scan": ranges[k][None]}
        if steps:
            cells[0, k] = {**common, "delta_pose": odometry[k][None] - odometry[max(k - 1, 0)]}
        else:
            cells[0, k] = {
                "t": common["t"],
                "pose": odometry[k][None],
                "res": np.array([[RESOLUTION_RAD]]),
                "rpy": np.array([[roll[k], pitch[k], path[k, 2] + 1.0]]),  # the IMU's zero is anywhere
                "scan": common["scan"],
            }
    with replacing(folder / "train_lidar0.mat") as temporary:
        savemat(temporary, {"lidar": cells}, do_compression=True)
    with replacing(folder / "train_joint0.mat") as temporary:
        savemat(temporary, {"ts": START_S + joint_time[None], "head_angles": np.stack([neck, head])})
    truth = Trajectory(stamps_s=START_S + time, poses=pose_from_xyt(path), parent="ref", child="base")
    write_tum(truth, folder / "truth.tum")
    return folder / "train_lidar0.mat"


def _walk(time: FloatArray) -> FloatArray:
    """Poses (N, 3) along an ellipse about the pillar at 0.5 m/s or so, heading along it."""
    angle = 0.17 * time - np.pi / 2
    x, y = 2.8 + 3.2 * np.cos(angle), 1.5 + 2.0 * np.sin(angle)
    heading = np.unwrap(np.arctan2(2.0 * np.cos(angle), -3.2 * np.sin(angle)))
    return np.stack([x, y, heading], axis=1)


def _drifting(path: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Odometry (N, 3) of the walk whose heading drifts by 2 degrees a second and whose steps slip by 1 %."""
    c, s = np.cos(path[:-1, 2]), np.sin(path[:-1, 2])
    d = np.diff(path, axis=0)
    ahead, left = c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]
    slip = 1 + 0.01 * rng.standard_normal(len(d))
    heading = np.concatenate([[0.0], np.cumsum(d[:, 2] + np.deg2rad(2.0) / RATE_HZ)])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    odometry = np.zeros_like(path)
    odometry[1:, 0] = np.cumsum(slip * (c * ahead - s * left))
    odometry[1:, 1] = np.cumsum(slip * (s * ahead + c * left))
    odometry[:, 2] = heading
    return odometry


def _cast(T: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Ranges (N, B) of beams in the lidar's plane, placed by T (N, 4, 4), to upright walls and the ground."""
    local = np.stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros_like(angles_rad)])
    directions = np.einsum("nij,jb->nbi", T[:, :3, :3], local)
    origin = T[:, None, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        down = -origin[..., 2] / directions[..., 2]
        ranges = np.where(down > 0, down, np.inf)
        for x0, y0, x1, y1 in WALLS:
            ex, ey = x1 - x0, y1 - y0
            wx, wy = x0 - origin[..., 0], y0 - origin[..., 1]
            cross = directions[..., 0] * ey - directions[..., 1] * ex
            along = (wx * ey - wy * ex) / cross
            part = (wx * directions[..., 1] - wy * directions[..., 0]) / cross
            ranges = np.where((along > 0) & (part >= 0) & (part <= 1) & (along < ranges), along, ranges)
    return ranges
