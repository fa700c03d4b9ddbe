"""What is suspicious about one stream: each check returns plain sentences, none when all is well."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import Trajectory, inverse_pose
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu, LaserScans, WheelEncoders

GAP_FACTOR, LEAST_GAP_S = 10.0, 0.5
"""A gap is ten mean intervals long, and at least half a second: robots are hardly faster than 1 m/s."""
LEAP_M, LEAP_RAD = 1.0, np.deg2rad(30.0)
"""Odometry that moves farther between two scans has slipped, stalled or been reset."""
DROPOUT_SHARE, EMPTY_SHARE = 0.005, 0.1
"""Worth a sentence: one beam in two hundred drops out, a scan in which fewer than one beam in ten returns."""
FASTEST_GYRO_RAD_S = 20.0
"""1100 degrees/s: no wheeled robot turns so fast, but its rate in degrees/s soon exceeds 20."""


def suspicious_clock(name: str, stamps_s: FloatArray) -> list[str]:
    """Look for stamps (N,) that run backwards, repeat, come in bursts or leave gaps."""
    steps = np.diff(stamps_s)
    if not len(steps):
        return [f"the {name} stream holds a single sample"] if len(stamps_s) else [f"the {name} stream is empty"]
    found = []
    back = steps < 0
    if back.any():
        found.append(
            f"the {name} clock runs backwards {_times(int(back.sum()))}, by up to {-steps.min():.3f} s: "
            "the order of the log is kept"
        )
    ordered = np.sort(stamps_s)
    gaps = np.diff(ordered)
    repeated = int(np.count_nonzero(gaps == 0))
    if repeated:
        found.append(f"{repeated} {name} stamps repeat an earlier one")
    mean = float(gaps.mean())
    short = float(np.mean(gaps < 0.2 * mean))
    if len(gaps) >= 20 and short > 0.2:
        found.append(
            f"{name} stamps come in bursts: {100 * short:.0f} % follow within a fifth of the mean {mean:.3f} s"
        )
    long = gaps > max(GAP_FACTOR * mean, LEAST_GAP_S)
    if long.any():
        k = int(np.argmax(gaps))
        count = int(long.sum())
        noun = "gap" if count == 1 else "gaps"
        found.append(
            f"{count} {noun} in the {name} stream, the longest {gaps[k]:.2f} s, {ordered[k] - ordered[0]:.1f} s in"
        )
    return found


def suspicious_ranges(scans: LaserScans) -> list[str]:
    """Look for dropouts, values that are no number, and scans that see almost nothing."""
    found = []
    ranges = scans.ranges_m
    dropouts = float(np.mean(ranges < scans.range_min_m))
    if dropouts > DROPOUT_SHARE:
        found.append(f"{100 * dropouts:.1f} % of the beams are dropouts (below {scans.range_min_m:.2g} m)")
    broken = int(np.count_nonzero(~np.isfinite(ranges)))
    if broken:
        found.append(f"{broken} ranges are NaN or infinite ({100 * broken / ranges.size:.3g} % of the beams)")
    empty = int(np.count_nonzero(scans.returns().mean(axis=1) < EMPTY_SHARE))
    if empty:
        found.append(f"{empty} scans have returns on fewer than {100 * EMPTY_SHARE:.0f} % of their beams")
    return found


def suspicious_imu(imu: Imu) -> list[str]:
    """Look for accelerations in g or without gravity, and angular velocities in degrees."""
    if not len(imu):
        return []
    found = []
    gravity = float(np.median(np.linalg.norm(imu.linear_acceleration, axis=1)))
    if 0.5 < gravity < 2.0:
        found.append(f"the imu's accelerations look like g, not m/s^2 (median {gravity:.2f})")
    elif not 0.8 * STANDARD_GRAVITY < gravity < 1.2 * STANDARD_GRAVITY:
        found.append(f"the imu does not measure gravity: the median acceleration is {gravity:.2f} m/s^2")
    fastest = float(np.abs(imu.angular_velocity).max())
    if fastest > FASTEST_GYRO_RAD_S:
        found.append(f"the imu's angular velocity reaches {fastest:.0f} rad/s: it may be in degrees")
    return found


def suspicious_encoders(encoders: WheelEncoders) -> list[str]:
    """Look for wheels that never turn though others do, and for impossible speeds."""
    found = []
    ticks = {"left": encoders.ticks_left, "right": encoders.ticks_right}
    moving = any(side.any() for side in ticks.values())
    for name, side in ticks.items():
        still = np.flatnonzero(~side.any(axis=0)) if moving else ()
        found += [f"wheel {wheel + 1} of the {name} side never turns" for wheel in still]
    interval = np.diff(encoders.stamps_s)
    typical = float(np.median(interval)) if len(interval) else 0.0
    if typical > 0:
        speed = np.abs(encoders.travel_m).max(axis=1) / typical
        fast = int(np.count_nonzero(speed > 5.0))
        if fast:
            found.append(f"the wheels exceed 5 m/s at {fast} stamps (up to {speed.max():.0f} m/s)")
    if not moving:
        found.append("the wheels never turn")
    return found


def suspicious_odometry(trajectory: Trajectory) -> list[str]:
    """Look for leaps between consecutive poses, in the order of the log, and for a robot that never moves."""
    if len(trajectory) < 2:
        return []
    steps = inverse_pose(trajectory.poses[:-1]) @ trajectory.poses[1:]
    distance = np.linalg.norm(steps[:, :-1, -1], axis=1)
    turn = np.linalg.norm(trajectory.group.log(steps)[:, _rotation(trajectory)], axis=1)
    leaps = (distance > LEAP_M) | (turn > LEAP_RAD)
    found = []
    if leaps.any():
        found.append(
            f"odometry leaps {_times(int(leaps.sum()))} between two poses (up to {distance.max():.2f} m, "
            f"{np.rad2deg(turn.max()):.0f} degrees; the first at pose {int(np.argmax(leaps)) + 1})"
        )
    if not distance.any() and not turn.any():
        found.append("odometry never moves")
    return found


def _rotation(trajectory: Trajectory) -> slice:
    """The rotation in a tangent: last of SE(2), first of SE(3)."""
    return slice(2, 3) if trajectory.group.dimension == 2 else slice(0, 3)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
