"""Trajectories in the formats of others: TUM, KITTI, EuRoC and plain CSV, told apart by suffix and content."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.csv_table import read_csv
from posegraph_slam.datasets.number_text import read_table, refuse_first, require_in_range
from posegraph_slam.datasets.tum import read_tum, write_tum
from posegraph_slam.errors import InputError, did_you_mean
from posegraph_slam.files import replacing
from posegraph_slam.geometry import Trajectory, pose_from_rotation_translation

KITTI_COLUMNS = tuple(f"r{row}{column}" if column < 4 else f"t{row}" for row in (1, 2, 3) for column in (1, 2, 3, 4))
EUROC_COLUMNS = ("timestamp [ns]", "p_RS_R_x [m]", "p_RS_R_y [m]", "p_RS_R_z [m]",
                 "q_RS_w []", "q_RS_x []", "q_RS_y []", "q_RS_z []")  # fmt: skip
CSV_COLUMNS = ("stamp_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
ROTATION_TOLERANCE = 1e-3
"""KITTI's matrices are written with 6 to 12 digits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryFormat:
    """How a format is read (path, stamps file or None) and written (trajectory in stamp order, path)."""

    suffix: str
    read: Callable[[Path, Path | None, str, str], Trajectory]
    write: Callable[[Trajectory, Path], None]


def read_trajectory(
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002 - the word users know
    times: Path | None = None,
    parent: str = "ref",
    child: str = "base",
) -> Trajectory:
    """Read poses T_parent_child (N, 4, 4) from a TUM, KITTI, EuRoC or CSV file, in the order of the file.

    `times` is the file of KITTI's stamps, one a line; without it `NAME_times.txt` or `times.txt` beside the file is
    taken, else the number of the row. Raises `InputError` naming the line that is wrong.
    """
    path = Path(path)
    return TRAJECTORY_FORMATS[_known(format) if format else guess_format(path)].read(path, times, parent, child)


def write_trajectory(trajectory: Trajectory, path: str | Path, *, format: str | None = None) -> None:  # noqa: A002
    """Write poses in stamp order in the format called so, else in that of the suffix (.tum, .kitti, .csv).

    Planar poses get z, roll and pitch zero. KITTI has no stamps: they go to `NAME_times.txt` beside it.
    """
    path = Path(path)
    name = _known(format) if format else format_of_suffix(path)
    if name is None:
        raise InputError(path, f"'{path.suffix}' names no trajectory format", f"it is one of {', '.join(SUFFIXES)}")
    ordered = trajectory.spatial().in_stamp_order()
    if not (np.isfinite(ordered.stamps_s).all() and np.isfinite(ordered.poses).all()):
        raise InputError(path, "the trajectory holds values that are not finite", "nothing was written")
    path.parent.mkdir(parents=True, exist_ok=True)
    TRAJECTORY_FORMATS[name].write(ordered, path)


def guess_format(path: Path) -> str:
    """Return the format of an existing file: by suffix, for .csv and .txt by its first row."""
    if not path.is_file():
        raise InputError(path, "no such file", "check the path")
    name = format_of_suffix(path)
    if name is not None and path.suffix != ".csv":
        return name
    with path.open("rb") as file:
        head = file.read(4096).splitlines()
    if path.suffix == ".csv":
        return "euroc" if head and head[0].lstrip(b"# ").startswith(b"timestamp") else "csv"
    first = next((line.split() for line in head if line.strip() and not line.strip().startswith(b"#")), [])
    formats = {8: "tum", 12: "kitti"}
    if len(first) not in formats:
        problem = f"its first row has {len(first)} columns: neither TUM (8) nor KITTI (12)"
        raise InputError(path, problem, f"name the format: {', '.join(TRAJECTORY_FORMATS)}")
    return formats[len(first)]


def format_of_suffix(path: Path) -> str | None:
    """Return the format that a suffix stands for; None where it stands for none."""
    return SUFFIXES.get(path.suffix.lower())


def _known(name: str) -> str:
    if name not in TRAJECTORY_FORMATS:
        guess = did_you_mean(name, TRAJECTORY_FORMATS)
        remedy = f"{guess}it is {', '.join(TRAJECTORY_FORMATS)}"
        raise InputError("format", f"unknown trajectory format '{name}'", remedy)
    return name


def _read_tum(path: Path, times: Path | None, parent: str, child: str) -> Trajectory:
    return read_tum(path, parent=parent, child=child)


