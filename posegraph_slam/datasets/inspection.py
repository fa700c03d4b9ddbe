"""What a log holds and what is suspicious about it, in numbers and plain sentences."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.coverage import uneven_coverage
from posegraph_slam.datasets.suspicions import (
    suspicious_clock,
    suspicious_encoders,
    suspicious_imu,
    suspicious_odometry,
    suspicious_ranges,
)
from posegraph_slam.sensors import LaserScans, RobotLog


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamRow:
    """One stream: samples, mean rate, first and last stamp, the largest gap, and stamps that repeat or run backwards.

    `start_s` and `end_s` are the least and the greatest stamp; the gap is between neighbours in order of time.
    """

    name: str
    count: int
    rate_hz: float
    start_s: float
    end_s: float
    duration_s: float
    largest_gap_s: float
    backward_steps: int
    duplicate_stamps: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanSummary:
    """Beams and ranges of all scans: nearest, median and farthest return (NaN when there is none).

    Shares are of all beams: dropouts lie below `range_min_m`, the other beams without return are no-returns.
    """

    beams: int
    field_of_view_rad: float
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    nearest_m: float
    median_m: float
    farthest_m: float
    no_return_share: float
    dropout_share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """The result of `inspect`: a row a stream, path length, laser summary, and sentences for people.

    `path_length_m` follows `path_source` ("scan odometry", "odometry" or "encoders"); both are None without any.
    `remarks` tell what the reader did, `warnings` what to look at; no sentence is in both.
    """

    path: Path
    format: str
    duration_s: float
    path_length_m: float | None
    path_source: str | None
    streams: tuple[StreamRow, ...]
    scans: ScanSummary | None
    truth_poses: int
    relations: int
    disparity_images: int
    colour_images: int
    remarks: tuple[str, ...]
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the record as lists, strings and numbers that JSON can hold; NaN becomes None."""
        result: dict[str, Any] = _plain(asdict(self))
        return result


def inspect(log: RobotLog) -> Inspection:
    """Summarise a log: streams, path, ranges, and everything suspicious about them. Nothing is changed or refused."""
    stamps = stream_stamps(log)
    rows = tuple(_row(name, values) for name, values in stamps.items() if len(values))
    warnings = tuple(dict.fromkeys(_warnings(log, stamps)))
    length, source = _path_length(log)
    return Inspection(
        path=log.path,
        format=log.format,
        duration_s=max((row.end_s for row in rows), default=0.0) - min((row.start_s for row in rows), default=0.0),
        path_length_m=length,
        path_source=source,
        streams=rows,
        scans=_summary(log.scans) if log.scans is not None and len(log.scans) else None,
        truth_poses=len(log.truth) if log.truth is not None else 0,
        relations=len(log.relations) if log.relations is not None else 0,
        disparity_images=_files(log.rgbd.disparity_files) if log.rgbd is not None else 0,
        colour_images=_files(log.rgbd.colour_files) if log.rgbd is not None else 0,
        remarks=tuple(remark for remark in log.remarks if remark not in warnings),
        warnings=warnings,
    )


def stream_stamps(log: RobotLog) -> dict[str, FloatArray]:
    """Return the stamps of every stream that was recorded, the reference stream (scans when there are any) first."""
    streams = {"scans": log.scans, "encoders": log.encoders, "imu": log.imu, "odometry": log.odometry}
    stamps = {name: stream.stamps_s for name, stream in streams.items() if stream is not None}
    if log.rgbd_sequence is not None:
        stamps["images"] = log.rgbd_sequence.stamps_s
    if log.rgbd is not None:
        stamps |= {"disparity": log.rgbd.disparity_stamps_s, "colour": log.rgbd.colour_stamps_s}
    return stamps | {f"images {camera.name}": camera.stamps_s for camera in log.images}


def _files(files: tuple[Path | None, ...]) -> int:
    return sum(file is not None for file in files)


def _row(name: str, stamps_s: FloatArray) -> StreamRow:
    ordered = np.sort(stamps_s)
    gaps = np.diff(ordered)
    duration = float(ordered[-1] - ordered[0])
    return StreamRow(
        name=name,
        count=len(stamps_s),
        rate_hz=len(gaps) / duration if duration > 0 else 0.0,
        start_s=float(ordered[0]),
        end_s=float(ordered[-1]),
        duration_s=duration,
        largest_gap_s=float(gaps.max()) if len(gaps) else 0.0,
        backward_steps=int(np.count_nonzero(np.diff(stamps_s) < 0)),
        duplicate_stamps=int(np.count_nonzero(gaps == 0)),
    )


def _summary(scans: LaserScans) -> ScanSummary:
    hit = scans.returns()
    ranges = scans.ranges_m[hit]
    with np.errstate(invalid="ignore"):
        dropouts = np.count_nonzero(scans.ranges_m < scans.range_min_m)
    return ScanSummary(
        beams=scans.beams,
        field_of_view_rad=abs(scans.angle_increment_rad) * (scans.beams - 1),
        angle_min_rad=scans.angle_min_rad,
        angle_increment_rad=scans.angle_increment_rad,
        range_min_m=scans.range_min_m,
        range_max_m=scans.range_max_m,
        nearest_m=float(ranges.min()) if ranges.size else float("nan"),
        median_m=float(np.median(ranges)) if ranges.size else float("nan"),
        farthest_m=float(ranges.max()) if ranges.size else float("nan"),
        no_return_share=float((hit.size - ranges.size - dropouts) / max(hit.size, 1)),
        dropout_share=float(dropouts / max(hit.size, 1)),
    )


def _path_length(log: RobotLog) -> tuple[float | None, str | None]:
    if log.scan_odometry is not None:
        return log.scan_odometry.path_length_m, "scan odometry"
    if log.odometry is not None:
        return log.odometry.path_length_m, "odometry"
    if log.encoders is not None:
        return float(np.abs(log.encoders.travel_m.mean(axis=1)).sum()), "encoders"
    return None, None


def _warnings(log: RobotLog, stamps: dict[str, FloatArray]) -> list[str]:
    found = list(uneven_coverage(stamps))
    for name, values in stamps.items():
        found += suspicious_clock(name, values)
    if log.rgbd_sequence is not None and log.scans is None:
        return found
    if log.scans is None or not len(log.scans):
        found.append("there are no laser scans: the log can be inspected but not optimised")
    else:
        found += suspicious_ranges(log.scans)
    if log.imu is not None:
        found += suspicious_imu(log.imu)
    if log.encoders is not None:
        found += suspicious_encoders(log.encoders)
    trajectory = log.scan_odometry or log.odometry
    if trajectory is not None:
        found += suspicious_odometry(trajectory)
    elif log.encoders is None:
        found.append("there is neither odometry nor encoders: the motion is known from the scans alone")
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not np.isfinite(value) else value
