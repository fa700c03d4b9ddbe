"""The scan matching of a run, stored so that loop closure can be tried again without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.archive import npz_bytes, read_npz, replace_file
from posegraph_slam.odometry.scan_matching import ScanMatchingResult
from posegraph_slam.odometry.wheel_calibration import UNCALIBRATED, WheelCalibration

MATCHING = "scan_matching.npz"
CLOCKS = ("lag", "sweep")
WHEELS = ("scale", "sigma", "noise_per_sqrt_m")
ARRAYS = ("keyframes", "keyframe_information", "scan_information", "matched_fraction", "searched")


def write_matching(matched: ScanMatchingResult, path: Path) -> None:
    """Write poses, keyframes and their noise exactly."""
    arrays = {name: getattr(matched, name) for name in ARRAYS}
    trajectory = {"stamps_s": matched.trajectory.stamps_s, "poses": matched.trajectory.poses}
    clocks = {name: np.array(getattr(matched, name)) for name in CLOCKS}
    wheels = {"wheels": np.array([getattr(matched.wheels, name) for name in WHEELS])}
    replace_file(path, npz_bytes({**trajectory, **clocks, **wheels, **arrays}))


def read_matching(path: Path, scans: int) -> ScanMatchingResult:
    """Read the scan matching of a log of `scans` scans; InputError where the file is of another log.

    Files without `wheels` are of runs whose wheels were not calibrated.
    """
    arrays = read_npz(path, ("stamps_s", "poses", *CLOCKS, *ARRAYS), optional=("wheels",))
    count = len(arrays["stamps_s"])
    if count != scans:
        raise InputError(path, f"holds {count} scans, but the log has {scans}", "give the run directory of this log")
    if arrays["poses"].shape != (count, 3, 3) or not np.isfinite(arrays["poses"]).all():
        raise InputError(path, "does not hold finite planar poses", "run `psg optimize` again to write it")
    wheels = arrays.get("wheels")
    if wheels is not None and (wheels.shape != (len(WHEELS),) or not (np.isfinite(wheels[0]) and (wheels > 0).all())):
        raise InputError(path, "does not hold a calibration of wheels", "run `psg optimize` again to write it")
    trajectory = Trajectory(stamps_s=arrays["stamps_s"], poses=arrays["poses"], parent="odom", child="base")
    return ScanMatchingResult(
        trajectory=trajectory,
        keyframes=arrays["keyframes"],
        keyframe_information=arrays["keyframe_information"],
        scan_information=arrays["scan_information"],
        matched_fraction=arrays["matched_fraction"],
        searched=arrays["searched"],
        lag=float(arrays["lag"]),
        sweep=float(arrays["sweep"]),
        wheels=UNCALIBRATED if wheels is None else WheelCalibration(**dict(zip(WHEELS, wheels.tolist(), strict=True))),
    )
