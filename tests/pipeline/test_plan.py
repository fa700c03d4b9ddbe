"""The plan names the odometry source, the maps and the comparison that fit the log."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from posegraph_slam.errors import ConfigurationError
from posegraph_slam.geometry import Relations, Trajectory
from posegraph_slam.pipeline.configuration import load_configuration
from posegraph_slam.pipeline.plan import describe
from posegraph_slam.sensors import Imu, LaserScans, RgbdFrames, RobotLog, WheelEncoders

STAMPS = np.arange(3.0)
TRAJECTORY = Trajectory(stamps_s=STAMPS, poses=np.tile(np.eye(3), (3, 1, 1)), parent="odom", child="base")


@pytest.fixture
def log() -> RobotLog:
    scans = LaserScans(
        stamps_s=STAMPS,
        ranges_m=np.ones((3, 5), np.float32),
        angle_min_rad=-1.0,
        angle_increment_rad=0.5,
        range_min_m=0.1,
        range_max_m=10.0,
        T_base_lidar=np.eye(4),
    )
    return RobotLog(path=Path("log"), format="test", scans=scans)


def plan(log: RobotLog, *overrides: str) -> str:
    return "\n".join(describe(log, load_configuration(overrides=overrides)))


def test_poses_in_space(log: RobotLog) -> None:
    assert "refuse the log: it has no IMU" in plan(log, "pose_graph.group=se3")
    still = np.zeros((3, 3))
    imu = Imu(stamps_s=STAMPS, angular_velocity=still, linear_acceleration=still + 9.8, T_base_imu=np.eye(4))
    log = dataclasses.replace(log, imu=imu)
    assert "no wheel encoders" in plan(log, "pose_graph.group=se3")
    ticks = np.zeros((3, 2), dtype=np.int64)
    encoders = WheelEncoders(
        stamps_s=STAMPS, ticks_left=ticks, ticks_right=ticks, metres_per_tick=0.002, track_width_m=0.7
    )
    log = dataclasses.replace(log, encoders=encoders)
    assert "level the scans" in plan(log, "pose_graph.group=se3")
    assert "level the scans" not in plan(log)


def test_source_of_the_odometry(log: RobotLog) -> None:
    assert "without odometry" in plan(log)
    moving = np.array(TRAJECTORY.poses)
    moving[:, 0, 2] = np.arange(len(moving))
    assert "the robot logged" in plan(dataclasses.replace(log, odometry=TRAJECTORY.with_poses(moving)))
    assert "without odometry" in plan(dataclasses.replace(log, odometry=TRAJECTORY))
    ticks = np.zeros((3, 2), np.int64)
    encoders = WheelEncoders(
        stamps_s=STAMPS, ticks_left=ticks, ticks_right=ticks, metres_per_tick=0.01, track_width_m=0.5
    )
    wheeled = dataclasses.replace(log, encoders=encoders)
    assert "there is no gyro" in plan(wheeled)
    assert "without odometry" in plan(wheeled, "odometry.source=none")
    with pytest.raises(ConfigurationError, match=r"odometry\.source"):
        plan(log, "odometry.source=logged")


def test_a_log_without_scans_is_refused(log: RobotLog) -> None:
    assert plan(dataclasses.replace(log, scans=None)).startswith("refuse the log: it has no laser scans")


def test_maps_follow_the_configuration(log: RobotLog) -> None:
    assert "fits the log with cells of 0.05 m" in plan(log)
    assert "of 40 x 40 m with cells of 0.1 m" in plan(log, "mapping.fixed_size_m=40", "mapping.resolution_m=0.1")
    assert "floor map" not in plan(log)
    frames = RgbdFrames(
        disparity_stamps_s=STAMPS,
        colour_stamps_s=STAMPS,
        disparity_files=(Path("1.png"), None, Path("3.png")),
        colour_files=(None, Path("2.png"), None),
        T_base_camera=np.eye(4),
    )
    assert "colour the floor map from 2 disparity images" in plan(dataclasses.replace(log, rgbd=frames))
    blind = dataclasses.replace(frames, disparity_files=(None,) * 3)
    assert "images are not in the log" in plan(dataclasses.replace(log, rgbd=blind))


def test_comparison_names_the_truth(log: RobotLog) -> None:
    assert "start-end gap" in plan(log)
    relations = Relations(stamps_1_s=STAMPS[:2], stamps_2_s=STAMPS[1:], T_1_2=np.tile(np.eye(4), (2, 1, 1)))
    known = dataclasses.replace(log, truth=TRAJECTORY, relations=relations)
    assert "against 3 true poses and 2 true relations" in plan(known)
