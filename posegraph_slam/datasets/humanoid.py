"""Logs of the walking humanoid of UPenn ESE650 and UCSD ECE276A: `train_lidar0.mat` beside `train_joint0.mat`.

The LiDAR file is a cell array of structs, one a scan, with time, odometry, resolution, IMU angles and ranges; the
joint file holds the head's angles on their own clock. docs/formats/humanoid.md describes both.
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.coverage import uneven_coverage
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
FIELDS = ("t", "pose", "res", "rpy", "scan")
UNREADABLE = (
    MatReadError,
    ValueError,
    TypeError,
    OSError,
    EOFError,
    KeyError,
    IndexError,
    zlib.error,
    NotImplementedError,
)


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
    from the point of the ground below the body. The logged odometry gives the steps, the IMU the heading. Raises
    InputError naming file and field.
    """
    path = Path(path)
    lidar_path = _locate(path)
    joint_path = lidar_path.with_name(re.sub("lidar", "joint", lidar_path.name, flags=re.IGNORECASE))
    if not joint_path.is_file():
        raise InputError(joint_path, "is missing", "the head's angles are needed to place the scans")
    joints = read_joints(joint_path)
    fields = _lidar_fields(lidar_path)
    stamps, rpy, ranges = fields["t"][:, 0], fields["rpy"], fields["scan"]
    resolution = float(fields["res"][0, 0])
    if not 0 < resolution < 0.2 or np.ptp(fields["res"]) > 1e-9:
        raise InputError(lidar_path, f"field 'res' is {resolution:g} rad", "it must be one positive step for all scans")
    index = joints.nearest(stamps)
    T_base_lidar = lidar_on_level_body(joints.neck_yaw_rad[index], joints.head_pitch_rad[index], rpy[:, 0], rpy[:, 1])
    angles = resolution * (np.arange(ranges.shape[1]) - (ranges.shape[1] - 1) / 2)
    levelled = level_ranges(
        ranges.astype(np.float32),
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
        "headings come from the IMU, steps from the logged odometry",
        *([f"{far} scans are more than {FAR_JOINT_S} s away from the nearest joint sample"] * (far > 0)),
        *uneven_coverage({"scans": stamps, "joints": joints.stamps_s}),
    ]
    return RobotLog(
        path=path,
        format="humanoid",
        scans=scans,
        scan_odometry=imu_odometry(stamps, fields["pose"], rpy[:, 2]),
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
    content = _load(path)
    for name in ("ts", "head_angles"):
        if name not in content:
            raise InputError(path, f"has no field '{name}'", f"it holds {', '.join(_names(content)) or 'nothing'}")
    stamps = np.asarray(content["ts"], dtype=np.float64).reshape(-1)
    angles = np.asarray(content["head_angles"], dtype=np.float64)
    if angles.shape != (2, len(stamps)) or len(stamps) == 0:
        raise InputError(path, f"field 'head_angles' has shape {angles.shape}", f"expected (2, {len(stamps)})")
    if not np.isfinite(angles).all() or not np.isfinite(stamps).all():
        raise InputError(path, "holds angles or stamps that are not finite", "repair the log")
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


def _load(path: Path) -> dict[str, Any]:
    try:
        return dict(loadmat(path, squeeze_me=False))
    except UNREADABLE as error:
        problem = (
            f"cannot be read as a MATLAB file ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
        )
        raise InputError(path, problem, "the file may be truncated: copy it again") from error


def _names(content: dict[str, Any]) -> list[str]:
    return [name for name in content if not name.startswith("__")]


def _lidar_fields(path: Path) -> dict[str, FloatArray]:
    """Stack each field of the scans (N, n); a cell array of structs and a struct array are both understood."""
    content = _load(path)
    if "lidar" not in content:
        raise InputError(path, "has no field 'lidar'", f"it holds {', '.join(_names(content)) or 'nothing'}")
    cells = np.asarray(content["lidar"]).reshape(-1)
    if len(cells) < 2:
        raise InputError(path, f"holds {len(cells)} scans")
    return {name: _stacked(path, cells, name) for name in FIELDS}


def _stacked(path: Path, cells: npt.NDArray[Any], name: str) -> FloatArray:
    rows = []
    for number, cell in enumerate(cells):
        record = cell.reshape(-1)[0] if isinstance(cell, np.ndarray) else cell
        if getattr(record, "dtype", None) is None or record.dtype.names is None or name not in record.dtype.names:
            raise InputError(path, f"scan {number} has no field '{name}'", f"a scan holds {', '.join(FIELDS)}")
        rows.append(np.asarray(record[name], dtype=np.float64).reshape(-1))
    sizes = {len(row) for row in rows}
    wanted = {"t": 1, "res": 1, "pose": 3, "rpy": 3}.get(name)
    if len(sizes) != 1 or wanted not in (None, *sizes) or sizes == {0}:
        raise InputError(
            path, f"field '{name}' has {sorted(sizes)} values", f"expected {wanted or 'one number of beams'}"
        )
    values = np.stack(rows)
    if name != "scan" and not np.isfinite(values).all():
        bad = int(np.argmax(~np.isfinite(values).all(axis=1)))
        raise InputError(path, f"field '{name}' of scan {bad} is not finite", "repair the log")
    return values


def _truth(lidar_path: Path) -> Trajectory | None:
    """Read `truth.tum` beside the file, when there is one."""
    file = lidar_path.with_name("truth.tum")
    return read_tum(file, parent="ref", child="base") if file.is_file() else None
