"""The humanoid's LiDAR files: a cell array of structs, one a scan, in the two forms that the courses ship.

UPenn's ESE650 gives odometry poses, beam spacing and IMU angles (t, pose, res, rpy, scan), UCSD's ECE276A only the
odometry's differences (t, scan, delta_pose). docs/formats/humanoid.md describes both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import FloatArray, in_range, range_fault, read_only
from posegraph_slam.datasets.matlab import load_mat, numbers, require
from posegraph_slam.errors import InputError

POSES, STEPS = ("t", "pose", "res", "rpy", "scan"), ("t", "scan", "delta_pose")
"""Fields of a scan in the two forms, in the order in which the files have them."""
SIZES = {"t": 1, "res": 1, "pose": 3, "rpy": 3, "delta_pose": 3}
FIELD_OF_VIEW_RAD = np.deg2rad(270.0)
"""The beams of a scan span this angle; only the first form says how far apart they are."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LidarRecords:
    """Stamps (N,), ranges (N, B), angle between beams, odometry poses (N, 3), and IMU angles (N, 3) where there are."""

    stamps_s: FloatArray
    ranges_m: FloatArray
    resolution_rad: float
    pose: FloatArray
    rpy_rad: FloatArray | None

    def __post_init__(self) -> None:
        for name in ("stamps_s", "ranges_m", "pose"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def read_lidar(path: Path) -> LidarRecords:
    """Read a LiDAR file of either form; raise InputError naming scan and field.

    Fields are known by their names, or by their order where a file names them otherwise: time first; then, at the
    end, pose, res, rpy and scan of five or six, or scan and delta_pose of three.
    """
    cells = np.asarray(require(load_mat(path), "lidar", path)).reshape(-1)
    if len(cells) < 2:
        raise InputError(path, f"holds {len(cells)} scans")
    names = _field_names(path, cells[0])
    fields = {name: _stacked(path, cells, name, stored) for name, stored in names.items()}
    stamps, ranges = fields["t"][:, 0], fields["scan"]
    if "delta_pose" in fields:
        steps = fields["delta_pose"].copy()
        steps[0] = 0.0  # the way to the first scan is nobody's
        spacing = float(FIELD_OF_VIEW_RAD / max(ranges.shape[1] - 1, 1))
        return LidarRecords(
            stamps_s=stamps, ranges_m=ranges, resolution_rad=spacing, pose=np.cumsum(steps, axis=0), rpy_rad=None
        )
    spacing = float(fields["res"][0, 0])
    if not 0 < spacing < 0.2 or np.ptp(fields["res"]) > 1e-9:
        raise InputError(path, f"field 'res' is {spacing:g} rad", "it must be one positive step for all scans")
    return LidarRecords(
        stamps_s=stamps, ranges_m=ranges, resolution_rad=spacing, pose=fields["pose"], rpy_rad=fields["rpy"]
    )


def _field_names(path: Path, cell: object) -> Mapping[str, str]:
    """Return the name in the file of each field that is needed, by what the first scan holds."""
    stored: tuple[str, ...] = _record(cell).dtype.names or ()
    form = STEPS if "delta_pose" in stored or len(stored) == len(STEPS) else POSES
    if set(form) & set(stored) or len(stored) not in (3, 5, 6):
        return {name: name for name in form}
    return dict(zip(form, (stored[0], *stored[1 - len(form) :]), strict=True))


def _record(cell: object) -> Any:
    return np.asarray(cell).reshape(-1)[0] if isinstance(cell, np.ndarray) else cell


def _stacked(path: Path, cells: npt.NDArray[Any], name: str, stored: str) -> FloatArray:
    """Stack a field of all scans (N, n); cells that hold structs and struct arrays are both understood."""
    rows = []
    for number, cell in enumerate(cells):
        record = _record(cell)
        if stored not in (getattr(getattr(record, "dtype", None), "names", None) or ()):
            wanted = f"a scan holds {', '.join(POSES)}, or {', '.join(STEPS)}"
            raise InputError(path, f"scan {number} has no field '{stored}'", wanted)
        rows.append(numbers(record[stored], stored, path).reshape(-1))
    sizes, wanted_size = {len(row) for row in rows}, SIZES.get(name)
    if len(sizes) != 1 or wanted_size not in (None, *sizes) or sizes == {0}:
        raise InputError(
            path, f"field '{name}' has {sorted(sizes)} values", f"expected {wanted_size or 'one number of beams'}"
        )
    values = np.stack(rows)
    if name != "scan" and not in_range(values).all():
        bad = int(np.argmax(~in_range(values).all(axis=1)))
        raise InputError(path, f"field '{name}' of scan {bad} is {range_fault(values[bad])}", "repair the log")
    return values
