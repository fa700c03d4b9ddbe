"""Logs of the walking humanoid of UPenn ESE650 and UCSD ECE276A: `train_lidar0.mat` beside `train_joint0.mat`.

The LiDAR file holds a struct a scan; the joint file holds the head's angles on their own clock.
docs/formats/humanoid.md describes both.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray, in_range, single
from posegraph_slam.datasets.coverage import uneven_coverage
from posegraph_slam.datasets.humanoid_lidar import read_lidar
from posegraph_slam.datasets.matlab import load_mat, numbers, require
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, Trajectory, pose_from_xyt
from posegraph_slam.sensors import LaserScans, RobotLog
from posegraph_slam.sensors.humanoid import JointAngles, lidar_on_level_body
from posegraph_slam.sensors.level_scans import level_ranges

LIDAR_FILE = re.compile(r"(\w*?)_?lidar(\d*)\.mat", re.IGNORECASE)
RANGE_MIN_M, RANGE_MAX_M = 0.1, 30.0
"""Hokuyo UTM-30LX."""
GROUND_M = 0.1
"""Returns lower than this hit the ground."""
FAR_JOINT_S = 0.1
"""A joint sample further away than this from its scan deserves a remark."""
HEADINGS = {
    True: "headings come from the IMU, steps from the logged odometry",
    False: "the file has no IMU angles: headings come from the logged odometry, and the body counts as upright",
}


def detects(path: Path) -> bool:
    """Tell whether `path` is a LiDAR file of this format or a folder with one."""
    try:
        names = [entry.name for entry in path.iterdir()] if path.is_dir() else [path.name] * path.is_file()
    except OSError:
        return False
    return any(LIDAR_FILE.fullmatch(name) for name in names)


def read(path: str | Path) -> RobotLog:
    """Read a LiDAR file (or the folder's only one) with its joint file into level scans and odometry.

    Every scan is placed by the nearest joint sample and the IMU's roll and pitch, freed of ground hits, and seen again
    from the point of the ground below the body. The logged odometry gives the steps, the IMU the heading; files
    without IMU angles have the body upright and the odometry's heading. Raises InputError naming file and field.
    """
    path = Path(path)
    lidar_path = _locate(path)
    joints = read_joints(_joint_path(lidar_path))
    records = read_lidar(lidar_path)
    stamps, ranges = records.stamps_s, records.ranges_m
    tilt = np.zeros((len(stamps), 3)) if records.rpy_rad is None else records.rpy_rad
    index = joints.nearest(stamps)
    T_base_lidar = lidar_on_level_body(joints.neck_yaw_rad[index], joints.head_pitch_rad[index], tilt[:, 0], tilt[:, 1])
    angles = records.resolution_rad * (np.arange(ranges.shape[1]) - (ranges.shape[1] - 1) / 2)
    levelled = level_ranges(
        single(ranges),
        angles,
        T_base_lidar,
        heights_m=(GROUND_M, np.inf),
        limits_m=np.array([RANGE_MIN_M, RANGE_MAX_M]),
    )
    level, dropped = levelled.ranges_m, levelled.too_low
    scans = LaserScans(
        stamps_s=stamps,
        ranges_m=level,
        angle_min_rad=-np.pi,
        angle_increment_rad=2 * np.pi / level.shape[1],
        range_min_m=RANGE_MIN_M,
        range_max_m=RANGE_MAX_M,
        T_base_lidar=np.eye(4),
    )
    far = int((np.abs(joints.stamps_s[index] - stamps) > FAR_JOINT_S).sum())
    remarks = [
        f"{dropped} returns of {ranges.size} hit the ground and were dropped",
        HEADINGS[records.rpy_rad is not None],
        *([f"{far} scans are more than {FAR_JOINT_S} s away from the nearest joint sample"] * (far > 0)),
        *uneven_coverage({"scans": stamps, "joints": joints.stamps_s}),
    ]
    return RobotLog(
        path=path,
        format="humanoid",
        scans=scans,
        scan_odometry=imu_odometry(stamps, records.pose, (records.pose if records.rpy_rad is None else tilt)[:, 2]),
        truth=_truth(lidar_path),
        remarks=tuple(remarks),
    )


def imu_odometry(stamps_s: FloatArray, pose: FloatArray, yaw_rad: FloatArray) -> Trajectory:
    """Chain the steps of logged odometry poses (N, 3) along the IMU's heading (N,), from the origin.

    A step is R(theta)^T (p' - p) in the body's own frame; it is laid along the IMU's heading, which drifts far less.
    """
    logged = pose_from_xyt(pose)
    steps = SE2.between(logged[:-1], logged[1:])[:, :2, 2]
    heading = np.unwrap(yaw_rad) - yaw_rad[0]
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    xyt = np.zeros((len(stamps_s), 3))
    xyt[1:, 0] = np.cumsum(c * steps[:, 0] - s * steps[:, 1])
    xyt[1:, 1] = np.cumsum(s * steps[:, 0] + c * steps[:, 1])
    xyt[:, 2] = heading
    return Trajectory(stamps_s=stamps_s, poses=pose_from_xyt(xyt), parent="odom", child="base")


def read_joints(path: str | Path) -> JointAngles:
    """Read a joint file: `ts` (1, N) seconds and `head_angles` (2, N) neck yaw and head pitch in radians.

    Other fields of the file (acc, gyro, rpy, pos, ft_l, ft_r) are left alone. Raises InputError naming file and field.
    """
    path = Path(path)
    content = load_mat(path)
    stamps = numbers(require(content, "ts", path), "ts", path).reshape(-1)
    angles = numbers(require(content, "head_angles", path), "head_angles", path)
    if angles.shape != (2, len(stamps)) or len(stamps) == 0:
        raise InputError(path, f"field 'head_angles' has shape {angles.shape}", f"expected (2, {len(stamps)})")
    if not in_range(angles).all() or not in_range(stamps).all():
        raise InputError(path, "holds angles or stamps that are not finite, or far too large", "repair the log")
    if (np.diff(stamps) < 0).any():
        raise InputError(path, f"the clock in 'ts' runs backwards at index {int(np.argmax(np.diff(stamps) < 0)) + 1}")
    return JointAngles(stamps_s=stamps, neck_yaw_rad=angles[0], head_pitch_rad=angles[1])


def _locate(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = sorted(entry for entry in path.iterdir() if LIDAR_FILE.fullmatch(entry.name))
    if len(found) != 1:
        names = ", ".join(entry.name for entry in found) or "none"
        raise InputError(path, f"holds {len(found)} LiDAR files ({names})", "give the file of the run you mean")
    return found[0]


def _joint_path(lidar_path: Path) -> Path:
    """Return the joint file beside the LiDAR file, or in the folder `joint` beside its folder `lidar`."""
    beside = lidar_path.with_name(re.sub("lidar", "joint", lidar_path.name, flags=re.IGNORECASE))
    folder = lidar_path.resolve().parent
    apart = folder.with_name("joint") / beside.name
    if folder.name == "lidar" and apart.is_file() and not beside.is_file():
        return apart
    if not beside.is_file():
        raise InputError(beside, "is missing", "the head's angles are needed to place the scans")
    return beside


def _truth(lidar_path: Path) -> Trajectory | None:
    """Read `truth.tum` beside the file, when there is one."""
    file = lidar_path.with_name("truth.tum")
    return read_tum(file, parent="ref", child="base") if file.is_file() else None
