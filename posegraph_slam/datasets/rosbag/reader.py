"""From a bag to a `RobotLog`: one pass over the messages of the chosen topics, a second one for point clouds."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from posegraph_slam.datasets.rosbag.bag import is_bag, open_bag, split_files
from posegraph_slam.datasets.rosbag.body import BodyFrames
from posegraph_slam.datasets.rosbag.clock import refuse_other_clock
from posegraph_slam.datasets.rosbag.collecting import collect
from posegraph_slam.datasets.rosbag.streams import image_stream, imu_stream, odometry_stream, poses_of, scan_stream
from posegraph_slam.datasets.rosbag.topics import choose, no_such_stream, unused
from posegraph_slam.sensors import RobotLog


def detects(path: Path) -> bool:
    """Tell whether `path` is a bag of ROS 1 or ROS 2."""
    return is_bag(path)


def read(path: str | Path, topics: Mapping[str, str] | None = None) -> RobotLog:
    """Read a bag: scans, odometry, IMU, images by stamp, and true poses where a topic's name says so.

    `topics` gives roles (scan, odom, imu, image, truth) another topic than the likeliest, or "none"; `base` names the
    robot's frame. Stamps are those of the headers. Sensors are mounted as the frame tree (TF) says; odometry is taken
    from it too where no topic tells it. Messages are read one after another: of clouds only a planar slice is kept, of
    images only the stamp. Raises `InputError` naming file and topic, and listing what is there.
    """
    path = Path(path)
    remarks: list[str] = []
    with open_bag(path) as bag:
        if path.is_dir() and not bag.is_ros2:
            remarks.append(f"the folder's {len(split_files(path))} bags are read as one recording")
        choice = choose(bag, topics or {})
        remarks.append(choice.sentence(unused(bag, choice)))
        found = collect(bag, choice)
        frames = BodyFrames.of(bag, choice, found, remarks)
        scans = scan_stream(bag, choice, found, frames, remarks)
    odometry = odometry_stream(path, choice, found, frames, remarks)
    log = RobotLog(
        path=path,
        format="rosbag",
        scans=scans,
        imu=imu_stream(path, found, frames, remarks),
        odometry=odometry,
        truth=poses_of(path, found.truth, remarks, parent="ref") if found.truth else None,
        images=tuple(image_stream(path, index, found, frames, remarks) for index in found.images.values()),
    )
    for role, stream, topic in (("odom", log.odometry, choice.odom), ("imu", log.imu, choice.imu),
                                ("truth", log.truth, choice.truth)):  # fmt: skip
        if stream is not None and scans is not None:
            refuse_other_clock(path, role, topic.name if topic else "/tf", stream.stamps_s, scans.stamps_s)
    if all(each is None for each in (log.scans, log.odometry, log.imu)) and not log.images:
        with open_bag(path) as bag:
            raise no_such_stream(path, bag)
    return dataclasses.replace(log, remarks=tuple(dict.fromkeys([*remarks, *found.tree.remarks])))
