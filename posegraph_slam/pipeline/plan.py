"""What `psg optimize` would do with a log, in words."""

from __future__ import annotations

from posegraph_slam.odometry import chosen_source
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.depth_maps import floor_step
from posegraph_slam.sensors import RgbdSequence, RobotLog

SOURCES = {
    "logged": "take the odometry that the robot logged",
    "wheels_imu": "integrate wheel encoders and gyro into odometry",
    "wheels": "integrate the wheel encoders into odometry, since there is no gyro",
    "none": "start without odometry: the motion is found by scan matching alone",
}
IN_SPACE = "find roll, pitch and height from IMU and wheels, and level the scans"


def describe(log: RobotLog, configuration: Configuration) -> list[str]:
    """Return the steps that `optimize` would take with `log`, as phrases that follow "would".

    A log that cannot be optimised gives one phrase that says why.
    """
    scans = log.scans
    if scans is None and log.rgbd_sequence is not None:
        return _rgbd_steps(log, log.rgbd_sequence, configuration)
    if scans is None or len(scans) == 0:
        return ["refuse the log: it has no laser scans, and scan matching needs them"]
    in_space = configuration.pose_graph.group == "se3"
    if in_space and (log.imu is None or log.encoders is None):
        missing = "IMU" if log.imu is None else "wheel encoders"
        return [f'refuse the log: it has no {missing}, which poses in space need (pose_graph.group = "se3")']
    steps = [
        IN_SPACE if in_space else SOURCES[chosen_source(log, configuration.odometry.source)],
        f"match {len(scans)} scans of {scans.beams} beams one after another",
        "choose keyframes, propose loop closures, verify each, and solve the pose graph until no new one is found",
        _occupancy_step(configuration),
    ]
    if log.rgbd is not None and log.rgbd.has_images:
        frames = sum(file is not None for file in log.rgbd.disparity_files)
        steps.append(f"colour the floor map from {frames} disparity images")
        steps += [step] if (step := floor_step(configuration.floor)) else []
    elif log.rgbd is not None:
        steps.append("leave out the texture map: the camera's images are not in the log")
    known = [
        *([f"{len(log.truth)} true poses"] if log.truth is not None else []),
        *([f"{len(log.relations)} true relations"] if log.relations is not None else []),
    ]
    compared = f"compare odometry, scan matching and the optimised trajectory against {' and '.join(known)}"
    steps.append(compared if known else "compare the stages by start-end gap, path length and map crispness")
    return steps


def _occupancy_step(configuration: Configuration) -> str:
    mapping = configuration.mapping
    size = f"of {mapping.fixed_size_m:g} x {mapping.fixed_size_m:g} m" if mapping.fixed_size_m else "that fits the log"
    return f"build an occupancy map {size} with cells of {mapping.resolution_m:g} m"


def _rgbd_steps(log: RobotLog, sequence: RgbdSequence, configuration: Configuration) -> list[str]:
    """Steps for the images of an RGB-D camera."""
    size = f"{sequence.camera.width} x {sequence.camera.height}"
    cloud = configuration.rgbd.cloud
    compared = f"against {len(log.truth)} true poses" if log.truth is not None else "by the thickness of surfaces"
    return [
        f"align {len(sequence)} pairs of colour and depth images ({size}) by intensity and by distance to planes",
        "choose keyframes, propose loop closures by overlap and by appearance, verify each, and solve the pose graph",
        f"fuse the frames up to {cloud.max_depth_m:g} m into a coloured cloud with voxels of {cloud.voxel_m:g} m",
        f"compare odometry and the optimised trajectory {compared}",
    ]
