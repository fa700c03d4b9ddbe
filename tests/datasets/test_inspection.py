from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from posegraph_slam import datasets
from posegraph_slam.datasets.inspection import Inspection, inspect
from posegraph_slam.geometry import Trajectory, pose_from_xyt
from posegraph_slam.sensors import Imu, LaserScans, RobotLog, WheelEncoders


def make_scans(stamps_s: Any, ranges: Any = None) -> LaserScans:
    stamps_s = np.asarray(stamps_s, dtype=float)
    return LaserScans(
        stamps_s=stamps_s,
        ranges_m=np.full((len(stamps_s), 10), 2.0) if ranges is None else ranges,
        angle_min_rad=-0.9,
        angle_increment_rad=0.2,
        range_min_m=0.1,
        range_max_m=10.0,
        T_base_lidar=np.eye(4),
    )


def make_odometry(xyt: Any) -> Trajectory:
    xyt = np.asarray(xyt, dtype=float)
    return Trajectory(stamps_s=0.1 * np.arange(len(xyt)), poses=pose_from_xyt(xyt), parent="odom", child="base")


def make_imu(acceleration: Any, rate: float = 0.1, count: int = 50) -> Imu:
    return Imu(
        stamps_s=0.1 * np.arange(count),
        angular_velocity=np.full((count, 3), rate),
        linear_acceleration=np.tile(np.asarray(acceleration, dtype=float), (count, 1)),
        T_base_imu=np.eye(4),
    )


def warnings_of(**streams: Any) -> str:
    return "\n".join(inspect(RobotLog(path=Path("log"), format="test", **streams)).warnings)


STRAIGHT = make_odometry([[0.05 * k, 0, 0] for k in range(50)])
BURSTS = 0.5 * np.repeat(np.arange(20), 2) + 0.001 * np.tile([0, 1], 20)
GOOD = {"scans": make_scans(0.1 * np.arange(50)), "scan_odometry": STRAIGHT}


def test_a_good_log_has_no_warning() -> None:
    assert warnings_of(**GOOD, imu=make_imu([0, 0, 9.8])) == ""


def test_rows_of_streams_count_rates_and_gaps() -> None:
    stamps = np.array([10.0, 10.1, 11.4, 10.2, 10.4, 10.4, 10.3])
    (row,) = inspect(RobotLog(path=Path("log"), format="test", scans=make_scans(stamps))).streams
    assert (row.name, row.count, row.backward_steps, row.duplicate_stamps) == ("scans", 7, 2, 1)
    assert (row.start_s, row.end_s) == (10.0, 11.4)
    assert row.duration_s == pytest.approx(1.4)
    assert row.rate_hz == pytest.approx(6 / 1.4)
    assert row.largest_gap_s == pytest.approx(1.0)


def test_ranges_are_summarised_over_returns_alone() -> None:
    ranges = np.full((2, 10), 4.0)
    ranges[0, :4] = [0.001, np.nan, 60.0, 1.0]
    ranges[1, 0] = 9.0
    summary = inspect(RobotLog(path=Path("log"), format="test", scans=make_scans([0, 0.1], ranges))).scans
    assert summary is not None
    assert (summary.beams, summary.nearest_m, summary.median_m, summary.farthest_m) == (10, 1.0, 4.0, 9.0)
    assert summary.field_of_view_rad == pytest.approx(1.8)
    assert summary.no_return_share == pytest.approx(2 / 20)
    assert summary.dropout_share == pytest.approx(1 / 20)


