from __future__ import annotations

import gzip
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from posegraph_slam import datasets
from posegraph_slam.datasets import carmen
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import inverse_pose, pose_from_xyt, xyt_from_pose
from posegraph_slam.sensors import LaserScans, RobotLog

Lines = dict[str, Callable[..., Any]]


def read_lines(make: Lines, folder: Path, lines: list[str], name: str = "a.clf") -> RobotLog:
    return datasets.read(make["write"](folder / name, lines), format="carmen")


def scans_of(log: RobotLog) -> LaserScans:
    assert log.scans is not None
    return log.scans


def test_the_first_triple_is_the_laser_and_the_second_the_robot(carmen_lines: Lines, tmp_path: Path) -> None:
    log = read_lines(carmen_lines, tmp_path, [carmen_lines["flaser"](k, offset=0.12) for k in range(20)])
    np.testing.assert_allclose(scans_of(log).T_base_lidar[:, 3], [0.12, 0, 0, 1], atol=1e-6)
    assert log.scan_odometry is not None
    k = np.arange(20)
    turn = 0.1234567 * k
    expected = np.stack([np.cos(turn), np.sin(turn), turn + 0.5], axis=1)
    np.testing.assert_allclose(log.scan_odometry.poses, pose_from_xyt(expected), atol=1e-6)
    np.testing.assert_allclose(scans_of(log).stamps_s, 1000 + 0.2 * k, atol=1e-9)
    assert (log.scan_odometry.parent, log.scan_odometry.child) == ("odom", "base")
    assert log.odometry is None


def test_against_a_plain_reading_line_by_line(carmen_lines: Lines, tmp_path: Path) -> None:
    lines = [carmen_lines["flaser"](k) for k in range(25)]
    scans = scans_of(read_lines(carmen_lines, tmp_path, lines))
    for line, ranges, stamp in zip(lines, scans.ranges_m, scans.stamps_s, strict=True):
        words = line.split()
        np.testing.assert_array_equal(ranges, np.array([float(word) for word in words[2:182]], dtype=np.float32))
        assert stamp == float(words[-3])


def test_file_order_is_kept_when_stamps_are_not_in_order(carmen_lines: Lines, tmp_path: Path) -> None:
    order = [0, 1, 4, 3, 2, 5, 7, 6]
    log = read_lines(carmen_lines, tmp_path, [carmen_lines["flaser"](k) for k in order])
    np.testing.assert_allclose(scans_of(log).stamps_s, 1000 + 0.2 * np.array(order), atol=1e-9)


@pytest.mark.parametrize(
    ("beams", "first_deg", "last_deg"),
    [
        (180, -90, 89), (181, -90, 90), (360, -90, 89.5), (361, -90, 90), (401, -50, 50), (400, -50, 49.75),
        (90, -90, 88), (1, -90, -90),
    ],
)  # fmt: skip
def test_bearings_follow_from_the_number_of_beams(
    beams: int, first_deg: float, last_deg: float, carmen_lines: Lines, tmp_path: Path
) -> None:
    scans = scans_of(read_lines(carmen_lines, tmp_path, [carmen_lines["flaser"](k, beams) for k in range(3)]))
    np.testing.assert_allclose(np.rad2deg(scans.angles_rad[[0, -1]]), [first_deg, last_deg], atol=1e-9)


def test_stated_resolution_and_field_of_view_win_when_they_fit(carmen_lines: Lines, tmp_path: Path) -> None:
    parameters = ["PARAM laser_front_laser_resolution 0.5 h 0", "PARAM laser_front_laser_fov 270 h 0"]
    wide = read_lines(carmen_lines, tmp_path, [*parameters, *(carmen_lines["flaser"](k, 541) for k in range(3))])
    np.testing.assert_allclose(np.rad2deg(scans_of(wide).angles_rad[[0, -1]]), [-135, 135])
    narrow = read_lines(carmen_lines, tmp_path, [*parameters, *(carmen_lines["flaser"](k, 181) for k in range(3))])
    np.testing.assert_allclose(np.rad2deg(scans_of(narrow).angles_rad[[0, -1]]), [-90, 90])


