"""What was collected from a bag as the streams of a log: in order of their stamps, mounted on the robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray
from posegraph_slam.datasets.rosbag.bag import Bag
from posegraph_slam.datasets.rosbag.body import BodyFrames
from posegraph_slam.datasets.rosbag.clock import message_order
from posegraph_slam.datasets.rosbag.clouds import BEAMS, RANGE_LIMITS_M, CloudCollector
from posegraph_slam.datasets.rosbag.collecting import Collected
from posegraph_slam.datasets.rosbag.frames import bare
from posegraph_slam.datasets.rosbag.images import ImageIndex, ImageLoader
from posegraph_slam.datasets.rosbag.motion import PoseCollector
from posegraph_slam.datasets.rosbag.scans import DROPOUT_M, upright
from posegraph_slam.datasets.rosbag.topics import Choice
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory, planar_from_spatial
from posegraph_slam.sensors import Imu, LaserScans
from posegraph_slam.sensors.images import ImageStream

FAR_M = 100.0
"""Taken where a driver states an infinite or no range_max."""


def scan_stream(
    bag: Bag, choice: Choice, found: Collected, frames: BodyFrames, remarks: list[str]
) -> LaserScans | None:
    """Return the scans of the chosen topic, of a laser or cut from clouds."""
    if choice.scan is None:
        return None
    if found.scan is None:
        return _sliced(bag, choice.scan.name, found.cloud_frame, frames, remarks)
    collector = found.scan
    stamps, recorded, ranges = collector.finish()
    remarks += collector.remarks()
    if not len(stamps) or collector.geometry is None:
        raise InputError(bag.path, f"topic {choice.scan.name}: no message has beams", f"it holds {bag.listing()}")
    low, high = collector.range_limits_m
    _, start, step = collector.geometry
    T = frames.mounting(collector.frame, "the laser", remarks)
    return upright(
        _laser(bag.path, choice.scan.name, stamps, recorded, ranges, remarks,
               angles=(start, step), limits=(max(low, DROPOUT_M), high if np.isfinite(high) and high > 0 else FAR_M),
               T_base_lidar=np.eye(4) if T is None else T)
    )  # fmt: skip


def _sliced(bag: Bag, topic: str, frame: str, frames: BodyFrames, remarks: list[str]) -> LaserScans:
    """Read clouds as planar scans, level with the base."""
    T = frames.mounting(frame, "the 3D LiDAR", remarks)
    T = np.eye(4) if T is None else T
    collector = CloudCollector(topic, T)
    for _, recorded_ns, message in bag.messages({topic}):
        collector.add(message, recorded_ns)
    level = np.eye(4)
    level[:3, 3] = T[:3, 3]
    remarks.append(f"planar scans of {BEAMS} beams are cut from the clouds of {topic} about the sensor's horizon")
    stamps, recorded, ranges = collector.finish()
    return _laser(bag.path, topic, stamps, recorded, ranges, remarks, angles=(-np.pi, 2 * np.pi / BEAMS),
                  limits=RANGE_LIMITS_M, T_base_lidar=level)  # fmt: skip


def _laser(
    path: Path, topic: str, stamps: FloatArray, recorded: FloatArray, ranges: Float32Array, remarks: list[str], *,
    angles: tuple[float, float], limits: tuple[float, float], T_base_lidar: FloatArray,
) -> LaserScans:  # fmt: skip
    stamps, order = message_order(path, topic, stamps, recorded, remarks)
    if limits[0] >= limits[1]:
        raise InputError(path, f"topic {topic}: range_min {limits[0]:g} and range_max {limits[1]:g} leave no range")
    np.copyto(ranges, np.float32(limits[1]), where=np.isposinf(ranges))  # REP 117: infinity is no return
    in_order = bool((np.diff(order) == 1).all())
    return LaserScans(
        stamps_s=stamps if in_order else stamps[order],
        ranges_m=ranges if in_order else ranges[order],
        angle_min_rad=angles[0],
        angle_increment_rad=angles[1],
        range_min_m=limits[0],
        range_max_m=limits[1],
        T_base_lidar=T_base_lidar,
    )


def poses_of(path: Path, collector: PoseCollector, remarks: list[str], *, parent: str) -> Trajectory | None:
    """Return the poses of one topic, T_parent_base; None where no pose is usable."""
    stamps, recorded, poses, dropped = collector.finish()
    if dropped:
        remarks.append(f"{dropped} poses of {collector.topic} are not finite or no rotation and are left out")
    if not len(stamps):
        return None
    stamps, order = message_order(path, collector.topic, stamps, recorded, remarks)
    return Trajectory(stamps_s=stamps[order], poses=poses[order], parent=parent, child="base")


def odometry_stream(
    path: Path, choice: Choice, found: Collected, frames: BodyFrames, remarks: list[str]
) -> Trajectory | None:
    """Return T_odom_base in the plane, from its topic or else from the frame tree."""
    spatial = None
    if found.odom is not None:
        spatial = poses_of(path, found.odom, remarks, parent="odom")
        child = bare(found.odom.child)
        T = frames.tree.mounting(child, frames.base) if child and frames.base else None
        if spatial is not None and T is not None:
            spatial = spatial.with_poses(spatial.poses @ T)
    elif choice.use_tf_odometry and frames.odometry_link is not None:
        parent, child = frames.odometry_link
        spatial = frames.tree.trajectory(parent, child)
        stamps, order = message_order(path, f"/tf ({parent} to {child})", spatial.stamps_s, spatial.stamps_s, remarks)
        T = frames.tree.mounting(child, frames.base) if frames.base else None
        spatial = spatial.with_poses(spatial.poses @ (np.eye(4) if T is None else T)).select(order)
        remarks.append(f"odometry is taken from the frame tree: {child} in {parent}, {len(stamps)} poses")
    return None if spatial is None else spatial.with_poses(planar_from_spatial(spatial.poses))


def imu_stream(path: Path, found: Collected, frames: BodyFrames, remarks: list[str]) -> Imu | None:
    """Return the measurements of the IMU."""
    if found.imu is None:
        return None
    stamps, recorded, rates, accelerations, dropped = found.imu.finish()
    if dropped:
        remarks.append(f"{dropped} messages of {found.imu.topic} are not finite and are left out")
    if not len(stamps):
        return None
    stamps, order = message_order(path, found.imu.topic, stamps, recorded, remarks)
    T = frames.mounting(found.imu.frame, "the IMU", remarks)
    return Imu(
        stamps_s=stamps[order],
        angular_velocity=rates[order],
        linear_acceleration=accelerations[order],
        T_base_imu=np.eye(4) if T is None else T,
    )


def image_stream(
    path: Path, index: ImageIndex, found: Collected, frames: BodyFrames, remarks: list[str]
) -> ImageStream:
    """Return the images of one topic, by stamp."""
    rows = index.finish()
    seconds = np.asarray(rows[:, :2] * 1e-9, dtype=np.float64)
    stamps, order = message_order(path, index.topic, seconds[:, 0], seconds[:, 1], remarks)
    spaces = [index.topic.rsplit("/", depth)[0] for depth in (1, 2)]  # /cam/image/compressed: /cam/image, then /cam
    T = frames.tree.mounting(frames.base, index.frame) if frames.base and index.frame else None
    return ImageStream(
        name=index.topic,
        stamps_s=stamps[order],
        frame=index.frame,
        load=ImageLoader(path=path, topic=index.topic, rows=rows[order]),
        calibration=next((found.cameras[space] for space in spaces if space in found.cameras), None),
        T_base_camera=T,
    )
