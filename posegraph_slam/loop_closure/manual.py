"""A closure that a person proposes: registered like any other, and judged by the same evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import SerialExecutor
from posegraph_slam.geometry import SE2, xyt_from_pose
from posegraph_slam.loop_closure.innovation import innovation, linearise
from posegraph_slam.loop_closure.ledger import LoopRecord
from posegraph_slam.loop_closure.matching import Evidence, constraints_of, register_candidates
from posegraph_slam.loop_closure.proposals import Candidates, make_candidates, narrowed
from posegraph_slam.loop_closure.settings import LoopClosureSettings
from posegraph_slam.loop_closure.verification import gaussian_sigmas, rejection_reasons, surprise_reasons
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.registration.beam_scans import BeamScans

APART_MIN = 2
"""Keyframes closer than this in the chain are tied by scan matching already."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Proposal:
    """What registration found for a pair of keyframes: T_target_source (3, 3) and information (3, 3) of base poses.

    `record` holds the evidence; `reason` says why the match cannot be trusted, `surprise` that it is a good match but
    disagrees with the graph; both are empty where nothing speaks against it.
    """

    T_target_source: FloatArray
    information: FloatArray
    record: LoopRecord
    reason: str
    surprise: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_target_source", read_only(self.T_target_source))
        object.__setattr__(self, "information", read_only(self.information))


def propose(graph: PoseGraph, scans: BeamScans, target: int, source: int, settings: LoopClosureSettings) -> Proposal:
    """Register keyframe `source` to the scans around the older keyframe `target`, rows of `graph` (K) and `scans` (K).

    First in the window that the graph's own uncertainty suggests, then in one as wide as the two keyframes lie apart
    in the map and a view more: a person who names them says that they see the same surfaces. Those too far apart for
    any window are taken to be at the same place. Raises InputError for keyframes that are not there or are neighbours.
    """
    target, source = sorted((int(target), int(source)))
    if target < 0 or source >= len(graph):
        raise InputError("closure", f"there is no keyframe {target if target < 0 else source}")
    if source - target < APART_MIN:
        raise InputError("closure", "the two keyframes are neighbours, tied by scan matching already",
                         "choose two that are further apart on the path")  # fmt: skip
    linear = linearise(graph, settings.verification.drift)
    pair = (np.array([target]), np.array([source]))
    covariance = linear.relative_covariance(*pair)
    candidates = _candidates(graph, pair, settings)
    tries = [(narrowed(candidates, covariance), graph.poses), _wide(candidates, graph, settings)]
    for tried, poses in tries:
        evidence = register_candidates(
            tried, scans, poses @ scans.T_base_lidar, settings.verification, SerialExecutor()
        )
        reason = rejection_reasons(tried, evidence, settings.verification)[0]
        if not reason:
            break
    floors = settings.verification.covariance_floor_m, settings.verification.covariance_floor_rad
    constraint = constraints_of(tried, evidence, scans, *floors)
    sigmas = np.full(1, np.nan) if reason else gaussian_sigmas(innovation(linear, constraint, covariance), 3)
    surprise = surprise_reasons(sigmas, settings.verification)[0]
    return Proposal(
        T_target_source=constraint.T_i_j[0],
        information=constraint.information[0],
        record=_record(graph, tried, evidence, constraint, float(sigmas[0])),
        reason=reason,
        surprise=surprise,
    )


def _candidates(graph: PoseGraph, pair: tuple[np.ndarray, np.ndarray], settings: LoopClosureSettings) -> Candidates:
    steps = np.linalg.norm(np.diff(graph.poses[pair[0][0] : pair[1][0] + 1, :2, 2], axis=0), axis=1)
    return make_candidates(*pair, ConstraintKind.MANUAL, np.array([steps.sum()]), settings.proposals)


def _wide(candidates: Candidates, graph: PoseGraph, settings: LoopClosureSettings) -> tuple[Candidates, FloatArray]:
    """Return the candidate with its widest window, and the poses to search around."""
    target, source = int(candidates.target[0]), int(candidates.source[0])
    most, view = settings.proposals.drift_max_m, settings.proposals.view_distance_m
    poses = np.array(graph.poses)
    distance = float(np.linalg.norm(poses[source, :2, 2] - poses[target, :2, 2]))
    if distance + view > most:
        poses[source, :2, 2] = poses[target, :2, 2]
        distance = 0.0
    wide = Candidates(
        target=candidates.target,
        source=candidates.source,
        kind=candidates.kind,
        travel_m=candidates.travel_m,
        reach_m=np.array([min(distance + view, most)]),
        reach_rad=np.array([settings.proposals.drift_max_rad]),
    )
    return wide, poses


def _record(
    graph: PoseGraph, candidates: Candidates, evidence: Evidence, constraint: Constraints, sigmas: float
) -> LoopRecord:
    target, source = int(candidates.target[0]), int(candidates.source[0])
    guess = SE2.between(graph.poses[[target]], graph.poses[[source]])
    error = xyt_from_pose(SE2.between(guess, constraint.T_i_j))[0]
    return LoopRecord(
        round=0,
        target=target,
        source=source,
        kind=ConstraintKind.MANUAL.name.lower(),
        travel_m=float(candidates.travel_m[0]),
        reach_m=float(candidates.reach_m[0]),
        score=float(evidence.score[0]),
        matched_fraction=float(evidence.matched_fraction[0]),
        agreement=float(evidence.agreement[0]),
        overlap=float(evidence.overlap[0]),
        rmse_m=float(evidence.rmse_m[0]),
        error_before_m=float(np.hypot(error[0], error[1])),
        error_before_rad=float(abs(error[2])),
        sigmas_before=sigmas,
        sigmas_after=float("nan"),
        accepted=True,
        reason="",
    )
