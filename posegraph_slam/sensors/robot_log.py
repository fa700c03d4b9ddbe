"""Everything one robot recorded in one run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from posegraph_slam.geometry import Relations, Trajectory
from posegraph_slam.sensors.images import ImageStream
from posegraph_slam.sensors.imu import Imu
from posegraph_slam.sensors.laser import LaserScans
from posegraph_slam.sensors.rgbd import RgbdFrames
from posegraph_slam.sensors.rgbd_sequence import RgbdSequence
from posegraph_slam.sensors.wheels import WheelEncoders


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotLog:
    """The streams of a log, each None where the robot did not record it, and the truth where it is known.

    `scan_odometry` is the logged odometry pose T_odom_base of every scan (same order and count as `scans`);
    `odometry` the logger's separate odometry stream. `rgbd` is a Kinect of disparity images on a robot, `rgbd_sequence`
    a camera that moves by itself and gives depth registered to colour; `images` are other cameras, whose images stay
    where they were recorded. `remarks` are plain sentences on what the reader had to do.
    """

    path: Path
    format: str
    scans: LaserScans | None = None
    encoders: WheelEncoders | None = None
    imu: Imu | None = None
    odometry: Trajectory | None = None
    scan_odometry: Trajectory | None = None
    rgbd: RgbdFrames | None = None
    images: tuple[ImageStream, ...] = ()
    rgbd_sequence: RgbdSequence | None = None
    truth: Trajectory | None = None
    relations: Relations | None = None
    remarks: tuple[str, ...] = field(default=())
