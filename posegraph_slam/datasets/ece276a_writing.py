"""Folders in the ECE276A layout written from any log with a laser."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.datasets.ece276a import METRES_PER_TICK, TRACK_WIDTH_M
from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.errors import InputError
from posegraph_slam.files import name_target
from posegraph_slam.geometry import SE2, Trajectory
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu, LaserScans, RgbdFrames, RobotLog, WheelEncoders

RUN = "1"


def write_ece276a(log: RobotLog, folder: Path, odometry: Trajectory) -> list[str]:
    """Write Encoders1.npz, Hokuyo1.npz and, where the log has them, Imu1.npz, Kinect1.npz with frames and truth1.tum.

    A log without wheel encoders gets counts that integrate to `odometry` (N, 3, 3), to half a tick. Optional fields
    keep what the layout takes for granted: T_base_lidar, metres_per_tick, track_width_m. Returns remarks on what had
    to be changed. The folder is written beside its name and moved there. Raises `InputError` for a log without scans.
    """
    if log.scans is None:
        raise InputError(log.path, "has no laser scans", "the layout needs them")
    remarks: list[str] = []
    unfinished = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    try:
        _write_scans(log.scans, unfinished, remarks)
        encoders = log.encoders
        if encoders is None:
            encoders = encoders_of(odometry, remarks)
        _write_encoders(encoders, unfinished)
        if log.imu is not None:
            _write_imu(log.imu, unfinished, remarks)
        if log.rgbd is not None:
            _write_frames(log.rgbd, unfinished)
        if log.truth is not None:
            write_tum(log.truth, unfinished / f"truth{RUN}.tum")
        if folder.exists():
            shutil.rmtree(folder)
        unfinished.rename(folder)
    except OSError as error:
        name_target(error, unfinished, folder)
        raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    if log.relations is not None:
        remarks.append("the layout has no relations: they are left out")
    return remarks


def rising(stamps_s: FloatArray, what: str, remarks: list[str]) -> FloatArray:
    """Return stamps that never run backwards, each at least the one before, as the layout demands."""
    raised = np.maximum.accumulate(stamps_s) if len(stamps_s) else stamps_s
    late = int(np.count_nonzero(raised != stamps_s))
    if late:
        remarks.append(f"{late} stamps of the {what} run backwards, which the layout forbids: they are raised")
    return raised


def encoders_of(odometry: Trajectory, remarks: list[str]) -> WheelEncoders:
    """Return the counts of a differential drive that moves as `odometry` does, rounded so that no error adds up."""
    stamps = rising(odometry.stamps_s, "odometry", remarks)
    step = SE2.log(SE2.between(odometry.poses[:-1], odometry.poses[1:]))
    sideways = float(np.abs(step[:, 1]).sum())
    length = float(np.abs(step[:, 0]).sum())
    if sideways > 0.02 * max(length, 1.0):
        remarks.append(f"odometry moves {sideways:.1f} m sideways, which two wheels cannot: that part is left out")
    half = TRACK_WIDTH_M / 2 * step[:, 2]
    sides = np.cumsum(np.stack([step[:, 0] - half, step[:, 0] + half], axis=1), axis=0) / METRES_PER_TICK
    whole: IntArray = np.rint(np.concatenate([np.zeros((1, 2)), sides])).astype(np.int64)
    ticks = np.diff(whole, axis=0, prepend=np.zeros((1, 2), dtype=np.int64))
    remarks.append("there are no wheel encoders: their counts are made from the odometry")
    return WheelEncoders(
        stamps_s=stamps,
        ticks_left=ticks[:, :1],
        ticks_right=ticks[:, 1:],
        metres_per_tick=METRES_PER_TICK,
        track_width_m=TRACK_WIDTH_M,
    )


def _write_encoders(encoders: WheelEncoders, folder: Path) -> None:
    """Write rows FR FL RR RL; a side with one wheel counts twice."""
    left, right = encoders.ticks_left, encoders.ticks_right
    counts = np.stack([right[:, 0], left[:, 0], right[:, -1], left[:, -1]])
    small = np.abs(counts).max(initial=0) < np.iinfo(np.int16).max
    np.savez(
        folder / f"Encoders{RUN}.npz",
        counts=counts.astype(np.int16 if small else np.int64),
        time_stamps=encoders.stamps_s,
        metres_per_tick=np.array(encoders.metres_per_tick),
        track_width_m=np.array(encoders.track_width_m),
    )


def _write_scans(scans: LaserScans, folder: Path, remarks: list[str]) -> None:
    np.savez(
        folder / f"Hokuyo{RUN}.npz",
        ranges=scans.ranges_m.T,
        time_stamps=rising(scans.stamps_s, "scans", remarks),
        angle_min=np.array(scans.angle_min_rad),
        angle_max=np.array(scans.angle_min_rad + (scans.beams - 1) * scans.angle_increment_rad),
        angle_increment=np.array([[scans.angle_increment_rad]]),
        range_min=np.array(scans.range_min_m),
        range_max=np.array(scans.range_max_m),
        T_base_lidar=scans.T_base_lidar,
    )


def _write_imu(imu: Imu, folder: Path, remarks: list[str]) -> None:
    """Write rates and accelerations (g) in the base frame; the layout has no mounting and no gaps."""
    R = imu.T_base_imu[:3, :3]
    known = np.isfinite(imu.angular_velocity).all(axis=1) & np.isfinite(imu.linear_acceleration).all(axis=1)
    if not known.all():
        remarks.append(f"{int(np.count_nonzero(~known))} measurements of the IMU are not finite and are left out")
    np.savez(
        folder / f"Imu{RUN}.npz",
        angular_velocity=R @ imu.angular_velocity[known].T,
        linear_acceleration=R @ imu.linear_acceleration[known].T / STANDARD_GRAVITY,
        time_stamps=rising(imu.stamps_s[known], "IMU", remarks),
    )


def _write_frames(rgbd: RgbdFrames, folder: Path) -> None:
    np.savez(
        folder / f"Kinect{RUN}.npz",
        disparity_time_stamps=rgbd.disparity_stamps_s,
        rgb_time_stamps=rgbd.colour_stamps_s,
    )
    for kind, files in (("Disparity", rgbd.disparity_files), ("RGB", rgbd.colour_files)):
        place = folder / "dataRGBD" / f"{kind}{RUN}"
        for number, file in enumerate(files, 1):
            if file is not None and file.suffix.lower() == ".png":
                place.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, place / f"{kind.lower()}{RUN}_{number}.png")
