"""CARMEN logs written from any log with a laser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.relations import write_relations
from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.errors import InputError
from posegraph_slam.files import replacing
from posegraph_slam.geometry import Trajectory, planar_from_spatial, xyt_from_pose
from posegraph_slam.sensors import LaserScans, RobotLog

HOST = "psg"
RANGE_DIGITS = 4
"""Ranges are written to 0.1 mm, a hundredth of what any laser resolves."""


def write_carmen(log: RobotLog, path: Path, odometry: Trajectory) -> None:
    """Write scans, with `odometry` (N, 3, 3) at each of them, and the log's ODOM stream, in recorded order.

    Fans that CARMEN derives from the number of beams (180 degrees from -90 on) become FLASER, all others ROBOTLASER1,
    which states its angles. Dropouts become 0, beams without return the maximum range. True poses and relations go
    beside the log, as NAME.tum and NAME.relations. Raises `InputError` for a log without scans.
    """
    scans = log.scans
    if scans is None or len(odometry) != len(scans):
        raise InputError(log.path, "has no laser scans with odometry", "a CARMEN log needs them")
    with replacing(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as file:
        name = log.path.name.encode("ascii", "replace").decode()
        file.write(f"# written by posegraph_slam from {log.format} log {name}\n")
        file.write(f"PARAM robot_front_laser_max {scans.range_max_m!r} {HOST} 0\n")
        file.writelines(_merged(_scan_lines(scans, odometry), scans.stamps_s, _odom_lines(log), _odom_stamps(log)))
    if log.truth is not None:
        write_tum(log.truth, path.with_suffix(".tum"))
    if log.relations is not None:
        write_relations(log.relations, path.with_suffix(".relations"))


def _merged(scans: Iterator[str], scan_s: FloatArray, odometry: Iterator[str], odom_s: FloatArray) -> Iterator[str]:
    """Yield odometry before the first scan that is not earlier; both keep their own order."""
    sent = 0
    for line, stamp in zip(scans, scan_s.tolist(), strict=True):
        while sent < len(odom_s) and odom_s[sent] <= stamp:
            yield next(odometry)
            sent += 1
        yield line
    yield from odometry


def _scan_lines(scans: LaserScans, odometry: Trajectory) -> Iterator[str]:
    mounting = planar_from_spatial(scans.T_base_lidar)
    robot, laser = xyt_from_pose(odometry.poses).tolist(), xyt_from_pose(odometry.poses @ mounting).tolist()
    short = derived_from_count(scans)
    field = scans.angle_increment_rad * (scans.beams - 1)
    head = f"0 {scans.angle_min_rad!r} {field!r} {scans.angle_increment_rad!r} {scans.range_max_m!r} 0.01 0"
    for k, stamp in enumerate(scans.stamps_s.tolist()):
        ranges = scans.ranges_m[k].astype(np.float64)
        missing = ~scans.returns(slice(k, k + 1))[0]
        with np.errstate(invalid="ignore"):
            ranges[missing] = np.where(ranges[missing] < scans.range_min_m, 0.0, scans.range_max_m)
        values = " ".join(map(repr, np.round(ranges, RANGE_DIGITS).tolist()))
        first, second = " ".join(map(repr, laser[k])), " ".join(map(repr, robot[k]))
        end = f"{stamp:.6f} {HOST} {stamp:.6f}\n"
        if short:
            yield f"FLASER {scans.beams} {values} {first} {second} {end}"
        else:
            yield f"ROBOTLASER1 {head} {scans.beams} {values} 0 {first} {second} 0 0 0 0 1e6 {end}"


def derived_from_count(scans: LaserScans) -> bool:
    """Whether the fan is the one that readers of FLASER derive from the number of its beams."""
    start, step = -np.pi / 2, np.pi / max(scans.beams - scans.beams % 2, 1)
    same = abs(scans.angle_min_rad - start) < 1e-6 and abs(scans.angle_increment_rad - step) < 1e-6
    return same and scans.beams not in (400, 401)


def _odom_stamps(log: RobotLog) -> FloatArray:
    return log.odometry.stamps_s if log.odometry is not None else np.empty(0)


def _odom_lines(log: RobotLog) -> Iterator[str]:
    if log.odometry is None:
        return
    poses = xyt_from_pose(log.odometry.poses).tolist()
    for pose, stamp in zip(poses, log.odometry.stamps_s.tolist(), strict=True):
        yield f"ODOM {' '.join(map(repr, pose))} 0 0 0 {stamp:.6f} {HOST} {stamp:.6f}\n"
