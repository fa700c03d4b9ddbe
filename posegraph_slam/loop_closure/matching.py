"""Registering candidates: search of the window, point-to-line refinement, and the evidence for and against."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.execution import Executor, split_range
from posegraph_slam.geometry import SE2, pose_from_xyt, xyt_from_pose
from posegraph_slam.jit import kernel
from posegraph_slam.loop_closure.proposals import Candidates
from posegraph_slam.loop_closure.settings import VerificationSettings
from posegraph_slam.pose_graph.graph import Constraints
from posegraph_slam.registration.beam_information import information_in_base, information_with_floor
from posegraph_slam.registration.beam_matching import between, match_scan, visibility
from posegraph_slam.registration.beam_scans import BeamScans
from posegraph_slam.registration.local_search import search_pose

CHUNK = 32
"""Candidates in one unit of work."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """What registration found for each candidate (M,): T_target_source of the lidar, Hessian and measures of fit.

    `score` of the search (1 where none was needed), `matched_fraction` of the points in view, `agreement` with the
    free space of both scans (the lesser of the two), `overlap` and weighted `rmse_m`.
    """

    T_target_source: FloatArray
    hessian: FloatArray
    score: FloatArray
    matched_fraction: FloatArray
    agreement: FloatArray
    overlap: FloatArray
    rmse_m: FloatArray
    ambiguous: BoolArray
    """Whether another pose of the window fits nearly as well."""
    blind: BoolArray
    """Whether the pose lies far from a guess at which the two scans would see nothing of each other."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Work:
    """Arrays of one unit of work, small enough to be sent to another process."""

    target: IntArray
    source: IntArray
    reach: FloatArray
    poses: FloatArray
    scans: BeamScans


def register_candidates(
    candidates: Candidates, scans: BeamScans, poses: FloatArray, settings: VerificationSettings, executor: Executor
) -> Evidence:
    """Match the source of each candidate to the scans around its target, from the current lidar `poses` (K, 3, 3)."""
    xyt = xyt_from_pose(poses)
    reach = np.stack([candidates.reach_m, candidates.reach_rad], axis=1)
    work = [
        _Work(target=candidates.target[a:b], source=candidates.source[a:b], reach=reach[a:b], poses=xyt, scans=scans)
        for a, b in split_range(len(candidates), CHUNK)
    ]
    parts = executor.map(partial(_register_chunk, settings=settings), work)
    if not parts:
        parts = [(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 7)))]
    pose, hessian, measures = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return Evidence(
        T_target_source=pose_from_xyt(pose),
        hessian=hessian,
        score=measures[:, 0],
        matched_fraction=measures[:, 1],
        agreement=measures[:, 2],
        overlap=measures[:, 3],
        rmse_m=measures[:, 4],
        ambiguous=measures[:, 5] > 0,
        blind=measures[:, 6] > 0,
    )


def _register_chunk(work: _Work, settings: VerificationSettings) -> tuple[FloatArray, FloatArray, FloatArray]:
    scans = work.scans
    pose, hessian, measures = register_many(
        work.target,
        work.source,
        work.reach,
        work.poses,
        settings.references,
        settings.score_min,
        settings.free_space_margin_m,
        settings.search.vector(),
        settings.match.vector(),
        scans.points,
        scans.lines,
        scans.kind,
        scans.thinned,
        scans.geometry,
    )
    return pose, hessian, measures


def constraints_of(
    candidates: Candidates, evidence: Evidence, scans: BeamScans, floor_m: float, floor_rad: float
) -> Constraints:
    """Turn candidates into constraints between base poses, with a floor on their covariance."""
    information = information_with_floor(evidence.hessian, floor_m, floor_rad)
    return Constraints(
        i=candidates.target,
        j=candidates.source,
        T_i_j=scans.T_base_lidar @ evidence.T_target_source @ SE2.inverse(scans.T_base_lidar),
        information=information_in_base(information, scans.T_base_lidar),
        kind=candidates.kind,
    )


BLIND_BEYOND_M, BLIND_SHARE = 1.0, 0.15
"""A pose further than this from the guess is no evidence where at the guess less than this share could be seen: two
scans that look away from each other fit nowhere but where, by mistake, they overlap."""
SEARCH_BEYOND_M = 0.25
"""A guess at least this good is refined without a search."""


@kernel
def register_many(  # type: ignore[no-untyped-def]
    targets, sources, reach, poses, around, score_min, margin, search, matching, points, lines, kind, thinned, geometry
):
    """Register sources[m] to the keyframes targets[m] - around .. targets[m] + around for every m.

    Returns lidar poses (M, 3) in the frame of the target, Hessians (M, 3, 3), and score, matched fraction, agreement,
    overlap, rmse, whether a rival was found, and whether the guess was blind (M, 7).
    """
    count = len(targets)
    found, hessians, measures = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 7))
    prior = np.eye(3) * 1e-3
    for m in range(count):
        target, source = targets[m], sources[m]
        first = max(0, target - around)
        last = min(len(poses), target + around + 1)
        if first <= source < last:
            last = source
        refs = np.arange(first, last)
        ref_poses = np.zeros((len(refs), 3))
        for r in range(len(refs)):
            ref_poses[r] = between(poses[target], poses[refs[r]])
        pose, score, rival = between(poses[target], poses[source]), 1.0, False
        if reach[m, 0] > SEARCH_BEYOND_M:
            pose, score, rival = search_pose(
                source, refs, ref_poses, pose, reach[m, 0], reach[m, 1], score_min, search, points, kind, thinned
            )
            if score == 0.0:
                continue
        moved = between(between(poses[target], poses[source]), pose)
        if np.hypot(moved[0], moved[1]) > BLIND_BEYOND_M:
            at_guess = between(poses[target], poses[source])
            agree, conflict, total = 0, 0, 0
            for r in range(len(refs)):
                relative = between(ref_poses[r], at_guess)
                a, c, h = visibility(source, refs[r], relative, margin, points, kind, thinned, geometry)
                agree, conflict, total = agree + a, conflict + c, total + a + c + h
            measures[m, 6] = agree + conflict < BLIND_SHARE * total
        pose, hessian, stats = match_scan(
            source, refs, ref_poses, pose, prior, matching, points, lines, kind, thinned, geometry
        )
        agree, conflict, back_agree, back_conflict, hidden = 0, 0, 0, 0, 0
        for r in range(len(refs)):
            relative = between(ref_poses[r], pose)
            a, c, h = visibility(source, refs[r], relative, margin, points, kind, thinned, geometry)
            agree, conflict, hidden = agree + a, conflict + c, hidden + h
            back = between(relative, np.zeros(3))
            a, c, h = visibility(refs[r], source, back, margin, points, kind, thinned, geometry)
            back_agree, back_conflict = back_agree + a, back_conflict + c
        found[m], hessians[m] = pose, hessian / len(refs)
        measures[m, 0] = score
        measures[m, 1] = stats[1] / max(stats[0], 1.0)
        measures[m, 2] = min(agree / max(agree + conflict, 1), back_agree / max(back_agree + back_conflict, 1))
        measures[m, 3] = agree / max(agree + conflict + hidden, 1)
        measures[m, 4] = stats[3]
        measures[m, 5] = rival
    return found, hessians, measures
