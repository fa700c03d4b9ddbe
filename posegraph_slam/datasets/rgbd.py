"""Folders of colour and depth images: the TUM RGB-D benchmark's and Open3D's layouts."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from posegraph_slam.arrays import FloatArray, IntArray, in_range, range_fault
from posegraph_slam.datasets.image_headers import ImageHeader, read_image_header
from posegraph_slam.datasets.number_text import read_table, refuse_first, require_in_range
from posegraph_slam.datasets.rgbd_camera import (
    DEPTH_UNITS_PER_M,
    TUM_DEPTH_UNITS_PER_M,
    default_camera,
    find_camera_file,
    read_camera,
)
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Trajectory, pose_from_rotation_translation
from posegraph_slam.sensors import RgbdSequence, RobotLog

COLOUR_FOLDERS, DEPTH_FOLDERS = ("rgb", "color", "colour", "image", "images"), ("depth", "depths")
COLOUR_SUFFIXES, DEPTH_SUFFIXES = (".png", ".jpg", ".jpeg", ".ppm"), (".png", ".pgm")
TRUTH_FILES = ("groundtruth.txt", "truth.tum", "pose.txt", "poses.txt", "trajectory.txt", "traj.txt")
ASSOCIATION_FILES = ("associations.txt", "associated.txt", "association.txt", "assoc.txt")
POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
TUM_GAP_S = 0.02
"""Colour and depth frames further apart in time are not paired; the benchmark's own tool takes the same."""
ASSUMED_RATE_HZ = 30.0

_Pairs = tuple[list[Path], list[Path], FloatArray, FloatArray]
"""Colour and depth files, stamps of the colour, and how much later the depth was taken."""


def detects(path: Path) -> bool:
    """Whether `path` is a folder with lists of colour and depth files, or with a folder of each."""
    if not path.is_dir():
        return False
    if _associations(path) is not None or ((path / "rgb.txt").is_file() and (path / "depth.txt").is_file()):
        return True
    return _subfolder(path, COLOUR_FOLDERS) is not None and _subfolder(path, DEPTH_FOLDERS) is not None


def read(path: Path) -> RobotLog:
    """Read a folder of registered colour and depth images; the images themselves stay on disk.

    The camera is the body. Raises InputError for frames without partner, images of unequal size, depth that is not of
    16 bits, and files that cannot be read.
    """
    remarks: list[str] = []
    associations, tum = _associations(path), True
    if associations is not None:
        colour, depth, stamps, lag_s = _associated_pairs(associations, remarks)
    elif (path / "rgb.txt").is_file() and (path / "depth.txt").is_file():
        colour, depth, stamps, lag_s = _listed_pairs(path, remarks)
    else:
        colour, depth, stamps, lag_s = _numbered_pairs(path, remarks)
        tum = False
    header = _checked_headers(colour, depth)
    file = find_camera_file(path)
    if file is None:
        camera, remark = default_camera(path, header.width, header.height, tum=tum)
        remarks.append(remark)
    else:
        units = TUM_DEPTH_UNITS_PER_M if tum else DEPTH_UNITS_PER_M
        camera, more = read_camera(file, header.width, header.height, units)
        remarks += [f"intrinsics from {file.name}: {camera.describe()}", *more]
    sequence = RgbdSequence(
        stamps_s=stamps, depth_lag_s=lag_s, colour_files=tuple(colour), depth_files=tuple(depth), camera=camera
    )
    truth = _truth(path, stamps)
    return RobotLog(path=path, format="rgbd", rgbd_sequence=sequence, truth=truth, remarks=tuple(remarks))


def _associations(path: Path) -> Path | None:
    """The list of pairs in the folder, under one of its customary names."""
    return next((path / name for name in ASSOCIATION_FILES if (path / name).is_file()), None)


def _subfolder(path: Path, names: tuple[str, ...]) -> Path | None:
    """The subfolder with the first of the customary names, in any case."""
    by_name = {entry.name.lower(): entry for entry in sorted(path.iterdir()) if entry.is_dir()}
    return next((by_name[name] for name in names if name in by_name), None)


