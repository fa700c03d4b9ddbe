"""One pass over a bag: every message goes to the collector of its topic."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from posegraph_slam.datasets.rosbag.bag import Bag, RawMessage
from posegraph_slam.datasets.rosbag.frames import FrameTree, bare
from posegraph_slam.datasets.rosbag.images import ImageIndex, calibration
from posegraph_slam.datasets.rosbag.motion import ImuCollector, PoseCollector
from posegraph_slam.datasets.rosbag.scans import ScanCollector
from posegraph_slam.datasets.rosbag.topics import CAMERA, CLOUD, Choice
from posegraph_slam.sensors.images import CameraCalibration


@dataclass(slots=True)
class Collected:
    """What the first pass collects."""

    tree: FrameTree = field(default_factory=FrameTree)
    scan: ScanCollector | None = None
    odom: PoseCollector | None = None
    truth: PoseCollector | None = None
    imu: ImuCollector | None = None
    images: dict[str, ImageIndex] = field(default_factory=dict)
    cameras: dict[str, CameraCalibration] = field(default_factory=dict)
    cloud_frame: str = ""


def collect(bag: Bag, choice: Choice) -> Collected:
    """Read all chosen topics but clouds, which need the mounting first: of these the frame of the first alone."""
    found = Collected()
    collectors: dict[str, list[Any]] = {}
    if choice.scan is not None and choice.scan.type != CLOUD:
        found.scan = ScanCollector(choice.scan.name)
        collectors[choice.scan.name] = [found.scan]
    for role, kind in (("odom", PoseCollector), ("truth", PoseCollector), ("imu", ImuCollector)):
        topic = getattr(choice, role)
        if topic is not None:
            setattr(found, role, kind(topic.name))
            collectors.setdefault(topic.name, []).append(getattr(found, role))
    transforms = {topic.name for topic in choice.transforms}
    found.images = {topic.name: ImageIndex(topic.name) for topic in choice.images}
    cameras = {topic.name for topic in bag.topics.values() if topic.type == CAMERA}
    for number, message in enumerate(bag.raw({*collectors, *transforms, *found.images, *cameras})):
        name = message.topic
        if name in found.images:
            found.images[name].add(message, is_ros2=bag.is_ros2)
        elif name in cameras:
            _note_camera(bag, found, message)
        else:
            content = bag.deserialise(message, number)
            if name in transforms:
                found.tree.add(content)
            for collector in collectors.get(name, ()):
                collector.add(content, message.recorded_ns)
    if choice.scan is not None and choice.scan.type == CLOUD:
        _, _, first = next(bag.messages({choice.scan.name}))
        found.cloud_frame = bare(first.header.frame_id)
    found.tree.finish()
    return found


def _note_camera(bag: Bag, found: Collected, message: RawMessage) -> None:
    """Keep the first calibration of a camera that was set, by the namespace of its topic."""
    space = message.topic.rsplit("/", 1)[0]
    if space not in found.cameras:
        known = calibration(bag.deserialise(message))
        if known is not None:
            found.cameras[space] = known
