"""One simulated run in memory: the world, the drive and the log of its sensors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray, IntArray
from posegraph_slam.datasets.simulation import robot, streams
from posegraph_slam.datasets.simulation.motion import Motion, drive_path
from posegraph_slam.datasets.simulation.route import lift_path, plan_path
from posegraph_slam.datasets.simulation.settings import SimulationSettings
from posegraph_slam.datasets.simulation.world import World, build_world
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.geometry import Trajectory
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu, LaserScans, RgbdFrames, RobotLog, WheelEncoders

KINECT_DELAY_S = 1.0
"""The cameras start this much after the other sensors."""
COLOUR_LAG_S = 0.012
"""The colour clock runs this much behind the disparity clock."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedRun:
    """What one run recorded: stamps in seconds since the begin, and the streams as the sensors report them.

    `counts` (N, 4) ticks of FR FL RR RL; `angular_velocity` (M, 3) rad/s; `acceleration_g` (M, 3); `ranges_m` (L, B).
    """

    settings: SimulationSettings
    world: World
    motion: Motion
    encoder_times_s: FloatArray
    counts: IntArray
    imu_times_s: FloatArray
    angular_velocity: FloatArray
    acceleration_g: FloatArray
    lidar_times_s: FloatArray
    ranges_m: Float32Array
    disparity_times_s: FloatArray
    colour_times_s: FloatArray

    def stamps(self, times_s: FloatArray) -> FloatArray:
        """Turn seconds since the begin into stamps of the log."""
        return np.asarray(self.settings.start_epoch_s + times_s, dtype=np.float64)

    def truth(self) -> Trajectory:
        """Return the pose T_ref_base (L, 4, 4) at every scan; `ref` is the frame of the world."""
        poses = self.motion.spatial_poses_at(self.lidar_times_s)
        return Trajectory(stamps_s=self.stamps(self.lidar_times_s), poses=poses, parent="ref", child="base")

    def log(self) -> RobotLog:
        """Return the streams as a log without images, with the truth at every scan; see `drive`."""
        disparity, colour = self.stamps(self.disparity_times_s), self.stamps(self.colour_times_s)
        return RobotLog(
            path=Path(f"simulated-{self.settings.seed}"),
            format="simulation",
            scans=LaserScans(
                stamps_s=self.stamps(self.lidar_times_s),
                ranges_m=self.ranges_m,
                angle_min_rad=robot.LIDAR_ANGLE_MIN_RAD,
                angle_increment_rad=streams.lidar_increment(self.settings.lidar),
                range_min_m=robot.LIDAR_RANGE_MIN_M,
                range_max_m=robot.LIDAR_RANGE_MAX_M,
                T_base_lidar=robot.T_BASE_LIDAR,
            ),
            encoders=WheelEncoders(
                stamps_s=self.stamps(self.encoder_times_s),
                ticks_left=self.counts[:, [1, 3]],
                ticks_right=self.counts[:, [0, 2]],
                metres_per_tick=robot.METRES_PER_TICK,
                track_width_m=robot.TRACK_WIDTH_M,
            ),
            imu=Imu(
                stamps_s=self.stamps(self.imu_times_s),
                angular_velocity=self.angular_velocity,
                linear_acceleration=self.acceleration_g * STANDARD_GRAVITY,
                T_base_imu=np.eye(4),
            ),
            rgbd=RgbdFrames(
                disparity_stamps_s=disparity,
                colour_stamps_s=colour,
                disparity_files=(None,) * len(disparity),
                colour_files=(None,) * len(colour),
                T_base_camera=robot.T_BASE_CAMERA,
            ),
            truth=self.truth(),
        )


def generator(settings: SimulationSettings, purpose: str) -> np.random.Generator:
    """Return the random generator of one part, which does not change when other parts draw more or less."""
    return np.random.default_rng([settings.seed, *purpose.encode()])


def simulate_run(settings: SimulationSettings, progress: Progress = silent_progress) -> SimulatedRun:
    """Build the world, drive through it and record all sensors but the images.

    Memory grows with the scans alone (4 bytes a beam). Raises nothing of its own: the settings are checked already.
    """
    world = build_world(settings.world, generator(settings, "world"))
    path = plan_path(world.plan, settings.drive, generator(settings, "route"))
    motion = drive_path(path if world.terrain is None else lift_path(path, world.terrain), settings.drive)
    end = motion.end_s
    rng = {name: generator(settings, name) for name in ("encoders", "imu", "lidar", "kinect")}
    encoder_times = streams.stamp_times(settings.encoders.rate_hz, 0.0, end, rng["encoders"])
    imu_end = max(end - settings.imu.missing_tail_s, 0.0)
    imu_times = streams.stamp_times(settings.imu.rate_hz, 0.0, imu_end, rng["imu"])
    lidar_times = streams.stamp_times(settings.lidar.rate_hz, 0.0, end, rng["lidar"])
    disparity_times, colour_times = _frame_times(settings, end, rng["kinect"])
    angular, acceleration = streams.imu_samples(motion, imu_times, settings.imu, rng["imu"])
    return SimulatedRun(
        settings=settings,
        world=world,
        motion=motion,
        encoder_times_s=encoder_times,
        counts=streams.encoder_counts(motion, encoder_times, settings.encoders, rng["encoders"]),
        imu_times_s=imu_times,
        angular_velocity=angular,
        acceleration_g=acceleration,
        lidar_times_s=lidar_times,
        ranges_m=streams.lidar_ranges(motion, world, lidar_times, settings.lidar, rng["lidar"], progress),
        disparity_times_s=disparity_times,
        colour_times_s=colour_times,
    )


def _frame_times(settings: SimulationSettings, end_s: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Draw the times of the disparity and the colour frames: one clock a little behind the other, frames missing."""
    times = streams.stamp_times(settings.kinect.rate_hz, min(KINECT_DELAY_S, end_s / 2), end_s - 0.1, rng)
    kept = rng.random((2, len(times))) >= settings.kinect.missing_fraction
    colour = times + COLOUR_LAG_S + np.abs(0.003 * rng.normal(size=len(times)))
    return times[kept[0]], colour[kept[1]]


def drive(settings: SimulationSettings, progress: Progress = silent_progress) -> RobotLog:
    """Simulate a log in memory, with its truth and without images; nothing touches the disk.

    The streams are those that reading the folder written by `simulate` gives, for tests and for long logs. Frames:
    truth is T_ref_base at every scan, with the first pose at the origin; accelerations are in m/s^2.
    """
    return simulate_run(settings, progress).log()
