from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from posegraph_slam.datasets.tum import read_tum, write_tum
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory, pose_from_rotation_translation, pose_from_xyt


def random_trajectory(seed: int, count: int, epoch_s: float) -> Trajectory:
    rng = np.random.default_rng(seed)
    R = Rotation.random(count, rng=rng).as_matrix()
    t = rng.normal(0, 1, (count, 3)) * 10.0 ** rng.integers(-8, 5, (count, 3))
    stamps = epoch_s + rng.uniform(0, 1000, count)
    return Trajectory(stamps_s=stamps, poses=pose_from_rotation_translation(R, t), parent="ref", child="base")


@given(seed=st.integers(0, 10**6), count=st.integers(1, 30), epoch_s=st.sampled_from([0.0, 1298445274.5, 4e9]))
@settings(max_examples=25)
def test_what_is_written_reads_back(
    tmp_path_factory: pytest.TempPathFactory, seed: int, count: int, epoch_s: float
) -> None:
    written = random_trajectory(seed, count, epoch_s)
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    write_tum(written, path)
    back, expected = read_tum(path, parent="ref", child="base"), written.in_stamp_order()
    np.testing.assert_allclose(back.stamps_s, expected.stamps_s, rtol=0, atol=0 if epoch_s else 5.1e-10)
    np.testing.assert_array_equal(back.positions, expected.positions)
    np.testing.assert_allclose(back.poses, expected.poses, rtol=0, atol=4e-15 * max(1.0, abs(expected.poses).max()))
    assert [file.name for file in path.parent.iterdir()] == ["a.tum"], "no temporary file is left"


def test_stamps_are_written_in_order_each_with_its_pose(tmp_path: Path) -> None:
    xyt = np.array([[3.0, 0, 0.3], [1.0, 0, 0.1], [2.0, 0, 0.2], [2.5, 0, 0.25]])
    write_tum(
        Trajectory(stamps_s=[3, 1, 2, 2], poses=pose_from_xyt(xyt), parent="map", child="base"), tmp_path / "a.tum"
    )
    back = read_tum(tmp_path / "a.tum", parent="map", child="base")
    np.testing.assert_array_equal(back.stamps_s, [1, 2, 2, 3])
    np.testing.assert_array_equal(back.positions[:, 0], [1.0, 2.0, 2.5, 3.0])


def test_layout_of_a_written_line(tmp_path: Path) -> None:
    pose = pose_from_xyt(np.array([[0.1, -2.0, np.pi / 2]]))
    write_tum(Trajectory(stamps_s=[1298445274.550587], poses=pose, parent="map", child="base"), tmp_path / "a.tum")
    header, line = (tmp_path / "a.tum").read_text().splitlines()
    assert header.startswith("# timestamp x y z qx qy qz qw")
    stamp, *values = line.split()
    assert stamp == "1298445274.550586939"
    np.testing.assert_allclose([float(v) for v in values], [0.1, -2, 0, 0, 0, 0.5**0.5, 0.5**0.5], atol=1e-15)


def test_comments_blank_lines_and_unnormalised_quaternions(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("# head\n\n  # indented\n1 0 0 0 0 0 0 2\r\n\n1.5 1 2 3 0 0 0.2 0.2\n1.5 1 2 3 0 0 -7 -7")
    trajectory = read_tum(path, parent="ref", child="base")
    np.testing.assert_array_equal(trajectory.stamps_s, [1, 1.5, 1.5])
    np.testing.assert_allclose(trajectory.poses[0], np.eye(4), atol=1e-15)
    np.testing.assert_allclose(trajectory.poses[1, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(trajectory.poses[2], trajectory.poses[1], atol=1e-15)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("2 0 0 0 0 0 0 0", "zero quaternion"),
        ("2 0 0 0 nan 0 0 1", "not finite"),
        ("inf 0 0 0 0 0 0 1", "not finite"),
        ("2 0 0 1e300 0 0 0 1", r"beyond 1e\+30"),
        ("2 0 0 0 0 0 1", "has 7 columns instead of the 8"),
        ("2 0 0 0 0 0 0 1 9", "has 9 columns"),
        ("2 0 zero 0 0 0 0 1", "not a number"),
    ],
)
def test_a_bad_line_is_named(line: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(f"# head\n1 0 0 0 0 0 0 1\n\n{line}\n3 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=rf"bad\.tum:4: .*{problem}"):
        read_tum(path, parent="ref", child="base")


def test_empty_and_missing_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "empty.tum").write_text("# nothing\n")
    with pytest.raises(InputError, match=r"empty\.tum: holds no row"):
        read_tum(tmp_path / "empty.tum", parent="ref", child="base")
    with pytest.raises(InputError, match=r"missing\.tum: cannot be read"):
        read_tum(tmp_path / "missing.tum", parent="ref", child="base")


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("old")
    bad = Trajectory(stamps_s=[0.0], poses=np.full((1, 4, 4), np.nan), parent="map", child="base")
    with pytest.raises(InputError, match="not finite"):
        write_tum(bad, path)
    assert path.read_text() == "old"
    with pytest.raises(InputError, match="cannot be written"):
        write_tum(random_trajectory(0, 2, 0.0), tmp_path / "no folder" / "a.tum")
