"""Loop closure of an RGB-D camera: pairs by overlap and by appearance, aligned directly, verified, solved in rounds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress
from posegraph_slam.geometry import SE3
from posegraph_slam.loop_closure.closing import LoopClosureResult, settle
from posegraph_slam.loop_closure.ledger import Ledger, LoopRecord
from posegraph_slam.loop_closure.proposals import Candidates
from posegraph_slam.loop_closure.rgbd_views import (
    KeyframeViews,
    RgbdProposalSettings,
    propose_alike,
    propose_overlapping,
)
from posegraph_slam.loop_closure.settings import VerificationSettings
from posegraph_slam.loop_closure.verification import (
    NEIGHBOURHOOD_M,
    count_support,
    first_reasons,
    gaussian_sigmas,
    passing,
)
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.marginals import factored_marginals
from posegraph_slam.pose_graph.solve import solve
from posegraph_slam.pose_graph.solver_settings import SolverSettings
from posegraph_slam.registration.feature_motion import motion_of_matches
from posegraph_slam.registration.features import match_features
from posegraph_slam.registration.rgbd_alignment import RgbdAlignment, RgbdAlignmentSettings, align_frames
from posegraph_slam.settings import Settings

SUPPORT = VerificationSettings(consistency_m=0.3, consistency_rad=0.1)
"""Two closures support each other when the loop through both closes this well."""
KEYFRAME_M = 0.3
"""Travel counted for a keyframe where support is looked for: closures two keyframes apart are two witnesses."""
STILL_M, STILL_RAD = 0.03, 0.01
"""Rounds end when closures no longer move a keyframe by more than this."""


class RgbdLoopSettings(Settings):
    """Loop closure of an RGB-D camera."""

    proposals: RgbdProposalSettings = RgbdProposalSettings()
    alignment: RgbdAlignmentSettings = RgbdAlignmentSettings(
        overlap_min=0.3, agreement_min=0.85, inlier_fraction_min=0.7, correlation_min=0.5, sigma_max_m=0.1
    )
    """What an aligned pair must show: more than in tracking, where the next frame tells at once that one was wrong."""
    features_min: int = Field(default=20, ge=3)
    """Least number of ORB matches that agree on a motion, where the estimate does not tell it."""
    features_alone: int = Field(default=60, ge=3)
    """So many agreeing matches need no other closure nearby to agree, however unsure the estimate is."""
    trusted_sigma_m: float = Field(default=0.3, gt=0)
    """Where the estimate is less sure than this of the motion, a closure needs support,"""
    trusted_sigma_rad: float = Field(default=0.2, gt=0)
    """or less sure than this of the turn."""
    sigma_max: float = Field(default=4.0, gt=0)
    """A closure that disagrees by more sigmas than this with the graph, before or after solving, is not believed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RgbdLoopRecord(LoopRecord):
    """A candidate of an RGB-D camera: `score` is the overlap or likeness it was proposed by, `rmse_m` point to plane.

    `feature_matches`, of which `feature_inliers` agree on one motion (0 where they were not needed), and the
    `correlation` of intensities after alignment.
    """

    feature_matches: int
    feature_inliers: int
    correlation: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Trial:
    """One candidate: keyframes, how it was found, its score, and the estimate's T_target_source."""

    target: int
    source: int
    kind: ConstraintKind
    score: float
    guess: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Finding:
    """What alignment found of a trial, and why it is not usable, if so."""

    alignment: RgbdAlignment
    matches: int
    inliers: int
    reason: str


