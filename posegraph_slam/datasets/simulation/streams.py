"""What the wheels, the IMU and the laser scanner report of a drive, with their errors."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray, IntArray
from posegraph_slam.datasets.simulation import robot
from posegraph_slam.datasets.simulation.motion import Motion
from posegraph_slam.datasets.simulation.raycast import cast_scans
from posegraph_slam.datasets.simulation.settings import EncoderSettings, ImuSettings, LidarSettings
from posegraph_slam.datasets.simulation.world import World
from posegraph_slam.execution import Progress, split_range
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
    distance, heading = motion.distance_at(times_s), motion.heading_at(times_s)
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
    """Measure angular velocity (n, 3) in rad/s and acceleration (n, 3) in g at the base, gravity upwards as +1 g on z.

    The gyro has a bias that walks, a scale error and white noise. Acceleration is that of the drive and of its turns.
    """
    rate = _yaw_rate(motion, times_s)
    period = np.diff(times_s, prepend=times_s[:1])
    bias = settings.sigma_bias_rad_s * rng.normal(size=3)
    walk = np.cumsum(settings.sigma_walk_rad_s * np.sqrt(period)[:, None] * rng.normal(size=(len(times_s), 3)), axis=0)
    gyro = bias + walk + settings.sigma_gyro_rad_s * rng.normal(size=(len(times_s), 3))
    gyro[:, 2] += (1.0 + settings.sigma_scale * rng.normal()) * rate
    half = 0.01
    speed_before, speed_after = (_speed(motion, times_s + shift) for shift in (-half, half))
    ahead = (speed_after - speed_before) / (2 * half) / STANDARD_GRAVITY
    aside = (speed_before + speed_after) / 2 * rate / STANDARD_GRAVITY
    acceleration = np.stack([ahead, aside, np.ones(len(times_s))], axis=1)
    return gyro, acceleration + settings.sigma_accelerometer_g * rng.normal(size=acceleration.shape)


def _yaw_rate(motion: Motion, times_s: FloatArray, half_s: float = 0.004) -> FloatArray:
    """Mean yaw rate (n,) within `half_s` of each time."""
    return (motion.heading_at(times_s + half_s) - motion.heading_at(times_s - half_s)) / (2 * half_s)


def _speed(motion: Motion, times_s: FloatArray, half_s: float = 0.004) -> FloatArray:
    return (motion.distance_at(times_s + half_s) - motion.distance_at(times_s - half_s)) / (2 * half_s)


def lidar_increment(settings: LidarSettings) -> float:
    """Angle between beams; the fan is symmetric about the x-axis."""
    return -2 * robot.LIDAR_ANGLE_MIN_RAD / (settings.beams - 1)


def lidar_poses(motion: Motion, times_s: FloatArray, settings: LidarSettings) -> FloatArray:
    """Poses (n, K, 3) of the scanner in the world: at the stamp, or of K sectors of the sweep that starts there."""
    sectors = SECTORS if settings.sweep_s > 0 else 1
    offsets = settings.sweep_s * (np.arange(sectors) + 0.5) / sectors
    xyt = motion.xyt_at((times_s[:, None] + offsets).ravel()).reshape(len(times_s), sectors, 3)
    x, y = robot.T_BASE_LIDAR[:2, 3]
    c, s = np.cos(xyt[..., 2]), np.sin(xyt[..., 2])
    return np.stack([xyt[..., 0] + c * x - s * y, xyt[..., 1] + s * x + c * y, xyt[..., 2]], axis=-1)


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
    fan = np.array([robot.LIDAR_ANGLE_MIN_RAD, lidar_increment(settings)])
    for start, stop in split_range(len(times_s), SCANS_A_CHUNK):
        poses = lidar_poses(motion, times_s[start:stop], settings)
        exact = cast_scans(poses, fan, settings.beams, world.segments, world.circles)
        ranges[start:stop] = _disturb(exact, settings, rng)
        progress("scans", stop, len(times_s))
    return ranges


def _disturb(exact: FloatArray, settings: LidarSettings, rng: np.random.Generator) -> FloatArray:
    """Add noise to exact ranges (n, B), round to millimetres, and lose some."""
    noisy = np.round(exact + settings.sigma_range_m * rng.standard_normal(exact.shape), 3)
    chance = rng.random(exact.shape)
    outside = (noisy >= robot.LIDAR_RANGE_MAX_M) | (chance < settings.no_return_rate)
    noisy[outside] = robot.LIDAR_NO_RETURN_M
    noisy[(noisy < robot.LIDAR_RANGE_MIN_M) | (chance > 1 - settings.dropout_rate)] = robot.LIDAR_DROPOUT_M
    return noisy