@pytest.mark.parametrize("far", [81.83, 81.91, 50.0, 51.22, 81.9, 8.19])
def test_the_no_return_value_is_recognised(far: float, carmen_lines: Lines, tmp_path: Path) -> None:
    log = read_lines(carmen_lines, tmp_path, [carmen_lines["flaser"](k, far=far) for k in range(20)])
    scans = scans_of(log)
    np.testing.assert_array_equal(scans.returns(), scans.ranges_m != np.float32(far))
    assert scans.returns().mean() == pytest.approx(0.9)
    assert any("mean no return (10.0 % of the beams)" in remark for remark in log.remarks)


def test_every_code_of_a_sick_laser_means_no_return(carmen_lines: Lines, tmp_path: Path) -> None:
    words = carmen_lines["flaser"](1).split()
    words[2:7] = ["79.99", "81.83", "81.87", "81.90", "81.91"]
    scans = scans_of(read_lines(carmen_lines, tmp_path, [" ".join(words)]))
    np.testing.assert_array_equal(scans.returns()[0, :5], [True, False, False, False, False])


def test_a_far_wall_is_not_taken_for_no_return(carmen_lines: Lines, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    lines = []
    for k in range(30):
        words = carmen_lines["flaser"](k).split()
        words[2:182] = [f"{value:.2f}" for value in rng.uniform(1, 3, 180)]
        words[82:92] = [f"{value:.2f}" for value in rng.choice([11.98, 11.99, 12.0], 10)]
        lines.append(" ".join(words))
    scans = scans_of(read_lines(carmen_lines, tmp_path, lines))
    assert scans.returns().all()


def test_a_stated_maximum_range_and_dropouts_are_outside(carmen_lines: Lines, tmp_path: Path) -> None:
    words = carmen_lines["flaser"](0).split()
    words[2:8] = ["0.00", "0.02", "0.03", "29.99", "30.00", "nan"]
    lines = ["PARAM robot_front_laser_max 30.0 h 0", " ".join(words)]
    log = read_lines(carmen_lines, tmp_path, lines)
    np.testing.assert_array_equal(scans_of(log).returns()[0, :6], [False, False, True, True, False, False])
    assert any(remark.startswith("1 of 180 ranges are NaN") for remark in log.remarks)


def test_inconsistent_laser_poses_leave_the_mounting_to_the_parameters(carmen_lines: Lines, tmp_path: Path) -> None:
    lines = ["PARAM robot_frontlaser_offset 0.3 h 0"]
    lines += [carmen_lines["flaser"](k, offset=0.05 * k) for k in range(20)]
    log = read_lines(carmen_lines, tmp_path, lines)
    np.testing.assert_allclose(scans_of(log).T_base_lidar[:3, 3], [0.3, 0, 0])
    assert any("as its parameters say" in remark for remark in log.remarks)


@pytest.mark.parametrize("yaw", [np.pi, 0.0])
def test_the_rear_laser_looks_backwards(yaw: float, carmen_lines: Lines, tmp_path: Path) -> None:
    # Only where the poses say nothing of the direction does the parameter count.
    lines = [f"PARAM robot_rearlaser_offset {0.2 if yaw == 0 else 0.9} h 0"]
    lines += [carmen_lines["flaser"](k, name="RLASER", offset=-0.2, yaw=yaw) for k in range(60)]
    T = scans_of(read_lines(carmen_lines, tmp_path, lines)).T_base_lidar
    x, y, theta = xyt_from_pose(T)
    np.testing.assert_allclose([x, y, abs(theta)], [-0.2, 0, np.pi], atol=1e-5)


def test_the_front_laser_is_preferred(carmen_lines: Lines, tmp_path: Path) -> None:
    flaser, robotlaser = carmen_lines["flaser"], carmen_lines["robotlaser"]
    lines = [flaser(0, name="RLASER"), robotlaser(0), flaser(1), robotlaser(1), "TRUEPOS 0 0 0 0 0 0 1 h 0"]
    log = read_lines(carmen_lines, tmp_path, lines)
    np.testing.assert_allclose(scans_of(log).stamps_s, [1000.2])
    assert "only the FLASER scans are used, not 2 ROBOTLASER1, 1 RLASER" in log.remarks
    assert "messages of other kinds are ignored: 1 TRUEPOS" in log.remarks
    without_front = read_lines(carmen_lines, tmp_path, [line for line in lines if not line.startswith("FLASER")])
    np.testing.assert_allclose(scans_of(without_front).stamps_s, [2000, 2000.1])


def test_robotlaser_states_its_geometry_and_may_carry_remissions(carmen_lines: Lines, tmp_path: Path) -> None:
    lines = [carmen_lines["robotlaser"](k, remissions=(0, 20, 3)[k % 3]) for k in range(9)]
    lines[4] = lines[4].replace(" ", "  ")
    log = read_lines(carmen_lines, tmp_path, lines)
    scans = scans_of(log)
    assert scans.ranges_m.shape == (9, 20)
    np.testing.assert_allclose(scans.ranges_m[:, 1], 2.01 + 0.1 * np.arange(9), atol=1e-6)
    np.testing.assert_allclose(scans.stamps_s, 2000 + 0.1 * np.arange(9))
    np.testing.assert_allclose(scans.angles_rad[[0, 1]], [-2.0, -1.8])
    np.testing.assert_allclose(scans.T_base_lidar[:3, 3], [0.2, 0, 0])
    assert scans.range_max_m == 20.0
    np.testing.assert_array_equal(scans.returns()[0], [False] + [True] * 19)
    assert log.scan_odometry is not None
    np.testing.assert_allclose(log.scan_odometry.positions[:, 0], 0.1 * np.arange(9), atol=1e-9)


def test_a_laser_that_changes_its_angles_is_refused(carmen_lines: Lines, tmp_path: Path) -> None:
    lines = [carmen_lines["robotlaser"](k) for k in range(3)]
    lines[2] = lines[2].replace(" -2.0 4.0 0.2 ", " -1.0 2.0 0.1 ")
    with pytest.raises(InputError, match=r"a\.clf:3: the laser's angles change"):
        read_lines(carmen_lines, tmp_path, lines)


def test_scans_with_another_number_of_beams_are_dropped(carmen_lines: Lines, tmp_path: Path) -> None:
    lines = [carmen_lines["flaser"](k, 181 if k in (2, 5) else 180) for k in range(8)]
    log = read_lines(carmen_lines, tmp_path, lines)
    np.testing.assert_allclose(scans_of(log).stamps_s, 1000 + 0.2 * np.array([0, 1, 3, 4, 6, 7]))
    assert log.scan_odometry is not None
    assert len(log.scan_odometry) == 6
    assert "2 scans without 180 beams are dropped" in log.remarks


@pytest.mark.parametrize("name", ["a.clf", "a.log", "a.txt", "a.CLF", "a.clf.gz", "a.log.gz"])
def test_suffixes_are_recognised(name: str, carmen_lines: Lines, tmp_path: Path) -> None:
    path = carmen_lines["write"](tmp_path / name, ["# head", carmen_lines["odom"](0), carmen_lines["flaser"](0)])
    assert carmen.detects(path)
    assert len(scans_of(datasets.read(path))) == 1


def test_other_text_is_not_recognised(carmen_lines: Lines, tmp_path: Path) -> None:
    assert not carmen.detects(carmen_lines["write"](tmp_path / "a.txt", ["1 2 3", "about FLASER 180 lines"]))
    assert not carmen.detects(carmen_lines["write"](tmp_path / "a.dat", [carmen_lines["flaser"](0)]))
    assert not carmen.detects(carmen_lines["write"](tmp_path / "a.gz", [carmen_lines["flaser"](0)]))


def test_relations_and_truth_beside_the_log_are_read(carmen_lines: Lines, tmp_path: Path) -> None:
    (tmp_path / "a.relations").write_text("1000 1000.2 0.1 0 0 0 0 0.2\n")
    (tmp_path / "a.tum").write_text("1000 1 0 0 0 0 0 1\n")
    for name in ("a.clf", "a.clf.gz"):
        log = read_lines(carmen_lines, tmp_path, [carmen_lines["flaser"](k) for k in range(3)], name)
        assert log.relations is not None
        assert log.truth is not None
        assert (len(log.relations), len(log.truth), log.truth.parent) == (1, 1, "ref")


def test_every_cut_of_the_last_line_is_dropped(carmen_lines: Lines, tmp_path: Path) -> None:
    lines = [carmen_lines["flaser"](k, 20) for k in range(3)]
    whole = len(lines[2].rstrip()) - len(lines[2].split()[-1])
    for cut in (*range(7, 120, 9), *range(whole - 25, whole + 1)):
        path = tmp_path / "cut.clf"
        path.write_text("\n".join([*lines[:2], lines[2][:cut]]))
        log = datasets.read(path)
        assert len(scans_of(log)) == 2, lines[2][:cut]
        assert "the last message (line 3) is cut off and was dropped" in log.remarks


@pytest.mark.parametrize(
    "break_line",
    [
        lambda line: line.replace("FLASER 20", "FLASER 21"),
        lambda line: line.replace("FLASER 20", "FLASER twenty"),
        lambda line: line.replace("FLASER 20", "FLASER 0"),
        lambda line: line.replace("FLASER 20", "FLASER -3"),
        lambda line: line.replace(" 1.", " 1.x", 1),
        lambda line: line[:80],
        lambda line: "FLASER",
        lambda line: "FLASER 20",
        lambda line: "ODOM 1 2 3 host 0",
        lambda line: line.replace("host", "inf host", 1),
    ],
)
def test_a_malformed_line_is_named(break_line: Callable[[str], str], carmen_lines: Lines, tmp_path: Path) -> None:
    lines = ["# head", carmen_lines["odom"](0), *(carmen_lines["flaser"](k, 20) for k in range(5))]
    lines[4] = break_line(lines[4])
    with pytest.raises(InputError, match=r"a\.clf:5: malformed (FLASER|ODOM) message"):
        read_lines(carmen_lines, tmp_path, lines)


def test_a_missing_range_in_one_line_is_not_filled_from_the_next(carmen_lines: Lines, tmp_path: Path) -> None:
    lines = [carmen_lines["flaser"](k, 20) for k in range(4)]
    # As many spaces and, together, as many numbers as two whole lines have.
    lines[1] = lines[1].replace(" 1.08 ", "  ", 1)
    lines[2] = lines[2].replace(" 1.09 ", " 1.09\t1.09 ", 1)
    assert len(f"{lines[1]} {lines[2]}".split()) == 2 * len(lines[0].split())
    with pytest.raises(InputError, match=r"a\.clf:2: malformed FLASER message"):
        read_lines(carmen_lines, tmp_path, lines)


@pytest.mark.parametrize("column", [-4, -9, -3])
def test_a_pose_or_stamp_that_is_not_finite_is_named(column: int, carmen_lines: Lines, tmp_path: Path) -> None:
    lines = [carmen_lines["flaser"](k, 20) for k in range(4)]
    words = lines[2].split()
    words[column] = "nan"
    lines[2] = " ".join(words)
    with pytest.raises(InputError, match=r"a\.clf:3: holds a pose or stamp that is not finite"):
        read_lines(carmen_lines, tmp_path, lines)


def test_logs_without_laser_or_without_anything(carmen_lines: Lines, tmp_path: Path) -> None:
    log = read_lines(carmen_lines, tmp_path, [carmen_lines["odom"](k) for k in range(4)])
    assert log.scans is None
    assert log.scan_odometry is None
    assert log.odometry is not None
    assert log.odometry.path_length_m == pytest.approx(0.15)
    assert "there is no laser in the log" in log.remarks
    with pytest.raises(InputError, match="holds no FLASER, ROBOTLASER1, RLASER or ODOM message"):
        read_lines(carmen_lines, tmp_path, ["# nothing", "PARAM a b c 0"])


def test_a_file_that_only_claims_to_be_compressed_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.clf.gz"
    path.write_bytes(b"no gzip")
    with pytest.raises(InputError, match=r"a\.clf\.gz: cannot be read"):
        datasets.read(path)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "shape", "odometry", "path_m", "offset_m", "backwards", "last_deg"),
    [("intel", (13631, 180), 26915, 508.35, 0.0, 631, 89.0), ("fr079", (4934, 360), 8951, 391.61, -0.04, 0, 89.5)],
)
def test_real_logs(
    name: str, shape: tuple[int, int], odometry: int, path_m: float, offset_m: float, backwards: int, last_deg: float,
    psg_data: Path,
) -> None:  # fmt: skip
    log = datasets.read(psg_data / "carmen" / f"{name}.clf")
    scans = scans_of(log)
    assert log.odometry is not None
    assert log.scan_odometry is not None
    assert log.relations is not None
    assert scans.ranges_m.shape == shape
    assert len(log.odometry) == odometry
    assert log.scan_odometry.path_length_m == pytest.approx(path_m, abs=0.01)
    assert np.count_nonzero(np.diff(scans.stamps_s) < 0) == backwards
    np.testing.assert_allclose(scans.T_base_lidar[:3, 3], [offset_m, 0, 0], atol=1e-9)
    assert np.rad2deg(scans.angles_rad[-1]) == pytest.approx(last_deg)
    assert scans.ranges_m[scans.returns()].max() < 40
    np.testing.assert_array_equal(scans.returns(), scans.ranges_m < 80)
    assert np.isin(log.relations.stamps_1_s, scans.stamps_s).all()