def _read_kitti(path: Path, times: Path | None, parent: str, child: str) -> Trajectory:
    values, numbers = read_table(path, KITTI_COLUMNS)
    require_in_range(values, path, numbers)
    matrices = values.reshape(-1, 3, 4)
    R, t = matrices[:, :, :3], matrices[:, :, 3]
    odd = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > ROTATION_TOLERANCE
    refuse_first(odd | (np.linalg.det(R) < 0), path, numbers, "holds no rotation")
    R = Rotation.from_matrix(R).as_matrix()  # the nearest rotation to the rounded matrix
    beside = [times] if times else [path.with_name(f"{path.stem}_times.txt"), path.with_name("times.txt")]
    file = next((each for each in beside if times or each.is_file()), None)
    stamps = np.arange(len(R), dtype=np.float64) if file is None else _read_stamps(file)
    if len(stamps) != len(R):
        problem = f"holds {len(stamps)} stamps, but {path.name} {len(R)} poses"
        raise InputError(str(file), problem, "give their own file by --times")
    return Trajectory(stamps_s=stamps, poses=pose_from_rotation_translation(R, t), parent=parent, child=child)


def _read_stamps(file: Path) -> FloatArray:
    values, numbers = read_table(file, ("stamp",))
    require_in_range(values, file, numbers)
    return values[:, 0]


def _read_euroc(path: Path, times: Path | None, parent: str, child: str) -> Trajectory:
    values, numbers = read_csv(path, EUROC_COLUMNS)
    stamps, t, quat_xyzw = values[:, 0] / 1e9, values[:, 1:4], values[:, [5, 6, 7, 4]]
    return _from_quaternions(path, stamps, t, quat_xyzw, numbers, (parent, child))


def _read_csv(path: Path, times: Path | None, parent: str, child: str) -> Trajectory:
    values, numbers = read_csv(path, CSV_COLUMNS)
    return _from_quaternions(path, values[:, 0], values[:, 1:4], values[:, 4:8], numbers, (parent, child))


def _from_quaternions(
    path: Path, stamps_s: FloatArray, t: FloatArray, quat_xyzw: FloatArray, numbers: list[int], frames: tuple[str, str]
) -> Trajectory:
    require_in_range(np.column_stack([stamps_s, t, quat_xyzw]), path, numbers)
    refuse_first(np.linalg.norm(quat_xyzw, axis=1) < 1e-6, path, numbers, "holds a zero quaternion")
    poses = pose_from_rotation_translation(Rotation.from_quat(quat_xyzw).as_matrix(), t)
    return Trajectory(stamps_s=stamps_s, poses=poses, parent=frames[0], child=frames[1])


def _write_kitti(trajectory: Trajectory, path: Path) -> None:
    rows = (trajectory.poses[:, :3, :4].reshape(-1, 12) + 0.0).tolist()
    _write_lines(path, (" ".join(map(repr, row)) for row in rows))
    stamps = (f"{stamp:.9f}" for stamp in trajectory.stamps_s.tolist())
    _write_lines(path.with_name(f"{path.stem}_times.txt"), stamps)


def _write_euroc(trajectory: Trajectory, path: Path) -> None:
    quat_xyzw = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat(canonical=True)
    rows = (np.column_stack([trajectory.positions, quat_xyzw[:, [3, 0, 1, 2]]]) + 0.0).tolist()
    stamps_ns = [round(stamp * 1e9) for stamp in trajectory.stamps_s.tolist()]
    lines = (f"{ns},{','.join(map(repr, row))}" for ns, row in zip(stamps_ns, rows, strict=True))
    _write_lines(path, ("#" + ",".join(EUROC_COLUMNS), *lines))


def _write_csv(trajectory: Trajectory, path: Path) -> None:
    quat_xyzw = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat(canonical=True)
    rows = (np.column_stack([trajectory.positions, quat_xyzw]) + 0.0).tolist()
    lines = (
        f"{stamp:.9f},{','.join(map(repr, row))}" for stamp, row in zip(trajectory.stamps_s.tolist(), rows, strict=True)
    )
    _write_lines(path, (",".join(CSV_COLUMNS), *lines))


def _write_lines(path: Path, lines: object) -> None:
    with replacing(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(f"{line}\n" for line in lines)  # type: ignore[attr-defined]


TRAJECTORY_FORMATS = {
    "tum": TrajectoryFormat(suffix=".tum", read=_read_tum, write=write_tum),
    "kitti": TrajectoryFormat(suffix=".kitti", read=_read_kitti, write=_write_kitti),
    "euroc": TrajectoryFormat(suffix=".csv", read=_read_euroc, write=_write_euroc),
    "csv": TrajectoryFormat(suffix=".csv", read=_read_csv, write=_write_csv),
}
SUFFIXES = {".tum": "tum", ".kitti": "kitti", ".csv": "csv"}
