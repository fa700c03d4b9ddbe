"""Small bags of all three storages, written by rosbags itself from known streams."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
START_NS = 1_600_000_000_000_000_000
BEAMS = 61
STORAGES = {
    "ros1": {}, "ros1_lz4": {"compression": "LZ4"}, "ros1_bz2": {"compression": "BZ2"},
    "sqlite3": {}, "sqlite3_message_zstd": {"compression": "MESSAGE"}, "sqlite3_file_zstd": {"compression": "FILE"},
    "mcap": {}, "mcap_zstd": {"compression": "STORAGE"},
}  # fmt: skip
Entry = tuple[str, str, int, Any]
"""Topic, message type, time of recording (ns), message."""


class Maker:
    """Makes messages of one ROS generation."""

    def __init__(self, *, ros2: bool) -> None:
        self.ros2 = ros2
        self.store = ROS2 if ros2 else ROS1
        self.types = self.store.types

    def make(self, name: str, **fields: Any) -> Any:
        return self.types[name](**fields)

    def time(self, ns: int) -> Any:
        return self.make("builtin_interfaces/msg/Time", sec=int(ns // 10**9), nanosec=int(ns % 10**9))

    def header(self, ns: int, frame: str) -> Any:
        more = {} if self.ros2 else {"seq": 0}
        return self.make("std_msgs/msg/Header", stamp=self.time(ns), frame_id=frame, **more)

    def vector(self, x: float, y: float, z: float, name: str = "Vector3") -> Any:
        return self.make(f"geometry_msgs/msg/{name}", x=float(x), y=float(y), z=float(z))

    def quaternion(self, *rpy: float) -> Any:
        x, y, z, w = Rotation.from_euler("xyz", rpy).as_quat()
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def scan(self, ns: int, ranges: np.ndarray, frame: str = "laser", **more: Any) -> Any:
        fields = {
            "angle_min": -1.5, "angle_max": 1.5, "angle_increment": 3.0 / (len(ranges) - 1) if len(ranges) > 1 else 0.1,
            "time_increment": 0.0, "scan_time": 0.1, "range_min": 0.1, "range_max": 20.0,
            "ranges": ranges.astype(np.float32), "intensities": np.zeros(0, np.float32),
        }  # fmt: skip
        return self.make("sensor_msgs/msg/LaserScan", header=self.header(ns, frame), **{**fields, **more})

    def echoes(self, ns: int, ranges: np.ndarray) -> Any:
        echo = self.types["sensor_msgs/msg/LaserEcho"]
        beams = [echo(np.array([r, r + 1.0] if np.isfinite(r) else [], np.float32)) for r in ranges]
        return self.make(
            "sensor_msgs/msg/MultiEchoLaserScan", header=self.header(ns, "laser"), angle_min=-1.5, angle_max=1.5,
            angle_increment=3.0 / (len(ranges) - 1), time_increment=0.0, scan_time=0.1, range_min=0.1, range_max=20.0,
            ranges=beams, intensities=[],
        )  # fmt: skip

    def pose(self, x: float, y: float, yaw: float) -> Any:
        return self.make(
            "geometry_msgs/msg/Pose", position=self.vector(x, y, 0, "Point"), orientation=self.quaternion(0, 0, yaw)
        )

    def odometry(self, ns: int, xyt: tuple[float, float, float], child: str = "base_link") -> Any:
        twist = self.make("geometry_msgs/msg/Twist", linear=self.vector(0, 0, 0), angular=self.vector(0, 0, 0))
        return self.make(
            "nav_msgs/msg/Odometry", header=self.header(ns, "odom"), child_frame_id=child,
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(*xyt), covariance=np.zeros(36)),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip

    def imu(self, ns: int, rate: float, frame: str = "imu") -> Any:
        nine = np.zeros(9)
        return self.make(
            "sensor_msgs/msg/Imu", header=self.header(ns, frame), orientation=self.quaternion(0, 0, 0),
            orientation_covariance=nine, angular_velocity=self.vector(0, 0, rate), angular_velocity_covariance=nine,
            linear_acceleration=self.vector(0, 0, 9.81), linear_acceleration_covariance=nine,
        )  # fmt: skip

    def transform(self, ns: int, parent: str, child: str, xyz: Iterable[float], rpy: Iterable[float]) -> Any:
        return self.make(
            "geometry_msgs/msg/TransformStamped", header=self.header(ns, parent), child_frame_id=child,
            transform=self.make("geometry_msgs/msg/Transform", translation=self.vector(*xyz),
                                rotation=self.quaternion(*rpy)),
        )  # fmt: skip

    def transforms(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    def image(self, ns: int, pixels: np.ndarray, encoding: str, frame: str = "camera_optical", pad: int = 0) -> Any:
        rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
        rows = np.pad(rows, [(0, 0), (0, pad)])
        return self.make(
            "sensor_msgs/msg/Image", header=self.header(ns, frame), height=len(pixels), width=pixels.shape[1],
            encoding=encoding, is_bigendian=0, step=rows.shape[1], data=rows.reshape(-1),
        )  # fmt: skip

    def compressed(self, ns: int, data: bytes, form: str) -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage", header=self.header(ns, "camera_optical"), format=form,
            data=np.frombuffer(data, np.uint8),
        )  # fmt: skip

    def camera(self, ns: int, K: np.ndarray) -> Any:
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        names = ("d", "k", "r", "p") if self.ros2 else ("D", "K", "R", "P")
        values = (np.array([0.1, 0, 0, 0, 0]), K.reshape(-1), np.eye(3).reshape(-1), np.zeros(12))
        return self.make(
            "sensor_msgs/msg/CameraInfo", header=self.header(ns, "camera_optical"), height=4, width=6,
            distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=roi, **dict(zip(names, values, strict=True)),
        )  # fmt: skip

    def cloud(self, ns: int, points: np.ndarray, frame: str = "velodyne", names: str = "xyz") -> Any:
        field = self.types["sensor_msgs/msg/PointField"]
        fields = [field(name=name, offset=4 * k, datatype=7, count=1) for k, name in enumerate([*names, "intensity"])]
        rows = np.column_stack([points, np.ones(len(points))]).astype("<f4")
        return self.make(
            "sensor_msgs/msg/PointCloud2", header=self.header(ns, frame), height=1, width=len(points), fields=fields,
            is_bigendian=False, point_step=16, row_step=16 * len(points), data=rows.view(np.uint8).reshape(-1),
            is_dense=True,
        )  # fmt: skip

    def text(self, words: str) -> Any:
        return self.make("std_msgs/msg/String", data=words)


def write_bag(path: Path, entries: list[Entry], maker: Maker, *, plugin: str = "", compression: str = "") -> Path:
    """Write messages in the order of their recording; .bag files for ROS 1, folders for ROS 2."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if maker.ros2:
        writer: Any = Writer2(path, version=9, storage_plugin=StoragePlugin[plugin.upper()])
        if compression:
            writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    else:
        writer = Writer1(path)
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression])
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, recorded_ns, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=maker.store)
            serialize = maker.store.serialize_cdr if maker.ros2 else maker.store.serialize_ros1
            writer.write(connections[topic], recorded_ns, serialize(message, kind))
    return path