def _listed_pairs(path: Path, remarks: list[str]) -> _Pairs:
    """Pair the frames of rgb.txt and depth.txt (a stamp and a file a line) by time, each used once."""
    colour_s, colour = _read_list(path / "rgb.txt")
    depth_s, depth = _read_list(path / "depth.txt")
    pairs = nearest_pairs(colour_s, depth_s, TUM_GAP_S)
    if len(pairs) == 0:
        raise InputError(path, f"no colour and depth frames lie within {TUM_GAP_S:g} s", "check rgb.txt and depth.txt")
    left = len(colour) - len(pairs)
    if left:
        remarks.append(f"{left} of {len(colour)} colour frames have no depth frame within {TUM_GAP_S:g} s: left out")
    stamps = colour_s[pairs[:, 0]]
    return [colour[c] for c in pairs[:, 0]], [depth[d] for d in pairs[:, 1]], stamps, depth_s[pairs[:, 1]] - stamps


def nearest_pairs(a_s: FloatArray, b_s: FloatArray, gap_s: float) -> IntArray:
    """Pair stamps a (n,) and b (m,) no further apart than `gap_s`: rows (k, 2) in the order of a, each stamp used once.

    Of all pairs the closest is taken first, then the closest of what is left, as the benchmark's own tool does: a frame
    whose nearest partner belongs to another gets its second nearest.
    """
    order = np.argsort(b_s, kind="stable")
    low = np.searchsorted(b_s[order], a_s - gap_s, side="left")
    count = np.searchsorted(b_s[order], a_s + gap_s, side="right") - low
    rows = np.repeat(np.arange(len(a_s)), count)
    columns = order[np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(low, count)]
    partner, taken = dict[int, int](), set[int]()
    for k in np.lexsort((columns, rows, np.abs(a_s[rows] - b_s[columns]))).tolist():
        a, b = int(rows[k]), int(columns[k])
        if a not in partner and b not in taken:
            partner[a] = b
            taken.add(b)
    return np.array(sorted(partner.items()), dtype=np.int64).reshape(-1, 2)


def _associated_pairs(file: Path, remarks: list[str]) -> _Pairs:
    """Read pairs from a list: stamp and file of colour and of depth, or the other way round, a line."""
    first_s, first, second_s, second = list[float](), list[Path](), list[float](), list[Path]()
    for number, words in _lines(file):
        try:
            stamps, names = (float(words[0]), float(words[2])), (words[1], words[3])
        except (ValueError, IndexError):
            raise InputError(f"{file}:{number}", "is not two pairs of a stamp and a file", "correct the line") from None
        if not in_range(stamps).all():
            raise InputError(f"{file}:{number}", f"a stamp is {range_fault(stamps)}", "correct the line")
        first.append(_listed_file(file, number, names[0]))
        second.append(_listed_file(file, number, names[1]))
        first_s.append(stamps[0])
        second_s.append(stamps[1])
    if not first:
        raise InputError(file, "lists no frame", "give a stamp and a file name, twice a line")
    remarks.append(f"{len(first)} pairs of colour and depth from {file.name}")
    depth_first = read_image_header(first[0]).bits == 16 and read_image_header(second[0]).bits != 16
    if depth_first:
        return second, first, np.array(second_s), np.array(first_s) - np.array(second_s)
    return first, second, np.array(first_s), np.array(second_s) - np.array(first_s)


def _lines(file: Path) -> Iterator[tuple[int, list[str]]]:
    """Words of every line that is neither blank nor a comment, with its number."""
    for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield number, words


def _listed_file(list_file: Path, number: int, name: str) -> Path:
    frame = list_file.parent / name
    if not frame.is_file():
        raise InputError(
            f"{list_file}:{number}", f"names {name}, which is missing", "copy the file, or remove the line"
        )
    return frame


def _read_list(file: Path) -> tuple[FloatArray, list[Path]]:
    stamps, paths = list[float](), list[Path]()
    for number, words in _lines(file):
        try:
            stamp = float(words[0])
            name = words[1]
        except (ValueError, IndexError):
            raise InputError(f"{file}:{number}", "is not a stamp and a file name", "correct the line") from None
        if not in_range(stamp):
            raise InputError(f"{file}:{number}", f"its stamp is {range_fault(stamp)}", "correct the line")
        paths.append(_listed_file(file, number, name))
        stamps.append(stamp)
    if not stamps:
        raise InputError(file, "lists no frame", "give a stamp and a file name a line")
    return np.array(stamps), paths


