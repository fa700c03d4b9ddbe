"""What the jobs of every kind of log find, whatever sensor they read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from posegraph_slam.arrays import IntArray
from posegraph_slam.evaluation.tables import ComparisonTable
from posegraph_slam.geometry import Trajectory
from posegraph_slam.loop_closure.ledger import LoopRecord, rejected_pairs
from posegraph_slam.pose_graph.graph import PoseGraph


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JobOutcome:
    """Trajectories, graph and figures of merit of a job.

    `stages` maps the names of stages, "optimised" the last, to their trajectories of all scans or frames; `graph` has
    the keyframes as nodes; `loops` records every candidate that was tried; `stages_s` are seconds of wall-clock time.
    """

    stages: Mapping[str, Trajectory]
    graph: PoseGraph
    loops: tuple[LoopRecord, ...]
    comparison: ComparisonTable
    metrics: Mapping[str, Any]
    stages_s: Mapping[str, float]
    truth: Trajectory | None
    remarks: tuple[str, ...]

    @property
    def trajectory(self) -> Trajectory:
        """The optimised trajectory, map -> base or camera, a pose for every scan or frame."""
        return self.stages["optimised"]

    @property
    def rejected_pairs(self) -> IntArray:
        """Target and source keyframe (R, 2) of the candidates that were rejected."""
        return rejected_pairs(self.loops)
