"""Runs of a hand-held IMU board under a motion-capture system (UPenn ESE650, UCSD ECE276A): one .npz file a run.

`imu_raw` 6 x N ADC counts (rows Ax Ay Az Wz Wx Wy) at `imu_stamps_s`; where the truth is known, `vicon_rotation`
3 x 3 x M (board to world) at `vicon_stamps_s`.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from posegraph_slam.datasets.npz import Archive
from posegraph_slam.datasets.raw_imu import imu_from_counts
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory, pose_from_rotation_translation
from posegraph_slam.sensors import RobotLog

ORTHONORMAL_TOLERANCE = 1e-3
LOST_SHARE_MAX = 0.5
"""Motion capture loses a body now and then; matrices that are mostly no rotations are something else."""


def detects(path: Path) -> bool:
    """Tell whether `path` is an .npz archive with the field `imu_raw`, or a broken one, which `read` explains."""
    if path.suffix != ".npz" or not path.is_file():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return "imu_raw.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return True


def read(path: str | Path) -> RobotLog:
    """Read a run into a `RobotLog` with its IMU in SI units, and its truth (positions zero) where the file has one.

    The IMU frame is the base. Raises `InputError` naming file and field for anything that cannot be used.
    """
    path = Path(path)
    archive = Archive(path)
    stamps = archive.stamps("imu_stamps_s")
    counts = archive.finite_samples("imu_raw", 6, stamps)
    imu, remarks = imu_from_counts(counts, stamps, where=f"{path}, field 'imu_raw'")
    truth, lost = _truth(archive) if "vicon_rotation" in archive else (None, ())
    return RobotLog(path=path, format="imu_vicon", imu=imu, truth=truth, remarks=(*remarks, *lost))


def _truth(archive: Archive) -> tuple[Trajectory, tuple[str, ...]]:
    """Return the truth without the samples at which the motion capture lost the board, and a remark on these."""
    stamps = archive.stamps("vicon_stamps_s")
    R = np.asarray(archive.numbers("vicon_rotation"), dtype=np.float64)
    if R.shape != (3, 3, len(stamps)):
        raise InputError(archive.path, f"field 'vicon_rotation' has shape {R.shape}", f"expected (3, 3, {len(stamps)})")
    R = np.moveaxis(R, 2, 0)
    with np.errstate(invalid="ignore", over="ignore"):
        bad = ~(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) < ORTHONORMAL_TOLERANCE)
        bad |= ~(np.linalg.det(R) > 0)
    if bad.mean() > LOST_SHARE_MAX:
        where = f"at {int(bad.sum())} of {len(R)} stamps, first at index {int(np.argmax(bad))}"
        raise InputError(archive.path, f"field 'vicon_rotation' holds no rotation {where}")
    poses = pose_from_rotation_translation(R[~bad], np.zeros((int((~bad).sum()), 3)))
    truth = Trajectory(stamps_s=stamps[~bad], poses=poses, parent="ref", child="base")
    if not bad.any():
        return truth, ()
    first = stamps[int(np.argmax(bad))] - stamps[0]
    return truth, (
        f"no truth at {int(bad.sum())} of {len(R)} of its stamps, first at {first:.2f} s: no rotations there",
    )
