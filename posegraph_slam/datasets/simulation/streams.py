"""What the wheels, the IMU and the laser scanner report of a drive, with their errors."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray, IntArray
from posegraph_slam.datasets.simulation import robot
from posegraph_slam.datasets.simulation.motion import Motion
from posegraph_slam.datasets.simulation.raycast import cast_scans
from posegraph_slam.datasets.simulation.settings import EncoderSettings, ImuSettings, LidarSettings
from posegraph_slam.datasets.simulation.solid_raycast import cast_tilted_scans, ranges_to_posts
from posegraph_slam.datasets.simulation.world import World
from posegraph_slam.execution import Progress, split_range
from posegraph_slam.geometry import SO3, xyt_from_pose
from posegraph_slam.sensors import STANDARD_GRAVITY

SCANS_A_CHUNK = 512
SECTORS = 27
"""Pieces of a scan with a pose of their own when the robot moves during the sweep: 10 degrees each."""


def stamp_times(rate_hz: float, start_s: float, end_s: float, rng: np.random.Generator) -> FloatArray:
    """Draw the stamps (n,) of a stream in seconds since the begin: a regular clock with 5 % of jitter a stamp."""
    period = 1.0 / rate_hz
    times = np.arange(start_s + rng.uniform(0, period), end_s, period)
    return np.asarray(times + rng.uniform(-0.05, 0.05, size=len(times)) * period, dtype=np.float64)


def encoder_counts(
    motion: Motion, times_s: FloatArray, settings: EncoderSettings, rng: np.random.Generator
) -> IntArray:
    """Count the ticks (n, 4) of the wheels FR FL RR RL since the previous stamp; none at the first stamp.

    Each side has a scale error, each wheel slips by a random walk over its way; fractions of a tick are carried over.
    """
    distance, heading = motion.distance_at(times_s), motion.turn_at(times_s)
    side = np.array([1.0, -1.0, 1.0, -1.0])  # right wheels are outside in a left turn
    way = distance[:, None] + side * (robot.TRACK_WIDTH_M / 2) * heading[:, None]
    step = np.diff(way, axis=0, prepend=way[:1])
    scale = 1.0 + settings.sigma_scale * np.tile(rng.normal(size=2), 2)
    slip = settings.sigma_slip_m * np.sqrt(np.abs(step)) * rng.normal(size=step.shape)
    rolled = np.cumsum(step * scale + slip, axis=0) / robot.METRES_PER_TICK
    total = np.floor(rolled + rng.random(4))
    return np.asarray(np.diff(total, axis=0, prepend=total[:1]), dtype=np.int64)


def imu_samples(
    motion: Motion, times_s: FloatArray, settings: ImuSettings, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Measure angular velocity (n, 3) in rad/s and acceleration (n, 3) in g at the base, gravity upwards as +1 g.

    The gyro has a bias that walks, a scale error and white noise, the accelerometer a bias and white noise. The base
    moves along its own x axis, so that its acceleration is [dv/dt, v omega_z, -v omega_y].
    """
    rate, up = _angular_velocity(motion, times_s)
    period = np.diff(times_s, prepend=times_s[:1])
    bias = settings.sigma_bias_rad_s * rng.normal(size=3)
    walk = np.cumsum(settings.sigma_walk_rad_s * np.sqrt(period)[:, None] * rng.normal(size=(len(times_s), 3)), axis=0)
    gyro = bias + walk + settings.sigma_gyro_rad_s * rng.normal(size=(len(times_s), 3))
    gyro += (1.0 + settings.sigma_scale * rng.normal()) * rate
    half = 0.01
    speed_before, speed_after = (_speed(motion, times_s + shift) for shift in (-half, half))
    ahead = (speed_after - speed_before) / (2 * half) / STANDARD_GRAVITY
    speed = (speed_before + speed_after) / 2 / STANDARD_GRAVITY
    acceleration = np.stack([ahead, speed * rate[:, 2], -speed * rate[:, 1]], axis=1) + up
    noise = settings.sigma_accelerometer_g * rng.normal(size=acceleration.shape)
    return gyro, acceleration + noise + settings.sigma_accelerometer_bias_g * rng.normal(size=3)


