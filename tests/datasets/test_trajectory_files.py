"""Trajectories in the formats of others: the same numbers come back, and evo reads the same poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.datasets.trajectory_files import (
    TRAJECTORY_FORMATS,
    guess_format,
    read_trajectory,
    write_trajectory,
)
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE3, Trajectory


def random_trajectory(seed: int = 0, count: int = 30, epoch_s: float = 1.3e9) -> Trajectory:
    rng = np.random.default_rng(seed)
    tangent = np.concatenate([rng.normal(0, 1, (count, 3)), rng.normal(0, 100, (count, 3))], axis=1)
    stamps = epoch_s + np.cumsum(rng.uniform(0.01, 0.2, count))
    return Trajectory(stamps_s=stamps, poses=SE3.exp(tangent), parent="map", child="base")


@pytest.mark.parametrize("name", TRAJECTORY_FORMATS)
@pytest.mark.parametrize("epoch_s", [0.0, 1.7e9])
def test_what_is_written_reads_back(name: str, epoch_s: float, tmp_path: Path) -> None:
    trajectory = random_trajectory(epoch_s=epoch_s)
    path = tmp_path / f"poses{TRAJECTORY_FORMATS[name].suffix}"
    write_trajectory(trajectory, path, format=name)
    assert guess_format(path) == name
    again = read_trajectory(path, parent="map")
    np.testing.assert_allclose(again.stamps_s, trajectory.stamps_s, atol=3e-7 if name == "euroc" else 0)
    np.testing.assert_allclose(again.poses, trajectory.poses, atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1), name=st.sampled_from(sorted(TRAJECTORY_FORMATS)))
def test_writing_what_was_read_gives_the_same_numbers(
    tmp_path_factory: pytest.TempPathFactory, seed: int, name: str
) -> None:
    folder = tmp_path_factory.mktemp("numbers")
    suffix = TRAJECTORY_FORMATS[name].suffix
    write_trajectory(random_trajectory(seed, count=3, epoch_s=0.0), folder / f"a{suffix}", format=name)
    write_trajectory(read_trajectory(folder / f"a{suffix}"), folder / f"b{suffix}", format=name)
    numbers = [
        np.array((folder / f"{each}{suffix}").read_text().replace(",", " ").split()[-8:], float) for each in "ab"
    ]
    np.testing.assert_allclose(numbers[0], numbers[1], rtol=1e-12, atol=1e-12)


def test_evo_reads_the_same_poses(tmp_path: Path) -> None:
    trajectory = random_trajectory()
    for name in ("tum", "kitti", "euroc"):
        path = tmp_path / f"{name}{TRAJECTORY_FORMATS[name].suffix}"
        write_trajectory(trajectory, path, format=name)
        reader = {
            "tum": file_interface.read_tum_trajectory_file,
            "kitti": file_interface.read_kitti_poses_file,
            "euroc": file_interface.read_euroc_csv_trajectory,
        }[name]
        theirs = reader(path)
        np.testing.assert_allclose(np.array(theirs.poses_se3), trajectory.poses, atol=1e-9, err_msg=name)
        if name != "kitti":
            np.testing.assert_allclose(theirs.timestamps, trajectory.stamps_s, atol=5e-7)


def test_we_read_what_evo_writes(tmp_path: Path) -> None:
    trajectory = random_trajectory()
    write_trajectory(trajectory, tmp_path / "a.tum")
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    file_interface.write_tum_trajectory_file(tmp_path / "b.txt", theirs)
    file_interface.write_kitti_poses_file(tmp_path / "c.txt", theirs)
    assert [guess_format(tmp_path / name) for name in ("b.txt", "c.txt")] == ["tum", "kitti"]
    for name in ("b.txt", "c.txt"):
        np.testing.assert_allclose(read_trajectory(tmp_path / name).poses, trajectory.poses, atol=1e-5)


def test_stamps_of_kitti_come_from_their_file(tmp_path: Path) -> None:
    trajectory = random_trajectory(count=4)
    write_trajectory(trajectory, tmp_path / "00.kitti")
    (tmp_path / "00_times.txt").rename(tmp_path / "other.txt")
    assert read_trajectory(tmp_path / "00.kitti").stamps_s.tolist() == [0, 1, 2, 3]
    given_file = read_trajectory(tmp_path / "00.kitti", times=tmp_path / "other.txt")
    np.testing.assert_allclose(given_file.stamps_s, trajectory.stamps_s, atol=1e-9)
    (tmp_path / "times.txt").write_text("1\n2\n")
    with pytest.raises(InputError, match=r"times\.txt: holds 2 stamps, but 00\.kitti 4 poses"):
        read_trajectory(tmp_path / "00.kitti")


def test_columns_beyond_the_pose_are_left_out_and_a_header_of_words_is_skipped(tmp_path: Path) -> None:
    file = tmp_path / "data.csv"
    file.write_text("#timestamp, p_x\n1403636579758555392,1,2,3,1,0,0,0,0.5,0.5,0.5,7,7,7,8,8,8\n")
    found = read_trajectory(file)
    assert found.positions.tolist() == [[1.0, 2.0, 3.0]]
    assert found.stamps_s[0] == pytest.approx(1403636579.758555, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "text", "part"),
    [
        (
            "a.csv",
            "stamp_s,x_m,y_m,z_m,qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n1,2,3\n",
            r"a\.csv:3: does not begin",
        ),
        ("a.csv", "stamp_s,x\n0,1,2,x,0,0,0,1\n", r"a\.csv:2"),
        ("a.csv", "0,1,2,3,0,0,0,0\n", r"a\.csv:1: holds a zero quaternion"),
        ("a.csv", "\n", "holds no row"),
        ("a.kitti", "1 0 0 0 0 2 0 0 0 0 1 0\n", r"a\.kitti:1: holds no rotation"),
        ("a.kitti", "1 0 0 0 0 1 0 0 0 0 -1 0\n", "holds no rotation"),
        ("a.txt", "1 2 3\n", "3 columns: neither TUM"),
    ],
)
def test_what_is_wrong_names_file_and_line(name: str, text: str, part: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=part):
        read_trajectory(tmp_path / name)


def test_unknown_formats_and_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown trajectory format 'ros'"):
        read_trajectory(tmp_path / "a.tum", format="ros")
    with pytest.raises(InputError, match="names no trajectory format"):
        write_trajectory(random_trajectory(), tmp_path / "a.xyz")
    with pytest.raises(InputError, match="no such file"):
        read_trajectory(tmp_path / "a.tum")
    bad = random_trajectory().with_poses(np.full((30, 4, 4), np.nan))
    with pytest.raises(InputError, match="not finite"):
        write_trajectory(bad, tmp_path / "a.kitti")
    assert not list(tmp_path.iterdir())


CSV_HEAD, CSV_ROW = b"stamp_s,x_m,y_m,z_m,qx,qy,qz,qw\n", b"1,2,3,4,0,0,0,1\n"


@pytest.mark.parametrize("head", [b"", CSV_HEAD, b"\xef\xbb\xbf" + CSV_HEAD, b"\xef\xbb\xbf", b"\xff\xfe,text\n"])
def test_a_table_may_begin_with_words_and_with_a_byte_order_mark(head: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(head + CSV_ROW)
    np.testing.assert_array_equal(read_trajectory(tmp_path / "a.csv").positions, [[2, 3, 4]])


@pytest.mark.parametrize("first", [b"\xff" + CSV_ROW, b"one" + CSV_ROW])
def test_a_damaged_first_row_is_not_taken_for_a_header(first: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(first + CSV_ROW)
    with pytest.raises(InputError, match=r"a\.csv:1: does not begin with 8 numbers"):
        read_trajectory(tmp_path / "a.csv")


@pytest.mark.parametrize("stamp", ["nan", "-inf", "1e300"])
def test_stamps_of_kitti_poses_are_checked(stamp: str, tmp_path: Path) -> None:
    (tmp_path / "a.kitti").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    (tmp_path / "times.txt").write_text(f"1\n{stamp}\n")
    with pytest.raises(InputError, match=r"times\.txt:2: holds a value that is (not finite|beyond)"):
        read_trajectory(tmp_path / "a.kitti")
