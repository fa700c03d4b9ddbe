from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from posegraph_slam.datasets.relations import read_relations
from posegraph_slam.errors import InputError


def test_rotation_is_yaw_after_pitch_after_roll(tmp_path: Path) -> None:
    path = tmp_path / "a.relations"
    path.write_text("# t1 t2 ...\n976052905.167303 976052911.885496 1 2 3 0.1 -0.2 0.3\n\n2 1 0 0 0 0 0 -1.5\n")
    relations = read_relations(path)
    roll, pitch, yaw = 0.1, -0.2, 0.3
    Rx = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    Ry = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    Rz = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    assert len(relations) == 2
    np.testing.assert_allclose(relations.T_1_2[0, :3, :3], Rz @ Ry @ Rx, atol=1e-15)
    np.testing.assert_array_equal(relations.T_1_2[0, :, 3], [1, 2, 3, 1])
    np.testing.assert_array_equal(relations.stamps_1_s, [976052905.167303, 2])
    np.testing.assert_array_equal(relations.stamps_2_s, [976052911.885496, 1])


@pytest.mark.parametrize(
    ("line", "problem"),
    [("1 2 0 0 0 0 0", "7 columns"), ("1 2 0 0 0 0 0 nan", "not finite"), ("1 2 0 0 x 0 0 0", "number")],
)
def test_a_bad_line_is_named(line: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.relations"
    path.write_text(f"1 2 0 0 0 0 0 0\n{line}\n")
    with pytest.raises(InputError, match=rf"bad\.relations:2: .*{problem}"):
        read_relations(path)


@pytest.mark.data
def test_real_relations_join_laser_stamps(psg_data: Path) -> None:
    counts = {"intel": 2984, "fr079": 1685}
    for name, count in counts.items():
        relations = read_relations(psg_data / "carmen" / f"{name}.relations")
        assert len(relations) == count
        assert np.abs(relations.T_1_2[:, 2, 3]).max() == 0
