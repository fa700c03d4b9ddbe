"""Errors of trajectories against what is known to be true, and tables that compare them."""

from posegraph_slam.evaluation.ape import AbsolutePoseError, absolute_pose_error
from posegraph_slam.evaluation.association import Pairs, pair_nearest
from posegraph_slam.evaluation.path import PathSummary, summarise_path
from posegraph_slam.evaluation.relations import RelationErrors, relation_errors
from posegraph_slam.evaluation.rpe import RelativePoseError, relative_pose_error
from posegraph_slam.evaluation.statistics import ErrorStatistics, summarise
from posegraph_slam.evaluation.summary import TrajectoryMetrics, compare, evaluate_trajectory
from posegraph_slam.evaluation.tables import ComparisonRow, ComparisonTable

__all__ = [
    "AbsolutePoseError",
    "ComparisonRow",
    "ComparisonTable",
    "ErrorStatistics",
    "Pairs",
    "PathSummary",
    "RelationErrors",
    "RelativePoseError",
    "TrajectoryMetrics",
    "absolute_pose_error",
    "compare",
    "evaluate_trajectory",
    "pair_nearest",
    "relation_errors",
    "relative_pose_error",
    "summarise",
    "summarise_path",
]
