"""Everything that can be said of a trajectory, and several of them side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from posegraph_slam.evaluation.ape import AbsolutePoseError, absolute_pose_error
from posegraph_slam.evaluation.path import PathSummary, summarise_path
from posegraph_slam.evaluation.relations import RelationErrors, relation_errors
from posegraph_slam.evaluation.rpe import RelativePoseError, relative_pose_error
from posegraph_slam.evaluation.statistics import ErrorStatistics
from posegraph_slam.evaluation.tables import ComparisonRow, ComparisonTable
from posegraph_slam.geometry import Relations, Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrajectoryMetrics:
    """The path itself always; absolute and relative errors where the truth is known; relations where these are.

    `crispness` is a figure of the map built from the trajectory, given by whoever built it.
    """

    path: PathSummary
    ape: AbsolutePoseError | None = None
    rpe: RelativePoseError | None = None
    relations: RelationErrors | None = None
    crispness: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return everything for JSON; what is not known is None."""
        return {
            "path": self.path.as_dict(),
            "ape": self.ape.as_dict() if self.ape else None,
            "rpe": self.rpe.as_dict() if self.rpe else None,
            "relations": self.relations.as_dict() if self.relations else None,
            "crispness": self.crispness,
        }


def evaluate_trajectory(
    trajectory: Trajectory,
    *,
    truth: Trajectory | None = None,
    relations: Relations | None = None,
    crispness: float | None = None,
) -> TrajectoryMetrics:
    """Measure a trajectory against whatever truth there is: a true trajectory, true relations, both or neither.

    Raises InputError when the truth does not overlap with the trajectory in time.
    """
    return TrajectoryMetrics(
        path=summarise_path(trajectory),
        ape=absolute_pose_error(trajectory, truth) if truth is not None else None,
        rpe=relative_pose_error(trajectory, truth) if truth is not None else None,
        relations=relation_errors(trajectory, relations) if relations is not None else None,
        crispness=crispness,
    )


def compare(stages: Mapping[str, TrajectoryMetrics]) -> ComparisonTable:
    """Put the metrics of the stages (name -> metrics, in the order of the columns) side by side."""
    rows = (
        ComparisonRow(
            name=name, unit=unit, decimals=decimals, values=tuple(value(metrics) for metrics in stages.values())
        )
        for name, unit, decimals, value in _METRICS
    )
    return ComparisonTable(
        stages=tuple(stages), rows=tuple(row for row in rows if any(value is not None for value in row.values))
    )


Value = Callable[[TrajectoryMetrics], float | None]


def _ape(part: str, field: str) -> Value:
    return lambda m: _field(getattr(m.ape, part) if m.ape else None, field)


def _rpe(distance_m: float | None, part: str) -> Value:
    def value(metrics: TrajectoryMetrics) -> float | None:
        if metrics.rpe is None:
            return None
        error = metrics.rpe.per_frame if distance_m is None else metrics.rpe.over(distance_m)
        return _field(getattr(error, part) if error else None, "rmse")

    return value


def _relations(group: str, part: str) -> Value:
    return lambda m: _field(getattr(getattr(m.relations, group), part) if m.relations else None, "mean")


def _field(statistics: ErrorStatistics | None, field: str) -> float | None:
    return None if statistics is None else float(getattr(statistics, field))


_METRICS: tuple[tuple[str, str, int, Value], ...] = (
    ("APE position RMSE", "m", 3, _ape("translation_m", "rmse")),
    ("APE position max", "m", 3, _ape("translation_m", "max")),
    ("APE rotation mean", "deg", 2, _ape("rotation_deg", "mean")),
    ("RPE position a frame", "m", 4, _rpe(None, "translation_m")),
    ("RPE position over 1 m", "m", 4, _rpe(1.0, "translation_m")),
    ("RPE rotation over 1 m", "deg", 3, _rpe(1.0, "rotation_deg")),
    ("RPE position over 5 m", "m", 3, _rpe(5.0, "translation_m")),
    ("RPE position over 10 m", "m", 3, _rpe(10.0, "translation_m")),
    ("relations position mean", "m", 3, _relations("all", "translation_m")),
    ("relations rotation mean", "deg", 2, _relations("all", "rotation_deg")),
    ("near relations position mean", "m", 3, _relations("near", "translation_m")),
    ("far relations position mean", "m", 3, _relations("far", "translation_m")),
    ("far relations rotation mean", "deg", 2, _relations("far", "rotation_deg")),
    ("start-end gap", "m", 3, lambda m: m.path.start_end_gap_m),
    ("start-end turn", "deg", 2, lambda m: m.path.start_end_gap_deg),
    ("path length", "m", 2, lambda m: m.path.length_m),
    ("map crispness", "", 3, lambda m: m.crispness),
)
