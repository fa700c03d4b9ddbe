"""Relations files of the SLAM benchmark of Kuemmerle et al. 2009: `t1 t2 x y z roll pitch yaw` a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.datasets.number_text import read_table, require_in_range
from posegraph_slam.files import replacing
from posegraph_slam.geometry import Relations, pose_from_rotation_translation

COLUMNS = ("t1", "t2", "x", "y", "z", "roll", "pitch", "yaw")


def read_relations(path: str | Path) -> Relations:
    """Read true poses T_1_2 (M, 4, 4) of the robot at t2 in its frame at t1; metres and radians.

    The rotation is Rz(yaw) Ry(pitch) Rx(roll). Comments (#) and blank lines are skipped. Raises `InputError` naming the
    line for a wrong number of columns or a value that is not finite.
    """
    path = Path(path)
    values, numbers = read_table(path, COLUMNS)
    require_in_range(values, path, numbers)
    R = Rotation.from_euler("xyz", values[:, 5:]).as_matrix()
    return Relations(
        stamps_1_s=values[:, 0], stamps_2_s=values[:, 1], T_1_2=pose_from_rotation_translation(R, values[:, 2:5])
    )


def write_relations(relations: Relations, path: str | Path) -> None:
    """Write true poses in the form that `read_relations` reads; numbers read back as they are."""
    rpy = Rotation.from_matrix(relations.T_1_2[:, :3, :3]).as_euler("xyz")
    values = (np.column_stack([relations.T_1_2[:, :3, 3], rpy]) + 0.0).tolist()
    stamps = zip(relations.stamps_1_s.tolist(), relations.stamps_2_s.tolist(), strict=True)
    with replacing(Path(path)) as temporary, temporary.open("w", encoding="ascii", newline="\n") as file:
        file.write(f"# {' '.join(COLUMNS)}\n")
        for (first, second), row in zip(stamps, values, strict=True):
            file.write(f"{first!r} {second!r} {' '.join(map(repr, row))}\n")