def _angular_velocity(motion: Motion, times_s: FloatArray, half_s: float = 0.004) -> tuple[FloatArray, FloatArray]:
    """Mean angular velocity (n, 3) of the base within `half_s` of each time, and the upward direction (n, 3) in it."""
    before, at, after = (motion.spatial_poses_at(times_s + shift)[:, :3, :3] for shift in (-half_s, 0.0, half_s))
    return SO3.log(np.swapaxes(before, 1, 2) @ after) / (2 * half_s), at[:, 2]


def _speed(motion: Motion, times_s: FloatArray, half_s: float = 0.004) -> FloatArray:
    return (motion.distance_at(times_s + half_s) - motion.distance_at(times_s - half_s)) / (2 * half_s)


def lidar_increment(settings: LidarSettings) -> float:
    """Angle between beams; the fan is symmetric about the x-axis."""
    return -2 * robot.LIDAR_ANGLE_MIN_RAD / (settings.beams - 1)


def lidar_poses(motion: Motion, times_s: FloatArray, settings: LidarSettings) -> FloatArray:
    """T_world_lidar (n, K, 4, 4): at the stamp, or of K sectors of the sweep that starts there."""
    sectors = SECTORS if settings.sweep_s > 0 else 1
    offsets = settings.sweep_s * (np.arange(sectors) + 0.5) / sectors
    poses = motion.spatial_poses_at((times_s[:, None] + offsets).ravel()) @ robot.T_BASE_LIDAR
    return np.asarray(poses).reshape(len(times_s), sectors, 4, 4)


def lidar_ranges(
    motion: Motion,
    world: World,
    times_s: FloatArray,
    settings: LidarSettings,
    rng: np.random.Generator,
    progress: Progress,
) -> Float32Array:
    """Cast and disturb the scans (n, beams) float32 at `times_s`, in whole millimetres.

    Noise is Gaussian; lost ranges read 0.001 and beams without a return 60, as on the real robot.
    """
    ranges = np.empty((len(times_s), settings.beams), dtype=np.float32)
    angles: FloatArray = robot.LIDAR_ANGLE_MIN_RAD + lidar_increment(settings) * np.arange(settings.beams, dtype=float)
    posts = ranges_to_posts(angles, robot.ANTENNAE if settings.antennae else np.zeros((0, 3)))
    for start, stop in split_range(len(times_s), SCANS_A_CHUNK):
        poses = lidar_poses(motion, times_s[start:stop], settings)
        exact = np.minimum(_exact_ranges(world, poses, angles), posts)
        ranges[start:stop] = _disturb(exact, settings, rng)
        progress("scans", stop, len(times_s))
    return ranges


def _exact_ranges(world: World, poses: FloatArray, angles: FloatArray) -> FloatArray:
    """Ranges (n, B) of the world from T_world_lidar (n, K, 4, 4), in the plan view where the ground is flat."""
    if world.terrain is None:
        fan = np.array([angles[0], angles[1] - angles[0]])
        planar = np.ascontiguousarray(xyt_from_pose(poses))
        return cast_scans(planar, fan, len(angles), world.segments, world.circles)
    terrain, poses = world.terrain, np.ascontiguousarray(poses)
    return np.asarray(
        cast_tilted_scans(
            poses, angles, world.segments, world.circles, terrain.spans_m, terrain.patches, terrain.ceiling_m
        )
    )


def _disturb(exact: FloatArray, settings: LidarSettings, rng: np.random.Generator) -> FloatArray:
    """Add noise to exact ranges (n, B), round to millimetres, and lose some."""
    noisy = np.round(exact + settings.sigma_range_m * rng.standard_normal(exact.shape), 3)
    chance = rng.random(exact.shape)
    outside = (noisy >= robot.LIDAR_RANGE_MAX_M) | (chance < settings.no_return_rate)
    noisy[outside] = robot.LIDAR_NO_RETURN_M
    noisy[(noisy < robot.LIDAR_RANGE_MIN_M) | (chance > 1 - settings.dropout_rate)] = robot.LIDAR_DROPOUT_M
    return noisy
