"""The pose of a known object in clouds that see it in part: model and clouds from files to poses and aligned clouds."""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.datasets.clouds import CloudFile, is_cloud, read_cloud
from posegraph_slam.datasets.ply import write_ply
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.files import replacing
from posegraph_slam.geometry import transform_points
from posegraph_slam.registration.cloud import Cloud
from posegraph_slam.registration.fit import Fit, measure_fit
from posegraph_slam.registration.global_search import (
    DEFAULT_SEARCH,
    GlobalRegistration,
    GlobalSearchSettings,
    PreparedTarget,
    StartKind,
    prepare_target,
    register_globally,
)

MILLIMETRE_RATIOS = (200.0, 5000.0)
"""Size of a model over that of its clouds between which the model is in millimetres and the clouds in metres."""

TRIMMED_SHARE = 0.9
"""Share of the points over which the trimmed error is reported, whatever share the search kept."""

MODEL_POINTS_MIN = 10
"""Fewer bound nothing."""

POSES = "poses.json"

ALIGNED = "_aligned"
"""Ends the names of clouds that were written, which are no input then."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Task:
    """A model and its clouds, each with the name it goes by: a path relative to where the task was found."""

    name: str
    model: Path
    clouds: tuple[tuple[str, Path], ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectPose:
    """One cloud aligned to its model; `points` (n, 3) are its own, in metres. `fit` is none where nothing fits."""

    cloud: str
    model: Path
    points: FloatArray
    registration: GlobalRegistration
    fit: Fit | None

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", read_only(self.points))

    @property
    def T_model_cloud(self) -> FloatArray:  # noqa: N802
        """Pose (4, 4) in metres; NaN where nothing fits."""
        return self.registration.result.T_target_source

    def as_dict(self) -> dict[str, Any]:
        """Return what `poses.json` holds of it."""
        result = self.registration.result
        entry: dict[str, Any] = {
            "cloud": self.cloud,
            "model": self.model.name,
            "T_model_cloud": self.T_model_cloud.tolist() if self.fit else None,
            "status": str(result.status),
            "points": len(self.points),
            "start": self.registration.start,
            "starts": self.registration.starts,
            "iterations": result.iterations,
        }
        if self.fit:
            entry |= {
                "inlier_fraction": self.fit.inlier_fraction,
                "one_way_rmse_m": self.fit.rmse_m,
                "trimmed_rmse_m": self.fit.trimmed_rmse_m,
                "sum_of_squares_m2": self.fit.sum_of_squares_m2,
                "sum_of_distances_m": self.fit.sum_of_distances_m,
            }
        return entry


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlignedObject:
    """All clouds of one task, its model in metres, and what was noticed while reading."""

    task: Task
    model: Cloud
    poses: tuple[ObjectPose, ...]
    remarks: tuple[str, ...]


def tasks_of_folder(folder: Path) -> tuple[Task, ...]:
    """Find the objects of a folder: itself, or its subfolders, with one file `model.*` and clouds beside it."""
    if not folder.is_dir():
        raise InputError(folder, "is not a folder", "name a folder of objects, each with a model and clouds")
    tasks = []
    for place in [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]:
        files = sorted(path for path in place.iterdir() if path.is_file() and is_cloud(path))
        models = [path for path in files if path.stem == "model"]
        if len(models) > 1:
            raise InputError(place, f"holds {' and '.join(m.name for m in models)}", "keep one model an object")
        seen = [path for path in files if path not in models and not path.stem.endswith(ALIGNED)]
        clouds = tuple((path.relative_to(folder).as_posix(), path) for path in seen)
        if models and clouds:
            name = place.name if place != folder else folder.resolve().name
            tasks.append(Task(name=name, model=models[0], clouds=clouds))
    if not tasks:
        raise InputError(folder, "holds no object", "put a file model.mat (.npy, .ply ...) beside the clouds of it")
    return tuple(tasks)


def task_of_files(model: Path, clouds: Sequence[Path]) -> Task:
    """Make the task of one model and some clouds, which go by the paths as they were given.

    A file called `model` takes the name of its folder, as it does in a folder of objects.
    """
    name = model.resolve().parent.name if model.stem == "model" else model.stem
    return Task(name=name, model=model, clouds=tuple((path.as_posix(), path) for path in clouds))


def align_object(
    task: Task, settings: GlobalSearchSettings = DEFAULT_SEARCH, *, progress: Progress = silent_progress
) -> AlignedObject:
    """Find the pose of every cloud of a task in the frame of its model, both in metres, without a guess.

    A model some thousand times the size of its clouds is taken to be in millimetres, and `remarks` says so. A cloud
    that fits nowhere keeps its place with a status. Raises `InputError` for files that cannot be read.
    """
    model_file, files = read_cloud(task.model), [read_cloud(path) for _, path in task.clouds]
    if len(model_file.points) < MODEL_POINTS_MIN:
        raise InputError(task.model, f"holds {len(model_file.points)} points", "a model needs some hundred at least")
    remarks = [
        f"{file.path}: {file.dropped} points without values left out" for file in [model_file, *files] if file.dropped
    ]
    model_points = model_file.points
    if in_millimetres(model_file, files):
        model_points = model_points / 1000.0
        remarks.append(f"{task.model}: taken as millimetres, {side(model_file.points):.1f} along the longest side")
    target = prepare_target(model_points, settings)
    poses = []
    for number, ((name, _), file) in enumerate(zip(task.clouds, files, strict=True)):
        progress(task.name, number, len(files))
        poses.append(_align(name, task.model, file, target, settings))
    progress(task.name, len(files), len(files))
    return AlignedObject(task=task, model=target.cloud, poses=tuple(poses), remarks=tuple(remarks))


def _align(
    name: str, model: Path, file: CloudFile, target: PreparedTarget, settings: GlobalSearchSettings
) -> ObjectPose:
    found = register_globally(file.points, target, settings)
    fit = None
    if found.result.usable:
        fit = measure_fit(file.points, target.cloud, found.result.T_target_source, TRIMMED_SHARE)
    return ObjectPose(cloud=name, model=model, points=file.points, registration=found, fit=fit)


def in_millimetres(model: CloudFile, clouds: Sequence[CloudFile]) -> bool:
    """Whether a model is so large beside its clouds that it is in millimetres."""
    middle = float(np.median([inner_side(cloud.points) for cloud in clouds])) if clouds else 0.0
    low, high = MILLIMETRE_RATIOS
    return middle > 0 and low < inner_side(model.points) / middle < high


def inner_side(points: FloatArray) -> float:
    """Longest side of the box around the middle 90 % of points (n, 3) along each axis: a few outliers do not count."""
    return float(np.ptp(np.quantile(points, [0.05, 0.95], axis=0), axis=0).max())


def side(points: FloatArray) -> float:
    """Longest side of the box around points (n, 3)."""
    return float(np.ptp(points, axis=0).max())


def describe_start(registration: GlobalRegistration, settings: GlobalSearchSettings) -> str:
    """Name the start that won: its turn and, where there are several, the shift from the model's middle."""
    if registration.start < 0:
        return "-"
    if settings.starts is StartKind.YAW:
        return f"yaw {math.degrees(2 * math.pi * registration.start / settings.rotations):.0f} deg"
    turn, shift = divmod(registration.start, 7)
    return f"{turn} {('mid', '+x', '+y', '+z', '-x', '-y', '-z')[shift]}"


