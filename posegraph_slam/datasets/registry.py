"""The formats that can be read, and the choice of one for a path.

Built-in readers are named by module and imported on first use, so that listing them costs nothing. Other packages add
a reader through the entry-point group `posegraph_slam.readers`; each entry point names a `Reader`.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from posegraph_slam.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from posegraph_slam.sensors import RobotLog

ENTRY_POINT_GROUP = "posegraph_slam.readers"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """One format: what it is, how to recognise it cheaply, and how to read it.

    `detects(path)` looks at names and first bytes only and never raises; `read(path)` returns a `RobotLog` or raises
    `InputError` naming the file. `layout` describes for people what the path has to be. A format whose streams have
    names that can be chosen has `read_topics(path, topics)` too, where `topics` maps roles to names.
    """

    name: str
    description: str
    layout: str
    detects: Callable[[Path], bool]
    read: Callable[[Path], RobotLog]
    read_topics: Callable[[Path, Mapping[str, str]], RobotLog] | None = None


def _built_in(name: str, description: str, layout: str, *, topics: bool = False) -> Reader:
    """Describe the reader in `posegraph_slam.datasets.<name>`, whose module is imported at the first call."""
    module = f"posegraph_slam.datasets.{name}"

    def detects(path: Path) -> bool:
        return bool(importlib.import_module(module).detects(path))

    def read_log(path: Path) -> RobotLog:
        log: RobotLog = importlib.import_module(module).read(path)
        return log

    def read_topics(path: Path, topics: Mapping[str, str]) -> RobotLog:
        log: RobotLog = importlib.import_module(module).read(path, topics)
        return log

    return Reader(
        name=name,
        description=description,
        layout=layout,
        detects=detects,
        read=read_log,
        read_topics=read_topics if topics else None,
    )


BUILT_IN = (
    _built_in(
        "ece276a",
        "differential-drive robot with wheel encoders, IMU, LiDAR and Kinect (UCSD ECE276A, UPenn ESE650)",
        "a folder with Encoders*.npz, Imu*.npz, Hokuyo*.npz and, when present, Kinect*.npz and its PNG frames",
    ),
    _built_in(
        "carmen",
        "laser log of the CARMEN robot navigation toolkit (FLASER, RLASER, ROBOTLASER1, ODOM, PARAM)",
        "a text file .clf, .log or .txt, or one of them compressed as .gz",
    ),
    _built_in(
        "rosbag",
        "bag of ROS 1 or ROS 2: laser scans or point clouds, odometry, IMU, images and frames (TF)",
        "a file .bag (ROS 1), .mcap or .db3 (ROS 2), the folder of a ROS 2 bag, or a folder of split .bag files",
        topics=True,
    ),
    _built_in(
        "humanoid",
        "walking humanoid with a LiDAR on its panning and nodding head (UPenn ESE650, UCSD ECE276A)",
        "a file train_lidar0.mat beside train_joint0.mat, or a folder that holds the two",
    ),
    _built_in(
        "imu_vicon",
        "hand-held IMU board, raw ADC counts, with motion-capture truth where it is known (ESE650, ECE276A)",
        "an .npz file with imu_raw and imu_stamps_s and, when present, vicon_rotation and vicon_stamps_s",
    ),
    _built_in(
        "euroc",
        "IMU and true poses of a EuRoC recording (ASL format); its cameras are not read",
        "the folder that holds mav0, mav0 itself, or the data.csv of an imu0",
    ),
    _built_in(
        "rgbd",
        "RGB-D camera in motion: colour images and 16-bit depth registered to them (TUM RGB-D benchmark, Open3D)",
        "a folder with rgb.txt and depth.txt, or with folders of images: color (or rgb, image) and depth",
    ),
)


def available_readers() -> tuple[Reader, ...]:
    """Return the built-in readers, then those of other packages by name.

    A package whose entry point does not load, is no `Reader` or takes a name already in use is left out with a
    warning: a broken add-on must not stop the reading of other formats.
    """
    readers = {reader.name: reader for reader in BUILT_IN}
    for point in sorted(metadata.entry_points(group=ENTRY_POINT_GROUP), key=lambda point: (point.name, point.value)):
        try:
            reader = point.load()
        except Exception as error:
            warnings.warn(f"reader {point.value} cannot be loaded: {error}", RuntimeWarning, stacklevel=2)
            continue
        if not isinstance(reader, Reader):
            warnings.warn(f"reader {point.value} is not a posegraph_slam Reader", RuntimeWarning, stacklevel=2)
        elif reader.name in readers:
            warnings.warn(f"reader {point.value} is ignored: '{reader.name}' exists", RuntimeWarning, stacklevel=2)
        else:
            readers[reader.name] = reader
    return tuple(readers.values())


def read(
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002 - the word users know
    topics: Mapping[str, str] | None = None,
) -> RobotLog:
    """Read the log at `path` with the reader called `format`, or with the first one that recognises it.

    `topics` maps roles (scan, odom, imu, ...) to the topics of a bag, where the likeliest ones are not meant. Raises
    `InputError` when the path does not exist, the format is unknown, no reader recognises the path, or the reader
    finds the content unusable.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(path, "no such file or folder", "check the path")
    if path.is_dir() and not any(path.iterdir()):
        raise InputError(path, "the folder is empty", "give a folder or file that holds a log")
    readers = available_readers()
    reader = _choose(path, readers) if format is None else _named(format, readers)
    if not topics:
        return reader.read(path)
    if reader.read_topics is None:
        raise InputError("--topic", f"a {reader.name} log has no topics to choose", "leave the option out")
    return reader.read_topics(path, topics)


def recognised(path: Path) -> bool:
    """Tell whether some reader recognises the log at `path`."""
    return any(reader.detects(path) for reader in available_readers())


def _named(name: str, readers: tuple[Reader, ...]) -> Reader:
    """Find the reader called `name`, or say which names exist and which one is nearest."""
    by_name = {reader.name: reader for reader in readers}
    if name in by_name:
        return by_name[name]
    guess = did_you_mean(name, by_name)
    raise InputError("format", f"unknown format '{name}'", f"{guess}available: {', '.join(by_name)}")


def _choose(path: Path, readers: tuple[Reader, ...]) -> Reader:
    """Find the first reader that recognises `path`, or name the formats that could have been read."""
    for reader in readers:
        if reader.detects(path):
            return reader
    formats = ", ".join(reader.name for reader in readers)
    raise InputError(path, "no reader recognises it", f"`psg datasets` says what each of them reads: {formats}")
