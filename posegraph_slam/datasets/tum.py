"""TUM trajectory files: `stamp x y z qx qy qz qw` a line."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.datasets.number_text import read_table, refuse_first, require_in_range
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory, pose_from_rotation_translation

COLUMNS = ("timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")


def read_tum(path: str | Path, *, parent: str, child: str) -> Trajectory:
    """Read poses T_parent_child (N, 4, 4) in the order of the file.

    Comments (#) and blank lines are skipped, quaternions normalised; stamps may repeat or be out of order. Raises
    `InputError` naming the line for a wrong number of columns, a value that is not finite or a zero quaternion.
    """
    path = Path(path)
    values, numbers = read_table(path, COLUMNS)
    require_in_range(values, path, numbers)
    # A unit quaternion written with any number of digits is far above this; below, the direction is rounding noise.
    zero = np.linalg.norm(values[:, 4:], axis=1) < 1e-6
    refuse_first(zero, path, numbers, "holds a zero quaternion, which is no rotation")
    R = Rotation.from_quat(values[:, 4:]).as_matrix()
    return Trajectory(
        stamps_s=values[:, 0], poses=pose_from_rotation_translation(R, values[:, 1:4]), parent=parent, child=child
    )


def write_tum(trajectory: Trajectory, path: str | Path) -> None:
    """Write the poses in stamp order, planar ones with z, roll and pitch zero.

    Stamps get nine digits after the point, which keeps the float64 of any epoch since 1970 exact; positions and
    quaternions get the shortest text that reads back to the same number. The file appears whole or not at all.
    """
    path = Path(path)
    ordered = trajectory.spatial().in_stamp_order()
    if not (np.isfinite(ordered.stamps_s).all() and np.isfinite(ordered.poses).all()):
        raise InputError(path, "the trajectory holds values that are not finite", "nothing was written")
    quat_xyzw = np.empty((0, 4))
    if len(ordered):
        quat_xyzw = Rotation.from_matrix(ordered.poses[:, :3, :3]).as_quat(canonical=True)
    # Adding zero turns -0.0 into 0.0.
    values = np.column_stack([ordered.positions, quat_xyzw]) + 0.0
    rows = (
        f"{stamp:.9f} {' '.join(map(repr, row))}\n"
        for stamp, row in zip(ordered.stamps_s.tolist(), values.tolist(), strict=True)
    )
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with temporary.open("w", encoding="ascii") as file:
            file.write(f"# {' '.join(COLUMNS)} : pose of {trajectory.child} in {trajectory.parent}\n")
            file.writelines(rows)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise InputError(path, f"cannot be written ({error.strerror or error})", "check folder and space") from error