def close_rgbd_loops(
    graph: PoseGraph,
    views: KeyframeViews,
    settings: RgbdLoopSettings,
    solver: SolverSettings,
    *,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
) -> LoopClosureResult:
    """Add loop closures to the chain of keyframes `graph` (K nodes, map -> camera) with their `views` (K).

    Each round tries pairs that were not tried before, aligns them, and solves the graph with those that pass; what
    disagrees with the solved graph is taken out again. Rounds end when nothing new is found or nothing moves.
    """
    executor = executor or SerialExecutor()
    chain, ledger = graph.constraints, Ledger()
    closures = Constraints.empty(SE3)
    rounds = settings.proposals.rounds_max
    tried, made = set[tuple[int, int]](), 0
    for round_ in range(rounds):
        progress("loop closure", round_, rounds)
        trials = _propose(graph, views, settings, round_, seed, tried)
        if not trials:
            break
        made = round_ + 1
        findings = executor.map(partial(_align, views=views, settings=settings, seed=seed), trials)
        measured = views.believed(_constraints(trials, findings))
        found = _verify(graph, measured, trials, findings, round_, ledger, settings)
        before = graph.poses
        if len(found):
            closures = Constraints.concatenate([closures, found])
            graph, sigmas, kept = settle(graph, chain, closures, solver, settings.sigma_max)
            ledger.settle(sigmas, kept)
            closures = closures.select(kept)
        moved = SE3.local(before, graph.poses)
        if np.abs(moved[:, 3:]).max() < STILL_M and np.abs(moved[:, :3]).max() < STILL_RAD:
            break  # the views overlap as they did before: the same pairs would be proposed
    graph = graph.with_constraints(Constraints.concatenate([chain, closures]))
    solution = solve(graph, solver)
    progress("loop closure", rounds, rounds)
    return LoopClosureResult(
        graph=graph.with_poses(solution.poses), records=tuple(ledger.records), rounds=made, solution=solution
    )


def _propose(
    graph: PoseGraph, views: KeyframeViews, settings: RgbdLoopSettings, round_: int, seed: int,
    tried: set[tuple[int, int]],
) -> list[_Trial]:  # fmt: skip
    """Pairs not tried before, by overlap in every round and by appearance in the first one."""
    found = list[tuple[IntArray, FloatArray, ConstraintKind]]()
    if settings.proposals.proximity:
        found.append((*propose_overlapping(graph.poses, views.views, settings.proposals), ConstraintKind.PROXIMITY))
    if settings.proposals.appearance and round_ == 0:
        alike = propose_alike(views.views, settings.proposals, np.random.default_rng(seed))
        found.append((*alike, ConstraintKind.GLOBAL))
    trials = list[_Trial]()
    for pairs, scores, kind in found:
        for (i, j), score in zip(pairs.tolist(), scores.tolist(), strict=True):
            if (i, j) not in tried:
                tried.add((i, j))
                guess = SE3.between(graph.poses[i], graph.poses[j])
                trials.append(_Trial(target=i, source=j, kind=kind, score=score, guess=guess))
    return trials


def _align(trial: _Trial, views: KeyframeViews, settings: RgbdLoopSettings, seed: int) -> _Finding:
    """Align a pair from the estimate if that tells the motion, else from the features of both.

    A pair that looks alike is aligned from its features alone: its claim is that the estimate may be wrong.
    """
    target, source = views.reference(trial.target), views.reference(trial.source)
    direct: RgbdAlignment | None = None
    if trial.kind is ConstraintKind.PROXIMITY:
        direct = align_frames(target, source, trial.guess, settings.alignment)
        if direct.usable:
            return _Finding(alignment=direct, matches=0, inliers=0, reason="")
    a, b = views.views[trial.target].features, views.views[trial.source].features
    motion = motion_of_matches(a, b, match_features(a, b), inliers_min=settings.features_min, seed=seed)
    if motion.found:
        found = align_frames(target, source, motion.T_target_source, settings.alignment)
        return _Finding(alignment=found, matches=motion.matches, inliers=motion.inliers, reason=found.problem)
    few = f"too few features agree: {motion.inliers} of {motion.matches}"
    if direct is None:
        direct = align_frames(target, source, trial.guess, settings.alignment)
        return _Finding(alignment=direct, matches=motion.matches, inliers=motion.inliers, reason=few)
    return _Finding(alignment=direct, matches=motion.matches, inliers=motion.inliers, reason=direct.problem or few)


def _constraints(trials: list[_Trial], findings: list[_Finding]) -> Constraints:
    """What alignment found of each trial, usable or not."""
    return Constraints(
        i=np.array([trial.target for trial in trials]),
        j=np.array([trial.source for trial in trials]),
        T_i_j=np.stack([finding.alignment.T_target_source for finding in findings]),
        information=np.stack([finding.alignment.information for finding in findings]),
        kind=np.array([int(trial.kind) for trial in trials]),
    )


