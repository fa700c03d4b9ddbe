"""Point clouds in files: MAT, NPY, PLY, PCD and XYZ, read without further packages; PLY is written too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.datasets.cloud_text import read_text_points
from posegraph_slam.datasets.pcd import read_pcd
from posegraph_slam.datasets.ply import read_ply
from posegraph_slam.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudFile:
    """Points (n, 3) of a file in its own unit; `dropped` of them were not finite (no return) and are left out."""

    path: Path
    points: FloatArray
    dropped: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", read_only(self.points))


def read_cloud(path: Path) -> CloudFile:
    """Read the points of a cloud file by its suffix: .mat, .npy, .ply, .pcd, .xyz, .txt or .csv.

    Arrays may hold a point a row or a point a column. Raises `InputError` naming the file and what is wrong with it.
    """
    if not path.is_file():
        raise InputError(path, "is not a file", "name an existing cloud")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(path, f"has the unknown suffix '{path.suffix}'", f"readable are {', '.join(READERS)}")
    with np.errstate(invalid="ignore"):  # single precision NaN of every kind become NaN
        points = np.asarray(reader(path), dtype=np.float64)
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise InputError(path, "holds no finite point")
    return CloudFile(path=path, points=points[finite], dropped=int(np.count_nonzero(~finite)))


def is_cloud(path: Path) -> bool:
    """Whether the suffix of a file is one of those that `read_cloud` reads."""
    return path.suffix.lower() in READERS


def _read_npy(path: Path) -> FloatArray:
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:  # a damaged header fails in every way that a parser can
        problem = f"cannot be read as an array ({[*str(error).splitlines(), type(error).__name__][0]})"
        raise InputError(path, problem, "store the points as one numeric array") from error
    if not isinstance(array, np.ndarray):
        raise InputError(path, "is an archive, not one array", "store the points by numpy.save")
    return _points_of(array, path)


def _read_mat(path: Path) -> FloatArray:
    from posegraph_slam.datasets.matlab import load_mat

    fields = load_mat(path)
    arrays = {name: value for name, value in fields.items() if np.ndim(value) == 2}
    clouds = {name: value for name, value in arrays.items() if value.dtype.kind in "iuf" and 3 in value.shape}
    if len(clouds) != 1:
        present = ", ".join(f"{name} {value.shape}" for name, value in arrays.items()) or "no array"
        raise InputError(path, f"holds {present}", "it must hold exactly one array of points (3, n) or (n, 3)")
    return _points_of(next(iter(clouds.values())), path)


def _points_of(array: np.ndarray, path: Path) -> FloatArray:
    """Points (n, 3) of an array that holds them as rows or as columns; a 3 x 3 array holds rows."""
    if array.dtype.kind not in "iuf" or array.ndim != 2 or 3 not in array.shape:
        raise InputError(path, f"holds {array.dtype} of shape {array.shape}", "give numbers of shape (n, 3) or (3, n)")
    return np.asarray(array if array.shape[1] == 3 else array.T, dtype=np.float64)


READERS: dict[str, Callable[[Path], FloatArray]] = {
    ".mat": _read_mat,
    ".npy": _read_npy,
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".xyz": read_text_points,
    ".txt": read_text_points,
    ".csv": read_text_points,
}
"""What reads a suffix; each gives points (n, 3), some of which may not be finite."""
