"""What every reader owes its callers; a new reader joins by a builder in conftest.py."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from posegraph_slam import datasets
from posegraph_slam.datasets.inspection import inspect
from posegraph_slam.datasets.registry import BUILT_IN, Reader
from posegraph_slam.errors import InputError
from posegraph_slam.sensors import RobotLog

every_reader = pytest.mark.parametrize("reader", BUILT_IN, ids=lambda reader: reader.name)
WITHOUT_SCANS = {"imu_vicon": "imu", "euroc": "imu", "rgbd": "images"}
"""Formats without a laser, and the stream that they are about."""
Builder = Callable[[str, Path], Path]


def arrays_of(record: Any, prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Every array in a record and its records, with its path of names."""
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            yield f"{prefix}{field.name}", value
        elif is_dataclass(value):
            yield from arrays_of(value, f"{prefix}{field.name}.")


@every_reader
def test_reads_a_log_and_names_format_and_path(reader: Reader, tmp_path: Path, log_builder: Builder) -> None:
    path = log_builder(reader.name, tmp_path)
    log = datasets.read(path)
    assert isinstance(log, RobotLog)
    assert (log.format, log.path) == (reader.name, path)
    streams = {"imu": log.imu, "images": log.rgbd_sequence}
    main_stream = streams[WITHOUT_SCANS[reader.name]] if reader.name in WITHOUT_SCANS else log.scans
    assert main_stream is not None
    assert len(main_stream) > 1
    assert datasets.read(str(path), format=reader.name).format == reader.name


@every_reader
def test_arrays_are_finite_and_read_only(reader: Reader, tmp_path: Path, log_builder: Builder) -> None:
    log = datasets.read(log_builder(reader.name, tmp_path))
    found = dict(arrays_of(log))
    assert found
    for name, array in found.items():
        assert not array.flags.writeable, name
        assert name == "scans.ranges_m" or np.isfinite(array).all(), name


@every_reader
def test_geometry_of_the_scans_is_consistent(reader: Reader, tmp_path: Path, log_builder: Builder) -> None:
    if reader.name in WITHOUT_SCANS:
        pytest.skip("has no scans")
    log = datasets.read(log_builder(reader.name, tmp_path))
    scans = log.scans
    assert scans is not None
    assert scans.ranges_m.shape == (len(scans.stamps_s), len(scans.angles_rad))
    assert 0 <= scans.range_min_m < scans.range_max_m
    assert scans.angle_increment_rad != 0
    R = scans.T_base_lidar[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert 0 < scans.returns().mean() < 1, "the small logs hold returns and no-returns"
    if log.scan_odometry is not None:
        np.testing.assert_array_equal(log.scan_odometry.stamps_s, scans.stamps_s)


@every_reader
def test_detects_its_own_format_alone(reader: Reader, tmp_path: Path, log_builder: Builder) -> None:
    for other in BUILT_IN:
        path = log_builder(other.name, tmp_path / other.name)
        assert reader.detects(path) == (other is reader)
    assert not reader.detects(tmp_path / "nothing")
    assert not reader.detects(tmp_path)


@every_reader
def test_reading_twice_gives_equal_arrays(reader: Reader, tmp_path: Path, log_builder: Builder) -> None:
    path = log_builder(reader.name, tmp_path)
    first, second = datasets.read(path), datasets.read(path)
    for (name, a), (_, b) in zip(arrays_of(first), arrays_of(second), strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)
    assert first.remarks == second.remarks


@every_reader
def test_a_truncated_file_is_named(
    reader: Reader, tmp_path: Path, truncated_log_builder: Callable[[str, Path], tuple[Path, Path]]
) -> None:
    path, file = truncated_log_builder(reader.name, tmp_path)
    with pytest.raises(InputError) as caught:
        datasets.read(path)
    assert str(file) in str(caught.value)
    assert "truncated" in str(caught.value)


@every_reader
def test_its_log_can_be_inspected(reader: Reader, tmp_path: Path, log_builder: Builder) -> None:
    report = inspect(datasets.read(log_builder(reader.name, tmp_path)))
    if reader.name in WITHOUT_SCANS:
        assert report.streams[0].name == WITHOUT_SCANS[reader.name]
        return
    assert report.streams[0].name == "scans"
    assert report.path_length_m is not None
    assert report.path_length_m > 0


@every_reader
def test_says_what_it_reads(reader: Reader) -> None:
    assert reader.name.isidentifier()
    assert len(reader.description) > 20
    assert len(reader.layout) > 20
