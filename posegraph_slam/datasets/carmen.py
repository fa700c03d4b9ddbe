"""CARMEN laser logs: `.clf`, `.log`, `.txt`, and the same compressed as `.gz`.

File order is kept: in some logs hundreds of stamps are out of order, and the order of the lines is the physical one.
"""

from __future__ import annotations

import gzip
import re
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray
from posegraph_slam.datasets.carmen_messages import (
    SCAN_MESSAGES,
    Messages,
    ScanMessages,
    parse_odometry,
    parse_scans,
    read_lines,
)
from posegraph_slam.datasets.relations import read_relations
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import (
    Trajectory,
    inverse_pose,
    pose_from_xyt,
    spatial_from_planar,
    wrap_angle,
    xyt_from_pose,
)
from posegraph_slam.sensors import LaserScans, RobotLog

SUFFIXES = (".clf", ".log", ".txt")
KNOWN_LINE = re.compile(rb"^\s*(FLASER|RLASER|ROBOTLASER1|ODOM|PARAM)\s", re.MULTILINE)
DETECTION_BYTES = 1 << 16
"""Enough to pass the comments at the head of a log; a scan is about 1 kB."""
DROPOUT_M = 0.02
"""At or below this a range is a dropout: no laser of this family measures under 2 cm, some write 0 or 0.01."""
CODES_FROM_M = 80.0
"""SICK LMS lasers in centimetre mode write codes from 8183 on (no return, dazzled) and measure to 80 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Beams:
    """Bearing of the first beam and the step between beams, radians."""

    start_rad: float
    step_rad: float


def detects(path: Path) -> bool:
    """Tell whether `path` is a log of this family: its suffix fits and a known message begins a line near the top."""
    if not path.is_file() or _bare_name(path) == path.name:
        return False
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            return KNOWN_LINE.search(file.read(DETECTION_BYTES)) is not None
    except (OSError, EOFError, zlib.error):
        # A broken .gz of this name is ours to complain about.
        return path.suffix == ".gz"


def read(path: str | Path) -> RobotLog:
    """Read scans, logged odometry and, when they lie beside the log, relations and truth.

    The front laser (FLASER) is preferred to ROBOTLASER1 and that to the rear laser (RLASER). `scan_odometry` is the
    robot pose on the lines of the scans, `odometry` the ODOM messages, both T_odom_base (N, 3, 3) in file order; stamps
    are those of the message (ipc). Beside `NAME.clf` may lie `NAME.relations` and `NAME.tum` or `truth.tum`.
    Raises `InputError` naming file and line for a malformed message; a cut last line is dropped with a remark.
    """
    path = Path(path)
    messages = read_lines(path)
    remarks = _remarks_on_lines(messages)
    name = next((name for name in SCAN_MESSAGES if messages.numbered[name]), None)
    if name is None and not messages.numbered[b"ODOM"]:
        raise InputError(path, "holds no FLASER, ROBOTLASER1, RLASER or ODOM message", "check that it is a CARMEN log")
    scans = parse_scans(path, messages, name) if name else None
    stamps_s, odometry_xyt = parse_odometry(path, messages)
    if scans is not None and scans.dropped:
        remarks.append(f"{scans.dropped} scans without {scans.ranges_m.shape[1]} beams are dropped")
    if name is None:
        remarks.append("there is no laser in the log")
    return RobotLog(
        path=path,
        format="carmen",
        scans=None if scans is None or name is None else _laser_scans(path, name, scans, messages, remarks),
        odometry=_planar(stamps_s, odometry_xyt) if len(stamps_s) else None,
        scan_odometry=None if scans is None else _planar(scans.stamps_s, scans.robot_xyt),
        truth=_truth(path),
        relations=read_relations(relations) if (relations := _beside(path, ".relations")).is_file() else None,
        remarks=tuple(remarks),
    )


def _bare_name(path: Path) -> str:
    """Return the name without the suffixes of this format; unchanged when it has none of them."""
    name = path.name[:-3] if path.suffix == ".gz" else path.name
    stem, dot, suffix = name.rpartition(".")
    return stem if dot and f".{suffix.lower()}" in SUFFIXES else path.name


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(_bare_name(path) + suffix)


def _truth(path: Path) -> Trajectory | None:
    for file in (_beside(path, ".tum"), path.with_name("truth.tum")):
        if file.is_file():
            return read_tum(file, parent="ref", child="base")
    return None


def _planar(stamps_s: FloatArray, xyt: FloatArray) -> Trajectory:
    return Trajectory(stamps_s=stamps_s, poses=pose_from_xyt(xyt), parent="odom", child="base")


def _remarks_on_lines(messages: Messages) -> list[str]:
    remarks = []
    if messages.truncated_line is not None:
        remarks.append(f"the last message (line {messages.truncated_line}) is cut off and was dropped")
    if messages.ignored:
        counts = ", ".join(f"{count} {name}" for name, count in sorted(messages.ignored.items()))
        remarks.append(f"messages of other kinds are ignored: {counts}")
    used = next((name for name in SCAN_MESSAGES if messages.numbered[name]), b"")
    others = [
        f"{len(lines)} {name.decode()}"
        for name, lines in messages.numbered.items()
        if lines and name in SCAN_MESSAGES and name != used
    ]
    if others:
        remarks.append(f"only the {used.decode()} scans are used, not {', '.join(others)}")
    return remarks


def _laser_scans(path: Path, name: bytes, scans: ScanMessages, messages: Messages, remarks: list[str]) -> LaserScans:
    side = "rear" if name == b"RLASER" else "front"
    beams = _beams(path, scans, messages.parameters, side)
    range_max_m = _range_max(scans, messages.parameters, side, remarks)
    missing = int(np.count_nonzero(~np.isfinite(scans.ranges_m)))
    if missing:
        remarks.append(f"{missing} of {scans.ranges_m.size} ranges are NaN or infinite and count as no return")
    return LaserScans(
        stamps_s=scans.stamps_s,
        ranges_m=scans.ranges_m,
        angle_min_rad=beams.start_rad,
        angle_increment_rad=beams.step_rad,
        range_min_m=float(np.nextafter(np.float32(DROPOUT_M), np.float32(1.0))),
        range_max_m=range_max_m,
        T_base_lidar=spatial_from_planar(pose_from_xyt(_mounting(name, scans, messages.parameters, remarks))),
    )


def _beams(path: Path, scans: ScanMessages, parameters: dict[str, str], side: str) -> Beams:
    """Return the bearings of the beams: as ROBOTLASER1 states them, else as CARMEN derives them from their number.

    CARMEN's SICK driver: 181 and 361 beams span 180 degrees in steps of 1 and 0.5; 180 and 360 beams have the same
    steps and start at -90 too, so that the last beam points at +89 or +89.5; 401 beams span 100 degrees in steps of
    0.25 and 400 leave out the last of them. A resolution and field of view among the parameters (degrees) win when they
    fit the number of beams.
    """
    count = scans.ranges_m.shape[1]
    if scans.configuration.shape[1]:
        start, step = scans.configuration[0, 1], scans.configuration[0, 3]
        changed = (scans.configuration[:, [1, 3]] != [start, step]).any(axis=1)
        if changed.any() or step == 0:
            where = f"{path}:{scans.line_numbers[int(np.argmax(changed))]}"
            problem = "the laser's angular resolution is zero" if step == 0 else "the laser's angles change"
            raise InputError(where, problem, "split the log there or correct the message")
        return Beams(start_rad=float(start), step_rad=float(step))
    step_deg = _number(parameters, f"laser_{side}_laser_resolution")
    field_deg = _number(parameters, f"laser_{side}_laser_fov")
    if step_deg:
        for whole_deg in (field_deg or 180.0, 180.0, 100.0):
            if min(abs(count * step_deg - whole_deg), abs((count - 1) * step_deg - whole_deg)) < 0.01 * step_deg:
                return Beams(start_rad=-np.deg2rad(whole_deg) / 2, step_rad=float(np.deg2rad(step_deg)))
    if count in (400, 401):
        return Beams(start_rad=-np.deg2rad(50.0), step_rad=np.deg2rad(0.25))
    return Beams(start_rad=-np.pi / 2, step_rad=np.pi / max(count - count % 2, 1))


def _mounting(name: bytes, scans: ScanMessages, parameters: dict[str, str], remarks: list[str]) -> FloatArray:
    """Return the laser's [x, y, theta] on the robot: from the two poses of each scan, else from the parameters.

    The median over the scans counts when nine in ten agree with it to 5 mm and 0.2 degrees (poses are logged in
    micrometres); they do not when the first pose was corrected by a localiser.
    """
    relative = xyt_from_pose(inverse_pose(pose_from_xyt(scans.robot_xyt)) @ pose_from_xyt(scans.laser_xyt))
    # Headings near pi would average to zero: take them about the direction of the mean vector.
    centre = np.arctan2(np.sin(relative[:, 2]).mean(), np.cos(relative[:, 2]).mean())
    relative[:, 2] = centre + wrap_angle(relative[:, 2] - centre)
    median = np.median(relative, axis=0)
    agree = (np.abs(relative - median) < [0.005, 0.005, np.deg2rad(0.2)]).all(axis=1)
    backwards = name == b"RLASER"
    # Some loggers write the robot's own pose as the rear laser's; it looks backwards all the same.
    if agree.mean() >= 0.9 and not (backwards and abs(median[2]) < np.pi / 2):
        return np.asarray(np.round(median, 6) + 0.0)
    offset = _number(parameters, "robot_rearlaser_offset" if backwards else "robot_frontlaser_offset") or 0.0
    remarks.append(f"laser mounted {offset:g} m from the robot's centre, as its parameters say, not as its poses say")
    return np.array([-offset, 0.0, np.pi]) if backwards else np.array([offset, 0.0, 0.0])


def _range_max(scans: ScanMessages, parameters: dict[str, str], side: str, remarks: list[str]) -> float:
    """Return the range from which on values mean no return, and say why.

    The least of: 80 m (codes of SICK lasers), the stated maximum range of the laser, and the largest value in the data
    when it recurs as no true range does.
    """
    stated = _number(parameters, f"robot_{side}_laser_max")
    if scans.configuration.shape[1]:
        stated = float(np.median(scans.configuration[:, 4]))
    limits = [CODES_FROM_M, *_recurring_maximum(scans.ranges_m)]
    if stated is not None and stated > 0:
        limits.append(stated)
    limit = min(limits)
    share = float(np.mean(scans.ranges_m >= np.float32(limit)))
    remarks.append(f"ranges from {limit:.2f} m on mean no return ({100 * share:.1f} % of the beams)")
    return limit


def _recurring_maximum(ranges_m: Float32Array) -> list[float]:
    """Return [the largest range] when exactly this value recurs as no true range does.

    It must be five times as frequent as everything else in the metre below it: ranges of a wall spread over several
    centimetres, a no-return value is always the same (3 % of intel's beams, with nothing in the 50 m below).
    """
    finite = ranges_m if np.isfinite(ranges_m).all() else ranges_m[np.isfinite(ranges_m)]
    if not finite.size:
        return []
    largest = finite.max()
    at_top = int(np.count_nonzero(finite == largest))
    below = int(np.count_nonzero(finite >= largest - np.float32(1.0))) - at_top
    suspicious = largest > 1.0 and at_top >= max(20, 1e-4 * finite.size) and at_top >= 5 * below
    return [float(largest)] if suspicious else []


def _number(parameters: dict[str, str], name: str) -> float | None:
    """Return a parameter as a finite number; None when it is absent or no number."""
    try:
        value = float(parameters[name])
    except (KeyError, ValueError):
        return None
    return value if np.isfinite(value) else None