def _verify(
    graph: PoseGraph, constraints: Constraints, trials: list[_Trial], findings: list[_Finding], round_: int,
    ledger: Ledger, settings: RgbdLoopSettings,
) -> Constraints:  # fmt: skip
    """Hold findings, `constraints`, against the graph and each other, record all, and return those that pass."""
    reasons = [finding.reason for finding in findings]
    marginals = factored_marginals(graph)
    covariance = marginals.relative(constraints.i, constraints.j)
    first = np.arange(len(graph) - 1)
    broken = _unsure(marginals.relative(first, first + 1), settings)
    predicted = SE3.between(graph.poses[constraints.i], graph.poses[constraints.j])
    error = SE3.local(predicted, constraints.T_i_j)
    total = covariance + np.linalg.inv(constraints.information)
    squared = np.einsum("ep,ep->e", error, np.linalg.solve(total, error[..., None])[..., 0])
    sigmas = np.where(passing(reasons), gaussian_sigmas(squared, SE3.dof), np.nan)
    surprise = [f"would move the graph by {s:.1f} sigma" if s > settings.sigma_max else "" for s in sigmas.tolist()]
    reasons = first_reasons(reasons, surprise)
    reasons = first_reasons(reasons, _support(graph, constraints, findings, covariance, broken, reasons, settings))
    path_m = _path(graph.poses)
    for m, (trial, finding) in enumerate(zip(trials, findings, strict=True)):
        ledger.enter(_record(trial, finding, round_, error[m], float(sigmas[m]), reasons[m], path_m))
    return constraints.select(passing(reasons))


def _support(
    graph: PoseGraph, constraints: Constraints, findings: list[_Finding], covariance: FloatArray, broken: BoolArray,
    reasons: list[str], settings: RgbdLoopSettings,
) -> list[str]:  # fmt: skip
    """Say for each closure that others disagree, or that none agrees where the estimate tells little; or nothing.

    Where the motion from a keyframe to the next is `broken` (K-1,), hardly known, no loop through two closures is
    held to close: those on either side are no neighbours.
    """
    unsure = _unsure(covariance, settings)
    count = len(constraints)
    candidates = Candidates(
        target=constraints.i, source=constraints.j, kind=constraints.kind, travel_m=np.zeros(count),
        reach_m=np.zeros(count), reach_rad=np.zeros(count),
    )  # fmt: skip
    along = np.concatenate([[0.0], np.cumsum(KEYFRAME_M + 2 * NEIGHBOURHOOD_M * broken)])
    agree, disagree = count_support(candidates, constraints.T_i_j, graph.poses, along, passing(reasons), SUPPORT)
    result = [""] * count
    for m in range(count):
        if disagree[m] > agree[m]:
            result[m] = f"{disagree[m]} nearby candidates disagree, {agree[m]} agree"
        elif unsure[m] and agree[m] == 0 and findings[m].inliers < settings.features_alone:
            result[m] = f"the estimate is unsure here, no other closure agrees, and {findings[m].inliers} features do"
    return result


def _unsure(covariance: FloatArray, settings: RgbdLoopSettings) -> BoolArray:
    """Which motions (M,) the estimate hardly knows, by their covariance (M, 6, 6)."""
    sigma_rad = np.sqrt(np.linalg.eigvalsh(covariance[:, :3, :3])[:, -1])
    sigma_m = np.sqrt(np.linalg.eigvalsh(covariance[:, 3:, 3:])[:, -1])
    return np.asarray((sigma_m > settings.trusted_sigma_m) | (sigma_rad > settings.trusted_sigma_rad))


def _path(poses: FloatArray) -> FloatArray:
    """Travel (K,) of the camera at each keyframe."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _record(
    trial: _Trial, finding: _Finding, round_: int, error: FloatArray, sigmas: float, reason: str, path_m: FloatArray
) -> RgbdLoopRecord:
    found = finding.alignment
    return RgbdLoopRecord(
        round=round_,
        target=trial.target,
        source=trial.source,
        kind=trial.kind.name.lower(),
        travel_m=float(path_m[trial.source] - path_m[trial.target]),
        reach_m=float("nan"),
        score=trial.score,
        matched_fraction=found.inlier_fraction,
        agreement=found.agreement,
        overlap=found.overlap,
        rmse_m=found.rmse_m,
        error_before_m=float(np.linalg.norm(error[3:])),
        error_before_rad=float(np.linalg.norm(error[:3])),
        sigmas_before=sigmas,
        sigmas_after=float("nan"),
        accepted=not reason,
        reason=reason,
        feature_matches=finding.matches,
        feature_inliers=finding.inliers,
        correlation=found.correlation,
    )
