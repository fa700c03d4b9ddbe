"""What `psg optimize` would do with a log, in words."""

from __future__ import annotations

from posegraph_slam.odometry import chosen_source
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.depth_maps import floor_step
from posegraph_slam.sensors import RobotLog

SOURCES = {
    "logged": "take the odometry that the robot logged",
    "wheels_imu": "integrate wheel encoders and gyro into odometry",
    "wheels": "integrate the wheel encoders into odometry, since there is no gyro",
    "none": "start without odometry: the motion is found by scan matching alone",
}


def describe(log: RobotLog, configuration: Configuration) -> list[str]:
    """Return the steps that `optimize` would take with `log`, as phrases that follow "would".

    A log that cannot be optimised gives one phrase that says why.
    """
    scans = log.scans
    if scans is None or len(scans) == 0:
        return ["refuse the log: it has no laser scans, and scan matching needs them"]
    steps = [
        SOURCES[chosen_source(log, configuration.odometry.source)],
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