def _numbered_pairs(path: Path, remarks: list[str]) -> _Pairs:
    """Pair the files of two folders by the number in their names, or by order where the numbers are unrelated."""
    colour_folder, depth_folder = _subfolder(path, COLOUR_FOLDERS), _subfolder(path, DEPTH_FOLDERS)
    if colour_folder is None or depth_folder is None:
        raise InputError(
            path, "has no folders of colour and depth images", f"name them {COLOUR_FOLDERS[1]} and {DEPTH_FOLDERS[0]}"
        )
    colour, depth = _images(colour_folder, COLOUR_SUFFIXES), _images(depth_folder, DEPTH_SUFFIXES)
    only_colour, only_depth = sorted(set(colour) - set(depth)), sorted(set(depth) - set(colour))
    if only_colour or only_depth:
        if len(colour) != len(depth) or set(colour) & set(depth):
            lonely = colour[only_colour[0]] if only_colour else depth[only_depth[0]]
            missing = "depth" if only_colour else "colour"
            raise InputError(
                lonely,
                f"has no {missing} frame of the same number ({len(colour)} colour and {len(depth)} depth frames)",
                "add the missing frame, or remove this one",
            )
        remarks.append("colour and depth frames are numbered differently: they are paired in order")
    a, b = [colour[key] for key in sorted(colour)], [depth[key] for key in sorted(depth)]
    stamps = _stamps_of_names(a)
    if stamps is None:
        stamps = np.arange(len(a)) / ASSUMED_RATE_HZ
        remarks.append(f"the frames have no stamps: {ASSUMED_RATE_HZ:g} frames a second are assumed")
    return a, b, stamps, np.zeros(len(stamps))


def _images(folder: Path, suffixes: tuple[str, ...]) -> dict[tuple[float, str], Path]:
    """Image files of a folder by the first number in their name; where numbers repeat, by name too."""
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes)
    if not files:
        raise InputError(folder, f"holds no image ({', '.join(suffixes)})", "check the folder")
    numbers = [_number_in(file.stem) for file in files]
    if len(set(numbers)) == len(files):
        return {(number, ""): file for number, file in zip(numbers, files, strict=True)}
    return {(number, file.stem): file for number, file in zip(numbers, files, strict=True)}


def _number_in(name: str) -> float:
    found = re.search(r"\d+(?:\.\d+)?", name)
    return float(found[0]) if found else -1.0


def _stamps_of_names(files: list[Path]) -> FloatArray | None:
    """Stamps (N,) where every name is a number of seconds with decimals."""
    if not all(re.fullmatch(r"\d+\.\d+", file.stem) for file in files):
        return None
    return np.array([float(file.stem) for file in files])


def _checked_headers(colour: list[Path], depth: list[Path]) -> ImageHeader:
    """The header of the first colour image, after all have been compared with it and each depth found usable."""
    first = read_image_header(colour[0])
    for file in colour:
        header = read_image_header(file)
        if (header.width, header.height) != (first.width, first.height):
            raise InputError(file, f"is {header}, but {colour[0].name} is {first}", "all images must have one size")
        if header.bits != 8:
            raise InputError(file, f"is {header}", "give colour images of 8 bits")
    for file in depth:
        header = read_image_header(file)
        if header.bits != 16 or header.channels != 1:
            raise InputError(file, f"is {header}, not 16-bit grey", "store depth as 16-bit PNG or PGM")
        if (header.width, header.height) != (first.width, first.height):
            raise InputError(
                file, f"is {header.width} x {header.height}, but the colour images are {first.width} x {first.height}",
                "register the depth to the colour images",
            )  # fmt: skip
    return first


def _truth(path: Path, stamps: FloatArray) -> Trajectory | None:
    """True camera poses: a TUM file, or x y z qx qy qz qw a line for every frame."""
    file = next((path / name for name in TRUTH_FILES if (path / name).is_file()), None)
    if file is None:
        return None
    with file.open(encoding="utf-8", errors="replace") as lines:
        width = next((len(line.split()) for line in lines if line.strip() and not line.startswith("#")), 0)
    if width != len(POSE_COLUMNS):
        return read_tum(file, parent="ref", child="camera")
    values, numbers = read_table(file, POSE_COLUMNS)
    require_in_range(values, file, numbers)
    refuse_first(np.linalg.norm(values[:, 3:], axis=1) < 1e-6, file, numbers, "holds a zero quaternion")
    if len(values) != len(stamps):
        raise InputError(file, f"holds {len(values)} poses for {len(stamps)} frames", "give one a frame")
    R = Rotation.from_quat(values[:, 3:]).as_matrix()
    return Trajectory(
        stamps_s=stamps, poses=pose_from_rotation_translation(R, values[:, :3]), parent="ref", child="camera"
    )