def maker_of(storage: str) -> Maker:
    return Maker(ros2=not storage.startswith("ros1"))


def store_as(storage: str, folder: Path, entries: list[Entry]) -> Path:
    """Write a bag in one of `STORAGES`."""
    maker = maker_of(storage)
    name = f"{storage}.bag" if not maker.ros2 else storage
    plugin = storage.split("_")[0] if maker.ros2 else ""
    return write_bag(folder / name, entries, maker, plugin=plugin, compression=STORAGES[storage].get("compression", ""))


def ranges_at(k: int, beams: int = BEAMS) -> np.ndarray:
    """Ranges (B,) of scan k: a wavy wall, every tenth beam without return."""
    ranges = 3.0 + 0.5 * np.sin(np.arange(beams) / 5 + 0.1 * k)
    ranges[::10] = np.inf
    return ranges


def xyt_at(k: int) -> tuple[float, float, float]:
    return 0.1 * k, 0.02 * k, 0.01 * k


def stamp_at(k: int) -> int:
    return START_NS + k * 100_000_000


LASER_ON_BASE = ((0.2, 0.0, 0.3), (0.0, 0.0, 0.5))
LATENCY_NS = 3_000_000


def robot(maker: Maker, scans: int = 20) -> list[Entry]:
    """The entries of a usual robot: scans, odometry, IMU, a frame tree with the laser on a footprint, and chatter."""
    tf = "tf2_msgs/msg/TFMessage"
    links = [maker.transform(0, "base_footprint", "base_link", (0, 0, 0.1), (0, 0, 0)),
             maker.transform(0, "base_link", "laser", *LASER_ON_BASE)]  # fmt: skip
    entries: list[Entry] = [("/tf_static", tf, START_NS, maker.transforms(*links))]
    for k in range(scans):
        ns = stamp_at(k)
        entries += [
            ("/odom", "nav_msgs/msg/Odometry", ns, maker.odometry(ns, xyt_at(k), "base_footprint")),
            ("/imu/data", "sensor_msgs/msg/Imu", ns, maker.imu(ns, 0.1, "base_link")),
            ("/scan", "sensor_msgs/msg/LaserScan", ns + LATENCY_NS, maker.scan(ns, ranges_at(k))),
            ("/chatter", "std_msgs/msg/String", ns, maker.text("hello")),
        ]
    return entries
