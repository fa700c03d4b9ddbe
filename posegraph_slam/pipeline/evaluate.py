"""A trajectory against what is known to be true, from files to figures of merit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.datasets.registry import read, recognised
from posegraph_slam.datasets.relations import read_relations
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.ape import AbsolutePoseError, AlignedPaths, Alignment, align_paths, error_of
from posegraph_slam.evaluation.path import PathSummary, summarise_path
from posegraph_slam.evaluation.relations import RelationErrors, relation_errors
from posegraph_slam.evaluation.rpe import RelativePoseError, relative_pose_error
from posegraph_slam.evaluation.statistics import ErrorStatistics
from posegraph_slam.geometry import SE2, Relations, Trajectory
from posegraph_slam.pipeline.convert import ConversionOptions, source_trajectory
from posegraph_slam.pipeline.run_directory import RECORD

ALIGNMENTS = ("auto", "none", "first", "se2", "se3", "sim3")
DISTANCES_M = (1.0, 5.0, 10.0)
STATISTICS = ("mean", "std", "median", "rmse", "max")


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """What is known to be true: poses, relations, or both."""

    trajectory: Trajectory | None = None
    relations: Relations | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """Errors of one trajectory; None where the reference does not tell them. `paths` are those that APE compares."""

    path: PathSummary
    ape: AbsolutePoseError | None
    rpe: RelativePoseError | None
    relations: RelationErrors | None
    paths: AlignedPaths | None

    def as_dict(self) -> dict[str, Any]:
        """Return everything for JSON."""
        parts = {"path": self.path, "ape": self.ape, "rpe": self.rpe, "relations": self.relations}
        return {name: None if part is None else part.as_dict() for name, part in parts.items()}

    def as_text_rows(self) -> list[list[str]]:
        """Return the cells for printing, the header first: a row a metric, a column a statistic."""
        rows = [["", *STATISTICS, "count"]]
        if self.ape is not None:
            rows += _rows("APE", self.ape.translation_m, self.ape.rotation_deg)
        if self.rpe is not None:
            for error in (self.rpe.per_frame, *self.rpe.over_distance):
                name = "RPE a frame" if error.distance_m is None else f"RPE over {error.distance_m:g} m"
                rows += _rows(name, error.translation_m, error.rotation_deg)
        if self.relations is not None:
            for name in ("all", "near", "far"):
                group = getattr(self.relations, name)
                rows += _rows(f"relations, {name}", group.translation_m, group.rotation_deg)
        return rows


def _rows(name: str, translation: ErrorStatistics | None, rotation: ErrorStatistics | None) -> list[list[str]]:
    return [
        [f"{name} {unit}", *(f"{getattr(errors, each):.4f}" for each in STATISTICS), str(errors.count)]
        for unit, errors in (("[m]", translation), ("[deg]", rotation))
        if errors is not None
    ]


def read_reference(path: Path, *, format: str | None = None, times: Path | None = None) -> Reference:  # noqa: A002
    """Read true poses (a trajectory file, a run directory, a log that knows its truth) or relations (`.relations`)."""
    if path.suffix == ".relations":
        return Reference(relations=read_relations(path))
    if path.exists() and not (path / RECORD).is_file() and format is None and recognised(path):
        log = read(path)
        if log.truth is None and log.relations is None:
            raise InputError(path, "is a log that knows no true poses", "give a trajectory or a relations file")
        return Reference(trajectory=log.truth, relations=log.relations)
    options = ConversionOptions(source_format=format, times=times, stream="truth")
    return Reference(trajectory=source_trajectory(path, options)[0])


def evaluate(
    estimate: Trajectory,
    reference: Reference,
    *,
    alignment: Alignment = "auto",
    distances_m: tuple[float, ...] = DISTANCES_M,
    max_dt_s: float = 0.02,
) -> Evaluation:
    """Measure a trajectory against a reference: APE after `alignment`, RPE over `distances_m`, relations.

    A flat estimate (z, roll and pitch zero, as planar runs are written) counts as planar, so that auto aligns it in the
    plane. With sim3 the estimate is scaled before RPE and relations too. Raises InputError where they do not overlap in
    time.
    """
    paths = ape = rpe = None
    if alignment == "auto" and is_flat(estimate):
        alignment = "se2"
    scaled = estimate
    if reference.trajectory is not None:
        paths = align_paths(estimate, reference.trajectory, alignment=alignment, max_dt_s=max_dt_s)
        ape = error_of(paths, len(reference.trajectory))
        poses = estimate.poses.copy()
        poses[:, :-1, -1] *= paths.scale
        scaled = estimate.with_poses(poses)
        rpe = relative_pose_error(scaled, reference.trajectory, distances_m=distances_m, max_dt_s=max_dt_s)
    relations = None if reference.relations is None else relation_errors(scaled, reference.relations)
    return Evaluation(path=summarise_path(estimate), ape=ape, rpe=rpe, relations=relations, paths=paths)


def is_flat(trajectory: Trajectory) -> bool:
    """Whether no pose leaves the xy-plane."""
    if trajectory.group is SE2:
        return True
    upright = trajectory.poses[:, 2, 2] > 1 - 1e-12
    return bool(upright.all() and np.abs(trajectory.poses[:, 2, 3]).max(initial=0.0) == 0.0)