def require_free_output(folder: Path, *, overwrite: bool) -> None:
    """Raise `InputError` if `folder` is a file, or holds poses already and these may not be replaced."""
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "is not a folder", "choose another --out")
    if (folder / POSES).exists() and not overwrite:
        raise InputError(folder / POSES, "exists already", "add --overwrite to replace it, or choose another --out")


def save_objects(objects: Sequence[AlignedObject], folder: Path) -> None:
    """Write `poses.json` and, for every cloud with a pose, the cloud in the model's frame as PLY, in metres."""
    poses = [pose for found in objects for pose in found.poses]
    with replacing(folder / POSES) as temporary:
        text = json.dumps([pose.as_dict() for pose in poses], indent=1, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")
    names = aligned_names([pose.cloud for pose in poses])
    for pose in poses:
        if pose.fit:
            write_ply(transform_points(pose.T_model_cloud, pose.points), folder / f"{names[pose.cloud]}.ply")


def aligned_names(clouds: Sequence[str]) -> dict[str, str]:
    """Name, without suffix, of what is written of each cloud: its own relative path with `_aligned`.

    Paths that lead elsewhere (absolute, or upwards) start at the folder that holds all of theirs. Clouds that differ by
    their suffix alone keep it.
    """
    paths = [Path(cloud) for cloud in clouds]
    if any(path.is_absolute() or ".." in path.parts for path in paths):
        paths = [Path(os.path.abspath(path)) for path in paths]
        top = Path(os.path.commonpath([path.parent for path in paths])).parent
        paths = [path.relative_to(top) for path in paths]
    files = Counter(path.with_suffix("") for path in {*paths})
    return {
        cloud: (path if files[path.with_suffix("")] > 1 else path.with_suffix("")).as_posix() + ALIGNED
        for cloud, path in zip(clouds, paths, strict=True)
    }
