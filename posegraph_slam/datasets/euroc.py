"""Inertial measurements and true poses of EuRoC recordings (ASL format): folders of `data.csv` files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray, in_range
from posegraph_slam.datasets.csv_table import read_csv
from posegraph_slam.datasets.number_text import refuse_first, require_in_range
from posegraph_slam.datasets.trajectory_files import read_trajectory
from posegraph_slam.errors import InputError
from posegraph_slam.sensors import Imu, RobotLog

COLUMNS = ("timestamp [ns]", *(f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"),
           *(f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"))  # fmt: skip
IMU, TRUTH = "imu0", "state_groundtruth_estimate0"
MOUNTING = re.compile(r"T_BS:.*?data:\s*\[(.*?)\]", re.DOTALL)


def detects(path: Path) -> bool:
    """Tell whether `path` is such a folder (with or without its mav0), or the data.csv of an IMU."""
    file = _imu_file(path)
    try:
        with file.open("rb") as stream:
            return b"w_RS_S_x" in stream.readline(1024)
    except OSError:
        return False


def read(path: str | Path) -> RobotLog:
    """Read the IMU (rad/s, m/s^2), mounted by its sensor.yaml, and the true poses of the body where they are there.

    The truth is T_ref_base of `state_groundtruth_estimate0`. Raises `InputError` naming file and line.
    """
    path = Path(path)
    file = _imu_file(path)
    if not file.is_file():
        raise InputError(path, f"has no {IMU}/data.csv", "give the folder that holds mav0, or mav0 itself")
    values, numbers = read_csv(file, COLUMNS)
    require_in_range(values, file, numbers)
    truth = file.parent.parent / TRUTH / "data.csv"
    stamps = values[:, 0] / 1e9
    refuse_first(np.diff(stamps, prepend=stamps[:1]) < 0, file, numbers, "the clock runs backwards")
    return RobotLog(
        path=path,
        format="euroc",
        imu=Imu(
            stamps_s=stamps,
            angular_velocity=values[:, 1:4],
            linear_acceleration=values[:, 4:7],
            T_base_imu=_mounting(file.with_name("sensor.yaml")),
        ),
        truth=read_trajectory(truth, format="euroc", parent="ref", child="base") if truth.is_file() else None,
        remarks=() if truth.is_file() else ("there are no true poses",),
    )


def _imu_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    inner = path / "mav0" if (path / "mav0").is_dir() else path
    return inner / "data.csv" if (inner / "data.csv").is_file() else inner / IMU / "data.csv"


def _mounting(file: Path) -> FloatArray:
    """Return T_BS (4, 4) of a sensor.yaml; the identity where there is none."""
    if not file.is_file():
        return np.eye(4)
    found = MOUNTING.search(file.read_text(encoding="utf-8", errors="replace"))
    try:
        T = np.array([float(word) for word in found[1].replace(",", " ").split()]).reshape(4, 4) if found else None
    except ValueError:
        T = None
    if T is None or not in_range(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3:
        raise InputError(file, "holds no pose T_BS of 4 x 4 numbers", "correct it, or remove the file for the identity")
    return T
