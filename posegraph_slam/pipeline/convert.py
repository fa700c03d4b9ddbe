"""From one format to another: trajectories, whole logs, and point clouds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from posegraph_slam.datasets import read
from posegraph_slam.datasets.carmen_writing import write_carmen
from posegraph_slam.datasets.clouds import is_cloud, read_cloud
from posegraph_slam.datasets.ece276a_writing import write_ece276a
from posegraph_slam.datasets.ply import write_ply
from posegraph_slam.datasets.registry import recognised
from posegraph_slam.datasets.rgbd_writing import write_rgbd
from posegraph_slam.datasets.trajectory_files import (
    TRAJECTORY_FORMATS,
    format_of_suffix,
    read_trajectory,
    write_trajectory,
)
from posegraph_slam.errors import InputError, did_you_mean
from posegraph_slam.geometry import Trajectory
from posegraph_slam.odometry.scan_odometry import chosen_source, odometry_at_scans
from posegraph_slam.pipeline.run_directory import RECORD
from posegraph_slam.sensors import RobotLog

LOG_FORMATS = ("carmen", "ece276a", "rgbd")
FOLDERS = {"ece276a": "Hokuyo*.npz", "rgbd": "depth.txt"}
"""Formats that are folders, and a file by which one of ours is known."""
TARGETS = (*TRAJECTORY_FORMATS, *LOG_FORMATS, "ply")
STREAMS = ("odometry", "truth")
LOG_SUFFIXES = {".clf": "carmen", ".log": "carmen", ".ply": "ply", "": "ece276a"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Conversion:
    """What was written: format, path, how many poses, scans or points, and remarks for people."""

    target: Path
    format: str
    count: int
    unit: str
    remarks: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the record for JSON."""
        return {"target": str(self.target), "format": self.format, self.unit: self.count, "remarks": list(self.remarks)}


@dataclass(frozen=True, slots=True, kw_only=True)
class ConversionOptions:
    """How the source is read: `source_format` of a trajectory or log, KITTI's stamps, topics of a bag, the stream."""

    source_format: str | None = None
    times: Path | None = None
    topics: Mapping[str, str] | None = None
    stream: str = "odometry"


def convert(
    source: Path,
    target: Path,
    *,
    to: str | None = None,
    options: ConversionOptions | None = None,
    overwrite: bool = False,
) -> Conversion:
    """Write `source` to `target` in the format `to`, or in that of the target's suffix.

    Trajectory files and run directories (their trajectory) become tum, kitti, euroc or csv; logs become carmen, ece276a
    or rgbd (their colour and depth images), or a trajectory: their odometry or truth (`options.stream`); clouds become
    ply. Raises InputError naming what does not fit, and where `target` exists and `overwrite` is not set.
    """
    options = options or ConversionOptions()
    name = target_format(target, to)
    if not source.exists():
        raise InputError(source, "no such file or folder", "check the path")
    if target.exists() and (not overwrite or target.is_dir() != (name in FOLDERS)):
        raise InputError(target, "exists", "add --overwrite to replace a file, or choose another target")
    if target.is_dir() and not any(target.glob(FOLDERS[name])) and any(target.iterdir()):
        raise InputError(target, "is a folder of other things", "choose another target; it is not overwritten")
    if name in TRAJECTORY_FORMATS:
        trajectory, remarks = source_trajectory(source, options)
        write_trajectory(trajectory, target, format=name)
        return Conversion(target=target, format=name, count=len(trajectory), unit="poses", remarks=remarks)
    if name == "ply":
        cloud = read_cloud(source)
        write_ply(cloud.points, target)
        dropped = (f"{cloud.dropped} points are not finite and are left out",) if cloud.dropped else ()
        return Conversion(target=target, format=name, count=len(cloud.points), unit="points", remarks=dropped)
    return _write_log(read(source, format=options.source_format, topics=options.topics), target, name)


def target_format(target: Path, to: str | None) -> str:
    """Return the format to write; InputError where neither `to` nor the suffix names one."""
    if to is not None:
        if to not in TARGETS:
            remedy = f"{did_you_mean(to, TARGETS)}it is {', '.join(TARGETS)}"
            raise InputError("--to", f"'{to}' is no format that is written", remedy)
        return to
    name = format_of_suffix(target) or LOG_SUFFIXES.get(target.suffix.lower())
    if name is None:
        raise InputError(target, f"'{target.suffix}' names no format", f"name one by --to: {', '.join(TARGETS)}")
    return name


def source_trajectory(source: Path, options: ConversionOptions) -> tuple[Trajectory, tuple[str, ...]]:
    """Return the trajectory in a file, of a run directory, or of a log, and remarks."""
    if options.stream not in STREAMS:
        raise InputError("--stream", f"'{options.stream}' is no stream", f"it is {' or '.join(STREAMS)}")
    if (source / RECORD).is_file():
        return read_trajectory(source / "trajectory.tum", parent="map"), ()
    if options.source_format in TRAJECTORY_FORMATS or not recognised(source):
        if is_cloud(source) and source.suffix.lower() not in (".txt", ".csv"):
            raise InputError(source, "is a point cloud", "convert it to .ply")
        if source.is_dir():
            raise InputError(source, "is neither a log nor a run directory", "`psg datasets` lists what is read")
        return read_trajectory(source, format=options.source_format, times=options.times), ()
    log = read(source, format=options.source_format, topics=options.topics)
    if options.stream == "truth":
        if log.truth is None:
            raise InputError(source, "knows no true poses", "convert its odometry")
        return log.truth, log.remarks
    known = log.scan_odometry or log.odometry
    return (known or odometry_at_scans(log).trajectory), log.remarks


def _write_log(log: RobotLog, target: Path, name: str) -> Conversion:
    if name == "rgbd":
        count, remarks = write_rgbd(log, target)
        return Conversion(target=target, format=name, count=count, unit="frames", remarks=(*log.remarks, *remarks))
    estimate = odometry_at_scans(log)
    remarks = [*log.remarks, *estimate.remarks]
    assert log.scans is not None
    if name == "carmen":
        if chosen_source(log) == "none":
            remarks.append("there is no odometry: the robot's pose is written as zero")
        write_carmen(log, target, estimate.trajectory)
    else:
        remarks += write_ece276a(log, target, estimate.trajectory)
    return Conversion(
        target=target, format=name, count=len(log.scans), unit="scans", remarks=tuple(dict.fromkeys(remarks))
    )