@pytest.mark.data
def test_a_real_line_is_read_as_it_stands(psg_data: Path) -> None:
    path = psg_data / "carmen" / "fr079.clf"
    log = datasets.read(path)
    assert log.scan_odometry is not None
    last = [line for line in path.read_text().splitlines() if line.startswith("FLASER")][-1].split()
    np.testing.assert_array_equal(scans_of(log).ranges_m[-1], np.array(last[2:362], dtype=np.float32))
    laser, robot = (pose_from_xyt(np.array(last[start : start + 3], dtype=float)) for start in (362, 365))
    np.testing.assert_allclose(log.scan_odometry.poses[-1], robot, atol=1e-15)
    np.testing.assert_allclose((inverse_pose(robot) @ laser)[:2, 2], [-0.04, 0], atol=2e-6)


@pytest.mark.data
@pytest.mark.slow
def test_the_largest_log_reads_within_its_time_and_memory(psg_data: Path) -> None:
    path = psg_data / "carmen" / "intel.clf"
    code = (
        "import re, sys, time; from posegraph_slam import datasets; path = sys.argv[1]; datasets.read(path); "
        "start = time.process_time(); datasets.read(path); print(time.process_time() - start, "
        "int(re.search(r'VmHWM:\\s*(\\d+)', open('/proc/self/status').read())[1]) / 1024)"
    )
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True)
    seconds, peak_mib = map(float, done.stdout.split())
    assert seconds < 2.0, "0.65 s on the machine where it was written"
    assert peak_mib < 300, "190 MiB, of which 60 are the libraries"


@pytest.mark.data
def test_a_compressed_log_reads_the_same(psg_data: Path, tmp_path: Path) -> None:
    path = psg_data / "carmen" / "fr079.clf"
    compressed = tmp_path / "fr079.clf.gz"
    compressed.write_bytes(gzip.compress(path.read_bytes(), compresslevel=1))
    np.testing.assert_array_equal(scans_of(datasets.read(compressed)).ranges_m, scans_of(datasets.read(path)).ranges_m)
