"""The scan matching of a run, stored so that loop closure can be tried again without it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import in_range, range_fault
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.archive import npz_bytes, read_npz, replace_file
from posegraph_slam.odometry.scan_matching import ScanMatchingResult
from posegraph_slam.odometry.wheel_calibration import UNCALIBRATED, WheelCalibration

MATCHING = "scan_matching.npz"
CLOCKS = ("lag", "sweep")
WHEELS = ("scale", "sigma", "noise_per_sqrt_m")
REMEDY = "run `psg optimize` again to write it"
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

    Raises it too where an array has not the shape of the others or is not finite, and where keyframes do not rise.
    Files without `wheels` are of runs whose wheels were not calibrated.
    """
    arrays = read_npz(path, ("stamps_s", "poses", *CLOCKS, *ARRAYS), optional=("wheels",))
    count = arrays["stamps_s"].size
    if count != scans:
        raise InputError(path, f"holds {count} scans, but the log has {scans}", "give the run directory of this log")
    _check(path, arrays)
    wheels = arrays.get("wheels")
    if wheels is not None and (wheels.shape != (len(WHEELS),) or not (np.isfinite(wheels[0]) and (wheels > 0).all())):
        raise InputError(path, "does not hold a calibration of wheels", REMEDY)
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


def _check(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Raise InputError naming the first array whose shape or values do not fit the others."""
    count, kept = arrays["stamps_s"].size, arrays["keyframes"].size
    shapes = {
        "stamps_s": (count,),
        "poses": (count, 3, 3),
        "lag": (),
        "sweep": (),
        "keyframes": (kept,),
        "keyframe_information": (max(kept - 1, 0), 3, 3),
        "scan_information": (count, 3, 3),
        "matched_fraction": (count,),
        "searched": (arrays["searched"].size,),
    }
    for name, shape in shapes.items():
        array = arrays[name]
        if array.shape != shape:
            raise InputError(path, f"'{name}' has shape {array.shape} instead of {shape}", REMEDY)
        if not in_range(array).all():
            raise InputError(path, f"'{name}' is {range_fault(array)}", REMEDY)
    for name, least in (("keyframes", 1), ("searched", 0)):
        scans = arrays[name]
        rising = (np.diff(scans) > 0).all() and (scans >= 0).all() and (scans < count).all()
        if scans.dtype.kind not in "iu" or len(scans) < least or not rising:
            raise InputError(path, f"'{name}' does not hold rising numbers of scans", REMEDY)
