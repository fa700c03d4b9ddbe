"""Logs of the four-wheeled robot of UCSD ECE276A and UPenn ESE650: a folder of .npz streams and Kinect frames.

Encoders (`counts` 4 x N, rows FR FL RR RL, ticks since the last stamp), IMU (rad/s and g), Hokuyo UTM-30LX (ranges
beams x N) and Kinect stamps are one file each, named with the number of the run: `Encoders20.npz`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray, in_range, read_only, single
from posegraph_slam.datasets.coverage import uneven_coverage
from posegraph_slam.datasets.ece276a_frames import find_frames
from posegraph_slam.datasets.npz import Archive
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory, pose_from_rotation_translation
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu, LaserScans, RgbdFrames, RobotLog, WheelEncoders

METRES_PER_TICK = 0.0022
"""Wheel diameter 0.254 m, 360 ticks a turn: 0.002217 m, of which the data sheet gives two digits."""
TRACK_WIDTH_M = 0.75
"""Effective when turning: the wheels stand 0.31 to 0.48 m apart, but a skid-steered robot slips as it turns.

Run 20 against its gyro gives 0.754 m and against its LiDAR path 0.748 m (least squares over turns of 1 to 5 s).
"""
TICKS_MAX = 1e9
"""Between two stamps: two thousand kilometres, as an overflown counter gives."""
T_BASE_LIDAR = read_only(pose_from_rotation_translation(np.eye(3), np.array([0.133, 0.0, 0.514])))
T_BASE_CAMERA = read_only(
    pose_from_rotation_translation(
        Rotation.from_euler("xyz", [0.0, 0.36, 0.021]).as_matrix(), np.array([0.18, 0.005, 0.36])
    )
)
"""Roll 0, pitch 0.36 (the camera looks down), yaw 0.021 rad."""
STREAMS = ("Encoders", "Imu", "Hokuyo", "Kinect")
RUN_FILE = re.compile(r"(Encoders|Imu|Hokuyo)(\d*)\.npz")


def detects(path: Path) -> bool:
    """Tell whether `path` is a folder with encoders, IMU or LiDAR of a run, or one of these files."""
    try:
        names = [entry.name for entry in path.iterdir()] if path.is_dir() else [path.name] * path.is_file()
    except OSError:
        return False
    return any(RUN_FILE.fullmatch(name) for name in names)


def read(path: str | Path) -> RobotLog:
    """Read the run in a folder (or the run that one of its .npz files belongs to) into a `RobotLog`.

    Frames: base on the floor between the wheels, x ahead. Accelerations become m/s^2; ranges keep their order of beams.
    A stream that was not recorded is None. Raises `InputError` naming the file and field that cannot be used.
    """
    path = Path(path)
    folder, run = _locate(path)
    remarks: list[str] = []
    files = {stream: folder / f"{stream}{run}.npz" for stream in STREAMS}
    present = {stream: Archive(file) for stream, file in files.items() if file.is_file()}
    encoders = _encoders(present["Encoders"]) if "Encoders" in present else None
    imu = _imu(present["Imu"], remarks) if "Imu" in present else None
    scans = _scans(present["Hokuyo"], remarks) if "Hokuyo" in present else None
    rgbd = _rgbd(present["Kinect"], run, remarks) if "Kinect" in present else None
    remarks += [f"there is no {files[stream].name}" for stream in STREAMS[:3] if stream not in present]
    clocks = {"scans": scans, "encoders": encoders, "imu": imu}
    stamps = {name: stream.stamps_s for name, stream in clocks.items() if stream is not None}
    if rgbd is not None:
        stamps |= {"disparity": rgbd.disparity_stamps_s, "colour": rgbd.colour_stamps_s}
    return RobotLog(
        path=path,
        format="ece276a",
        scans=scans,
        encoders=encoders,
        imu=imu,
        rgbd=rgbd,
        truth=_truth(folder, run),
        remarks=(*remarks, *uneven_coverage(stamps)),
    )


def _locate(path: Path) -> tuple[Path, str]:
    """Return the folder and the number of the run, which may be empty."""
    if not path.is_dir():
        match = RUN_FILE.fullmatch(path.name)
        if match is None or not path.is_file():
            raise InputError(path, "is no folder of this format", "give the folder that holds Encoders*.npz")
        return path.parent, match[2]
    runs = sorted({match[2] for entry in path.iterdir() if (match := RUN_FILE.fullmatch(entry.name))})
    if not runs:
        raise InputError(path, "holds no Encoders*.npz, Imu*.npz or Hokuyo*.npz", "give the folder that holds them")
    if len(runs) > 1:
        example = next(entry.name for entry in sorted(path.iterdir()) if RUN_FILE.fullmatch(entry.name))
        problem = f"holds several runs ({', '.join(run or 'without number' for run in runs)})"
        raise InputError(path, problem, f"give a file of the run you mean, such as {example}")
    return path, runs[0]


def _encoders(archive: Archive) -> WheelEncoders:
    stamps = archive.stamps("time_stamps")
    counts = archive.finite_samples("counts", 4, stamps)
    whole = np.rint(counts)
    if np.abs(counts - whole).max() > 1e-6:
        index = int(np.argmax(np.abs(counts - whole).max(axis=0)))
        raise InputError(archive.path, f"field 'counts' at index {index} is not a whole number of ticks")
    if np.abs(whole).max() > TICKS_MAX:
        index = int(np.argmax(np.abs(whole).max(axis=0)))
        problem = f"field 'counts' at index {index} is {whole[np.abs(whole[:, index]).argmax(), index]:g} ticks"
        raise InputError(archive.path, problem, "counts are ticks since the last stamp: repair the log")
    ticks = whole.astype(np.int64)
    return WheelEncoders(
        stamps_s=stamps,
        ticks_right=ticks[[0, 2]].T,
        ticks_left=ticks[[1, 3]].T,
        metres_per_tick=archive.scalar("metres_per_tick") if "metres_per_tick" in archive else METRES_PER_TICK,
        track_width_m=archive.scalar("track_width_m") if "track_width_m" in archive else TRACK_WIDTH_M,
    )


def _imu(archive: Archive, remarks: list[str]) -> Imu:
    stamps = archive.stamps("time_stamps")
    angular = archive.finite_samples("angular_velocity", 3, stamps).T
    linear = archive.finite_samples("linear_acceleration", 3, stamps).T
    # The format is in g; re-exported logs in m/s^2 exist, and gravity (9.8 against 1) tells them apart.
    median = float(np.median(np.linalg.norm(linear, axis=1)))
    if 5.0 < median < 15.0:
        remarks.append(f"accelerations are in m/s^2 already (median {median:.2f})")
    else:
        linear = linear * STANDARD_GRAVITY
        remarks.append(f"accelerations converted from g to m/s^2 (median was {median:.3f} g)")
    return Imu(stamps_s=stamps, angular_velocity=angular, linear_acceleration=linear, T_base_imu=np.eye(4))


def _scans(archive: Archive, remarks: list[str]) -> LaserScans:
    stamps = archive.stamps("time_stamps")
    ranges = archive.samples("ranges", None, stamps)
    start, stop, step = (archive.scalar(f"angle_{name}") for name in ("min", "max", "increment"))
    nearest, farthest = archive.scalar("range_min"), archive.scalar("range_max")
    beams = ranges.shape[0]
    if step == 0 or abs(start + (beams - 1) * step - stop) > abs(step):
        problem = f"{beams} beams of {step:.6g} rad from angle_min {start:.4f} do not end at angle_max {stop:.4f}"
        raise InputError(archive.path, problem, "check ranges (beams, scans) and the angles")
    if not 0 <= nearest < farthest:
        raise InputError(archive.path, f"range_min {nearest:g} and range_max {farthest:g} leave no range to use")
    ranges_m = single(ranges.T)
    missing = int(np.count_nonzero(~np.isfinite(ranges_m)))
    if missing:
        remarks.append(f"{missing} of {ranges_m.size} ranges are NaN or infinite and count as no return")
    return LaserScans(
        stamps_s=stamps,
        ranges_m=ranges_m,
        angle_min_rad=start,
        angle_increment_rad=step,
        range_min_m=nearest,
        range_max_m=farthest,
        T_base_lidar=_mounting(archive) if "T_base_lidar" in archive else T_BASE_LIDAR,
    )


def _mounting(archive: Archive) -> FloatArray:
    T = np.asarray(archive.numbers("T_base_lidar"), dtype=np.float64)
    if T.shape != (4, 4) or not in_range(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-6:
        raise InputError(archive.path, f"field 'T_base_lidar' {T.shape} is no pose", "give a 4 x 4 transform, or none")
    return T


def _rgbd(archive: Archive, run: str, remarks: list[str]) -> RgbdFrames:
    disparity_stamps, colour_stamps = (archive.stamps(f"{name}_time_stamps") for name in ("disparity", "rgb"))
    folder = archive.path.parent
    return RgbdFrames(
        disparity_stamps_s=disparity_stamps,
        colour_stamps_s=colour_stamps,
        disparity_files=find_frames(folder, "disparity", run, len(disparity_stamps), remarks),
        colour_files=find_frames(folder, "rgb", run, len(colour_stamps), remarks),
        T_base_camera=T_BASE_CAMERA,
    )


def _truth(folder: Path, run: str) -> Trajectory | None:
    """Read `truth<run>.tum`, else `truth.tum`, when there is one."""
    for name in dict.fromkeys((f"truth{run}.tum", "truth.tum")):
        if (folder / name).is_file():
            return read_tum(folder / name, parent="ref", child="base")
    return None
