"""Map files written whole or not at all, and the exact .npz form of a map."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from posegraph_slam.errors import InputError
from posegraph_slam.files import replacing
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid

FORMAT_VERSION = 1


def replace_file(path: Path, content: bytes) -> None:
    """Write `content` to `path`, whole or not at all; InputError names a path that cannot be written."""
    try:
        with replacing(Path(path)) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise InputError(
            path, f"cannot be written ({error.strerror})", "check the folder and its permissions"
        ) from error


def npz_bytes(arrays: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """Return an .npz archive of `arrays` whose bytes depend on nothing else: numpy's own may carry the time."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(info, member.getvalue())
    return buffer.getvalue()


def read_npz(path: Path, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, npt.NDArray[Any]]:
    """Read the numeric arrays `names` of an .npz archive, and those of `optional` that it has.

    InputError names the file and what is wrong with it.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in (*names, *(name for name in optional if name in archive))}
    except FileNotFoundError as error:
        raise InputError(path, "no such file") from error
    except KeyError as error:
        raise InputError(
            path, f"is not a map file: {error.args[0]}", "give the .npz that this program wrote"
        ) from error
    except Exception as error:  # a damaged archive fails in every way that a parser can
        raise InputError(
            path, f"cannot be read as .npz ({error})", "the file may be truncated: make it again"
        ) from error
    for name, array in arrays.items():
        if array.dtype.kind not in "biuf":
            raise InputError(path, f"'{name}' does not hold numbers ({array.dtype})", "make the file again")
    return arrays


def geometry_arrays(geometry: GridGeometry) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays that describe a grid in an .npz file."""
    return {
        "format_version": np.array(FORMAT_VERSION),
        "origin_m": geometry.origin_m,
        "resolution_m": np.array(geometry.resolution_m),
        "yaw_rad": np.array(geometry.yaw_rad),
    }


def write_occupancy(grid: OccupancyGrid, path: Path) -> None:
    """Write the grid exactly: log_odds (R, C) float32, observed (R, C), origin_m, resolution_m, yaw_rad."""
    arrays = {**geometry_arrays(grid.geometry), "log_odds": grid.log_odds, "observed": grid.observed}
    replace_file(path, npz_bytes(arrays))


def read_occupancy(path: Path) -> OccupancyGrid:
    """Read a grid that `write_occupancy` wrote; it is the same to the last bit."""
    names = ("format_version", "origin_m", "resolution_m", "yaw_rad", "log_odds", "observed")
    arrays = read_npz(path, names)
    if arrays["format_version"].shape != () or arrays["format_version"] != FORMAT_VERSION:
        raise InputError(path, f"has format version {arrays['format_version']}, not {FORMAT_VERSION}")
    shape = arrays["log_odds"].shape
    wanted = {"origin_m": (2,), "resolution_m": (), "yaw_rad": (), "observed": shape}
    wrong = [f"{name} has shape {arrays[name].shape}" for name, want in wanted.items() if arrays[name].shape != want]
    if len(shape) != 2 or wrong:
        raise InputError(path, f"log_odds has shape {shape}" + "".join(f", {text}" for text in wrong), "make it again")
    if not np.isfinite(arrays["log_odds"]).all():
        raise InputError(path, "log_odds is not finite", "make it again")
    try:
        geometry = GridGeometry(
            origin_m=arrays["origin_m"],
            resolution_m=float(arrays["resolution_m"]),
            shape=(shape[0], shape[1]),
            yaw_rad=float(arrays["yaw_rad"]),
        )
    except InputError as error:
        raise InputError(path, error.problem, "make it again") from error
    return OccupancyGrid(geometry=geometry, log_odds=arrays["log_odds"], observed=arrays["observed"])
