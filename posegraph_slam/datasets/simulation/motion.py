"""When the robot is where: a path driven at bounded speed, yaw rate and acceleration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.datasets.simulation.route import STEP_M, Path, rotation_on_ground
from posegraph_slam.datasets.simulation.settings import DriveSettings
from posegraph_slam.geometry import pose_from_rotation_translation, pose_from_xyt


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """A drive along `path`: times (P,) in seconds since the begin at which its samples are passed, speed and slowing.

    Before the first time and after the last one the robot stands. `acceleration_m_s2` (P,) is the one after the
    sample. The wheels of a side roll the distance of the centre minus or plus half the track times the turn, exactly.
    """

    path: Path
    times_s: FloatArray
    acceleration_m_s2: FloatArray
    speed_m_s: FloatArray
    end_s: float

    def __post_init__(self) -> None:
        for name in ("times_s", "acceleration_m_s2", "speed_m_s"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def distance_at(self, times_s: FloatArray) -> FloatArray:
        """Distance travelled (n,) at times since the begin."""
        k = np.clip(np.searchsorted(self.times_s, times_s, side="right") - 1, 0, len(self.times_s) - 1)
        elapsed = np.clip(times_s - self.times_s[k], 0.0, None)
        after = self.path.distance_m[k] + (self.speed_m_s[k] + 0.5 * self.acceleration_m_s2[k] * elapsed) * elapsed
        return np.asarray(np.where(times_s >= self.times_s[-1], self.path.distance_m[-1], after), dtype=np.float64)

    def heading_at(self, times_s: FloatArray) -> FloatArray:
        """Heading (n,), unwrapped, at times since the begin."""
        return np.interp(self.distance_at(times_s), self.path.distance_m, self.path.heading_rad)

    def turn_at(self, times_s: FloatArray) -> FloatArray:
        """Turn (n,) about the robot's own vertical axis since the begin, unwrapped."""
        return np.interp(self.distance_at(times_s), self.path.distance_m, self.path.turn_rad)

    def xyt_at(self, times_s: FloatArray) -> FloatArray:
        """Planar pose (n, 3) [x, y, heading] of the base in the world at times since the begin."""
        distance = self.distance_at(times_s)
        columns = (*self.path.position_m.T, self.path.heading_rad)
        return np.stack([np.interp(distance, self.path.distance_m, column) for column in columns], axis=-1)

    def poses_at(self, times_s: FloatArray) -> FloatArray:
        """T_world_base (n, 3, 3) in the plane at times since the begin."""
        return pose_from_xyt(self.xyt_at(times_s))

    def spatial_poses_at(self, times_s: FloatArray) -> FloatArray:
        """T_world_base (n, 4, 4) at times since the begin, tilted and lifted as the ground is."""
        distance, path = self.distance_at(times_s), self.path
        columns = (path.height_m, *path.gradient.T)
        height, *gradient = (np.interp(distance, path.distance_m, column) for column in columns)
        xyt = self.xyt_at(times_s)
        R = rotation_on_ground(xyt[:, 2], np.stack(gradient, axis=1))
        return pose_from_rotation_translation(R, np.column_stack([xyt[:, :2], height]))


def drive_path(path: Path, settings: DriveSettings) -> Motion:
    """Drive `path` as fast as the bounds on speed, yaw rate and acceleration allow, from standstill to standstill.

    The squared speed is the lower envelope of its bounds v_k^2 + 2 a |s - s_k|, found by two running minima. The
    recording ends one second after the stop, or at `settings.duration_s` if that is sooner.
    """
    curvature = np.abs(np.gradient(path.heading_rad, STEP_M))
    bound = np.minimum(settings.speed_m_s, settings.yaw_rate_rad_s / np.maximum(curvature, 1e-6)) ** 2
    bound[[0, -1]] = 0.0
    ramp = 2 * settings.acceleration_m_s2 * path.distance_m
    squared = np.minimum.accumulate(bound - ramp) + ramp
    squared = np.minimum.accumulate((squared + ramp)[::-1])[::-1] - ramp
    speed = np.sqrt(np.maximum(squared, 0.0))
    steps = 2 * STEP_M / (speed[1:] + speed[:-1])
    times = settings.still_s + np.concatenate([[0.0], np.cumsum(steps)])
    acceleration = np.append(np.diff(speed) / steps, 0.0)
    end = float(times[-1]) + 1.0
    if settings.duration_s is not None:
        end = min(end, settings.duration_s)
    return Motion(path=path, times_s=times, acceleration_m_s2=acceleration, speed_m_s=speed, end_s=end)
