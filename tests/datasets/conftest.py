"""Small synthetic logs in each format, written from known arrays."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from posegraph_slam.datasets.simulation.humanoid import write_humanoid_log
from posegraph_slam.datasets.simulation.rgbd_room import (
    furnished_room,
    loop_through_room,
    small_camera,
    write_rgbd_log,
)

from .bag_writing import maker_of, robot, store_as

EPOCH_S = 1298445274.5


def write_ece276a(folder: Path, run: str = "7", scans: int = 12, beams: int = 31, **overrides: Any) -> Path:
    """Write a run; `overrides` such as `Imu__time_stamps` replace a field, or drop it (or the file) when None."""
    rng = np.random.default_rng(3)
    stamps = EPOCH_S + 0.025 * np.arange(scans)
    angles = np.deg2rad(135.0)
    ranges = rng.uniform(1.0, 5.0, (beams, scans)).astype(np.float32)
    ranges[0, 0], ranges[1, 0] = 0.001, 60.0
    files: dict[str, dict[str, Any]] = {
        "Encoders": {"counts": rng.integers(-3, 12, (4, scans)).astype(np.int16), "time_stamps": stamps},
        "Imu": {
            "angular_velocity": rng.normal(0, 0.1, (3, 4 * scans)),
            "linear_acceleration": np.array([[0.0], [0.0], [1.01]]) + rng.normal(0, 0.01, (3, 4 * scans)),
            "time_stamps": EPOCH_S + 0.00625 * np.arange(4 * scans),
        },
        "Hokuyo": {
            "angle_min": np.array(-angles),
            "angle_max": np.array([angles]),
            "angle_increment": np.array([[2 * angles / (beams - 1)]]),
            "range_min": np.array(0.1),
            "range_max": np.array([[30.0]]),
            "ranges": ranges,
            "time_stamps": stamps + 0.001,
        },
        "Kinect": {"disparity_time_stamps": stamps[::2], "rgb_time_stamps": stamps[::3]},
    }
    for key, value in overrides.items():
        file, _, name = key.partition("__")
        if not name:
            del files[file]
        elif value is None:
            del files[file][name]
        else:
            files[file][name] = value
    folder.mkdir(parents=True, exist_ok=True)
    for file, fields in files.items():
        np.savez(folder / f"{file}{run}.npz", **fields)
    return folder


def flaser(
    k: int, beams: int = 180, *, offset: float = 0.1, name: str = "FLASER", yaw: float = 0.0, far: float = 81.83
) -> str:
    """One laser message: the robot on a circle, the laser `offset` ahead of it, every tenth beam without return."""
    theta = 0.1234567 * k  # headings whose sixth digit is rounded up and down
    robot = (np.cos(theta), np.sin(theta), theta + 0.5)
    laser = (robot[0] + offset * np.cos(robot[2]), robot[1] + offset * np.sin(robot[2]), robot[2] + yaw)
    ranges = [f"{far:.2f}" if (b + k) % 10 == 0 else f"{1 + 0.01 * ((b * 7 + k) % 300):.2f}" for b in range(beams)]
    poses = " ".join(f"{value:.6f}" for value in (*laser, *robot))
    return f"{name} {beams} {' '.join(ranges)} {poses} {1000.0 + 0.2 * k:.6f} host {0.2 * k:.6f}"


def robotlaser(k: int, beams: int = 20, remissions: int = 0) -> str:
    """One ROBOTLASER1 message with the laser 0.2 m ahead."""
    x = 0.1 * k
    ranges = " ".join("20.00" if b == 0 else f"{2 + 0.01 * b + 0.1 * k:.2f}" for b in range(beams))
    extra = " ".join(str(b) for b in range(remissions))
    return (
        f"ROBOTLASER1 0 -2.0 4.0 0.2 20.0 0.01 0 {beams} {ranges} {remissions} {extra}{' ' * bool(extra)}"
        f"{x + 0.2:.6f} 0 0 {x:.6f} 0 0 0.5 0 0.1 0.1 1e6 {2000 + 0.1 * k:.6f} host {0.1 * k:.6f}"
    )


def odom(k: int) -> str:
    """One odometry message."""
    return f"ODOM {0.05 * k:.6f} 0.0 0.0 0.5 0.0 0.0 {1000 + 0.1 * k:.6f} host {0.1 * k:.6f}"


def write_lines(path: Path, lines: list[str]) -> Path:
    """Write lines, compressed when the name ends with .gz."""
    text = ("\n".join(lines) + "\n").encode()
    path.write_bytes(gzip.compress(text, mtime=0) if path.suffix == ".gz" else text)
    return path


def write_carmen(path: Path, scans: int = 30) -> Path:
    """Write a log with comments, parameters, odometry and front laser."""
    lines = ["# a log", "PARAM robot_frontlaser_offset 0.1 nohost 0", "SYNC start 1 host 0", ""]
    for k in range(scans):
        lines += [odom(2 * k), flaser(k), odom(2 * k + 1)]
    return write_lines(path, lines)


def write_imu_vicon(path: Path, samples: int = 300) -> Path:
    """Write a run of raw IMU counts at rest, with its truth."""
    stamps = 1.3e9 + 0.01 * np.arange(samples)
    counts = np.tile(np.array([[511], [501], [605], [370], [374], [375]], dtype=np.uint16), (1, samples))
    R = np.repeat(np.eye(3)[:, :, None], samples, axis=2)
    np.savez(path, imu_raw=counts, imu_stamps_s=stamps, vicon_rotation=R, vicon_stamps_s=stamps)
    return path


def write_euroc(folder: Path, samples: int = 50) -> Path:
    """Write the IMU and true poses of a sequence."""
    imu, truth = (folder / "mav0" / name for name in ("imu0", "state_groundtruth_estimate0"))
    imu.mkdir(parents=True)
    truth.mkdir()
    stamps = [1_403_636_579_758_555_392 + 5_000_000 * k for k in range(samples)]
    quantities = (("w_RS_S", "rad s^-1"), ("a_RS_S", "m s^-2"))
    columns = ",".join(f"{name}_{axis} [{unit}]" for name, unit in quantities for axis in "xyz")
    rows = [f"{stamp},{0.01 * k:.12f},-0.2,0.3,0.5,0.125,9.81" for k, stamp in enumerate(stamps)]
    (imu / "data.csv").write_text("\n".join([f"#timestamp [ns],{columns}", *rows]) + "\n")
    (imu / "sensor.yaml").write_text(
        "sensor_type: imu\nT_BS:\n  cols: 4\n  rows: 4\n  data: [0.0, -1.0, 0.0, 0.1,\n         1.0, 0.0, 0.0, 0.2,\n"
        "         0.0, 0.0, 1.0, 0.3,\n         0.0, 0.0, 0.0, 1.0]\n"
    )
    poses = [f"{stamp},{0.1 * k},0,1,1,0,0,0,0.5,0,0,0,0,0,0,0,0" for k, stamp in enumerate(stamps)]
    (truth / "data.csv").write_text("#timestamp, p_RS_R_x [m], and more\n" + "\n".join(poses) + "\n")
    return folder


def write_rgbd(folder: Path, frames: int = 4) -> Path:
    """Write a folder of small colour and depth images with intrinsics and true poses."""
    return write_rgbd_log(folder, furnished_room(), small_camera(40, 30), loop_through_room(frames))


def build(name: str, folder: Path) -> Path:
    """Write a small log of the format called `name`."""
    folder.mkdir(parents=True, exist_ok=True)
    return {
        "ece276a": lambda: write_ece276a(folder / "run"),
        "carmen": lambda: write_carmen(folder / "log.clf"),
        "imu_vicon": lambda: write_imu_vicon(folder / "run.npz"),
        "rosbag": lambda: store_as("ros1", folder, robot(maker_of("ros1"))),
        "euroc": lambda: write_euroc(folder / "sequence"),
        "humanoid": lambda: write_humanoid_log(folder, rng=np.random.default_rng(1), scans=12, beams=241),
        "rgbd": lambda: write_rgbd(folder / "sequence"),
    }[name]()


def build_truncated(name: str, folder: Path) -> tuple[Path, Path]:
    """Write a log whose last bytes are missing; return its path and the file that the error has to name."""
    folder.mkdir(parents=True, exist_ok=True)
    path = write_carmen(folder / "log.clf.gz") if name == "carmen" else build(name, folder)
    file = path
    if path.is_dir():
        file = path / {"euroc": "mav0/imu0/data.csv", "rgbd": "depth/00002.png"}.get(name, "Hokuyo7.npz")
    file.write_bytes(file.read_bytes()[:-100])
    return path, file


@pytest.fixture
def ece276a_log() -> Callable[..., Path]:
    return write_ece276a


@pytest.fixture
def carmen_lines() -> dict[str, Callable[..., Any]]:
    return {"flaser": flaser, "robotlaser": robotlaser, "odom": odom, "write": write_lines}


@pytest.fixture
def rgbd_log() -> Callable[..., Path]:
    return write_rgbd


@pytest.fixture
def log_builder() -> Callable[[str, Path], Path]:
    return build


@pytest.fixture
def truncated_log_builder() -> Callable[[str, Path], tuple[Path, Path]]:
    return build_truncated