@pytest.mark.parametrize(
    ("streams", "sentence"),
    [
        ({"scans": make_scans([0, 0.1, 0.3, 0.2, 0.4])}, "scans clock runs backwards once, by up to 0.100 s"),
        ({"scans": make_scans([0, 0.1, 0.1, 0.1, 0.4])}, "2 scans stamps repeat an earlier one"),
        ({"scans": make_scans([*(0.1 * np.arange(50)), 8.0])}, "1 gap in the scans stream, the longest 3.10 s, 4.9 s"),
        ({"scans": make_scans(BURSTS)}, "come in bursts: 51 %"),
        ({"scans": make_scans([0, 0.1], np.full((2, 10), 0.01))}, "100.0 % of the beams are dropouts (below 0.1 m)"),
        ({"scans": make_scans([0, 0.1], np.full((2, 10), 99.0))}, "2 scans have returns on fewer than 10 %"),
        ({"scans": make_scans([0, 0.1], np.full((2, 10), np.nan))}, "20 ranges are NaN or infinite (100 %"),
        ({"scans": None}, "there are no laser scans: the log can be inspected but not optimised"),
        ({"scan_odometry": None}, "there is neither odometry nor encoders"),
        ({"imu": make_imu([0, 0, 1.01])}, "accelerations look like g, not m/s^2 (median 1.01)"),
        ({"imu": make_imu([0, 0, 0.1])}, "the imu does not measure gravity"),
        ({"imu": make_imu([0, 0, 9.8], rate=40.0)}, "reaches 40 rad/s: it may be in degrees"),
        ({"imu": make_imu([0, 0, 9.8], count=20)}, "the imu stream ends 3.00 s before the scans stream"),
        ({"scan_odometry": make_odometry([[0, 0, 0], [0, 0, 1.2], [0.1, 0, 1.2]])}, "leaps once between two poses"),
        ({"scan_odometry": make_odometry([[0, 0, 0], [1, 0, 0], [4, 0, 0]])}, "3.00 m, 0 degrees; the first at pose 2"),
        ({"scan_odometry": make_odometry(np.zeros((5, 3)))}, "odometry never moves"),
    ],
)  # fmt: skip
def test_each_suspicion_is_a_sentence(streams: dict[str, Any], sentence: str) -> None:
    assert sentence in warnings_of(**{**GOOD, **streams})


@pytest.mark.parametrize(
    ("left", "sentence"),
    [
        (np.zeros((50, 2)), "wheel 2 of the left side never turns"),
        (np.full((50, 2), 500), "the wheels exceed 5 m/s at 50 stamps (up to 11 m/s)"),
    ],
)
def test_suspicious_wheels(left: np.ndarray, sentence: str) -> None:
    encoders = WheelEncoders(
        stamps_s=0.1 * np.arange(50), ticks_left=left, ticks_right=np.full((50, 2), 20), metres_per_tick=0.0022,
        track_width_m=0.75,
    )  # fmt: skip
    assert sentence in warnings_of(**GOOD, encoders=encoders)


def test_a_remark_of_the_reader_is_not_said_twice() -> None:
    sentence = "the imu stream ends 3.00 s before the scans stream"
    report = inspect(
        RobotLog(
            path=Path("log"), format="test", **GOOD, imu=make_imu([0, 0, 9.8], count=20), remarks=(sentence, "other")
        )
    )
    assert report.remarks == ("other",)
    assert report.warnings == (sentence,)


def test_the_record_is_json(ece276a_log: Callable[..., Path], tmp_path: Path) -> None:
    ranges = np.full((31, 12), 60.0)
    report = inspect(datasets.read(ece276a_log(tmp_path, Hokuyo__ranges=ranges)))
    back = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert back["format"] == "ece276a"
    assert back["path"] == str(tmp_path)
    assert [row["name"] for row in back["streams"]] == ["scans", "encoders", "imu", "disparity", "colour"]
    assert back["scans"]["median_m"] is None, "no return: not a number, null in JSON"


def test_an_empty_log_can_be_inspected() -> None:
    report = inspect(RobotLog(path=Path("log"), format="test"))
    assert (report.duration_s, report.path_length_m, report.streams, report.scans) == (0.0, None, (), None)


@pytest.fixture(scope="module")
def reports(psg_data: Path) -> dict[str, Inspection]:
    paths = {"20": "ece276a/20", "intel": "carmen/intel.clf", "fr079": "carmen/fr079.clf"}
    return {name: inspect(datasets.read(psg_data / path)) for name, path in paths.items()}


@pytest.mark.data
def test_the_early_end_of_the_imu_is_seen(reports: dict[str, Inspection]) -> None:
    assert any("the imu stream" in line and "ends 1.42 s before" in line for line in reports["20"].warnings)
    assert any("dropouts" in line for line in reports["20"].warnings)
    assert any("converted from g" in line for line in reports["20"].remarks)
    assert reports["20"].truth_poses == 4962
    assert reports["20"].path_source == "encoders"
    assert reports["20"].path_length_m == pytest.approx(95.9, abs=0.1)


@pytest.mark.data
def test_the_clock_of_intel_is_seen_and_fr079_is_clean(reports: dict[str, Inspection]) -> None:
    intel = "\n".join(reports["intel"].warnings)
    assert "the scans clock runs backwards 631 times" in intel
    assert "scans stamps come in bursts" in intel
    assert reports["intel"].path_length_m == pytest.approx(508.35, abs=0.01)
    assert reports["intel"].duration_s == pytest.approx(2691.3, abs=0.1)
    assert reports["intel"].relations == 2984
    assert reports["fr079"].warnings == ()
