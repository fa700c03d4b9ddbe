"""Accepting or rejecting registered candidates, each rejection with its reason."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtrc, chdtri

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.geometry import SE2, SE3
from posegraph_slam.loop_closure.matching import Evidence
from posegraph_slam.loop_closure.proposals import Candidates
from posegraph_slam.loop_closure.settings import VerificationSettings

NEIGHBOURHOOD_M = 15.0
"""Candidates whose ends lie within this travel of each other are compared for consistency."""
RAREST = 1e-300
"""Tail probabilities below this would make sigmas infinite."""

Apart = Callable[[IntArray, IntArray, FloatArray], BoolArray]
"""Tells which pairs of keyframes i and j (M,), `distance_m` (M,) apart in the plan view, cannot be one place."""


def apart_reasons(candidates: Candidates, poses: FloatArray, apart: Apart | None) -> list[str]:
    """Say for each candidate (M,) that its ends at `poses` (K, 3, 3) are known to be apart, or the empty string."""
    if apart is None:
        return [""] * len(candidates)
    step = poses[candidates.source, :2, 2] - poses[candidates.target, :2, 2]
    flags = apart(candidates.target, candidates.source, np.linalg.norm(step, axis=1))
    return ["on another level" if flag else "" for flag in flags.tolist()]


def rejection_reasons(candidates: Candidates, evidence: Evidence, settings: VerificationSettings) -> list[str]:
    """Say for each candidate (M,) why its registration cannot be trusted, or the empty string."""
    tests = (
        (evidence.score < settings.score_min, "no pose in the window fits", evidence.score),
        (evidence.overlap < settings.overlap_min, "too little overlap: {:.2f}", evidence.overlap),
        (evidence.agreement < settings.agreement_min, "walls in free space: agreement {:.2f}", evidence.agreement),
        (
            evidence.matched_fraction < settings.matched_fraction_min,
            "too few points match: {:.2f}",
            evidence.matched_fraction,
        ),
        (evidence.blind, "overlaps only far from the guess, where nothing could be seen", evidence.score),
        (evidence.ambiguous, "another pose in the window fits nearly as well", evidence.score),
        (evidence.rmse_m > settings.rmse_max_m, "residual too large: {:.3f} m", evidence.rmse_m),
    )
    reasons = [""] * len(candidates)
    for failed, text, values in reversed(tests):
        for m in np.flatnonzero(failed):
            reasons[m] = text.format(values[m])
    return reasons


def count_support(
    candidates: Candidates,
    T_target_source: FloatArray,
    poses: FloatArray,
    path_m: FloatArray,
    eligible: BoolArray,
    settings: VerificationSettings,
) -> tuple[IntArray, IntArray]:
    """Count for each candidate (M,) the eligible ones nearby that agree, and those that disagree, with it.

    Two closures and the estimated paths between their ends form a loop, which closes when both are right (pairwise
    consistency, Mangelson et al. 2018). `poses` (K, d+1, d+1) in the same frame as the closures, `path_m` (K,).
    """
    agree, disagree = np.zeros(len(candidates), dtype=np.int64), np.zeros(len(candidates), dtype=np.int64)
    rows = np.flatnonzero(eligible)
    if len(rows) < 2:
        return agree, disagree
    ends = np.stack([path_m[candidates.target[rows]], path_m[candidates.source[rows]]], axis=1)
    pairs = cKDTree(ends).query_pairs(NEIGHBOURHOOD_M, p=np.inf, output_type="ndarray")
    a, b = rows[pairs[:, 0]], rows[pairs[:, 1]]
    # neighbours that share an end, or nearly, see the same surfaces: they err together and prove nothing
    apart = np.abs(path_m[candidates.source[a]] - path_m[candidates.source[b]]) > 0.5
    a, b = a[apart], b[apart]
    group = SE2 if poses.shape[-1] == 3 else SE3
    across_a = group.between(poses[candidates.target[a]], poses[candidates.target[b]])
    back_b = group.between(poses[candidates.source[b]], poses[candidates.source[a]])
    around = group.inverse(T_target_source[a]) @ across_a @ T_target_source[b] @ back_b
    error = group.log(around)
    length = np.abs(path_m[candidates.target[a]] - path_m[candidates.target[b]]) + np.abs(
        path_m[candidates.source[a]] - path_m[candidates.source[b]]
    )
    shift = np.linalg.norm(group.translation_part(error), axis=1)
    turn = np.linalg.norm(group.rotation_part(error), axis=1)
    closes = (shift < settings.consistency_m * (1 + 0.1 * length)) & (turn < settings.consistency_rad)
    np.add.at(agree, np.concatenate([a[closes], b[closes]]), 1)
    np.add.at(disagree, np.concatenate([a[~closes], b[~closes]]), 1)
    return agree, disagree


def consistency_reasons(
    candidates: Candidates, agree: IntArray, disagree: IntArray, settings: VerificationSettings
) -> list[str]:
    """Say for each candidate (M,) why the others speak against it, or the empty string."""
    reasons = [""] * len(candidates)
    wide = candidates.reach_m > settings.trusted_drift_m
    for m in np.flatnonzero(wide & (agree < settings.support_min)):
        reasons[m] = f"found in a wide window and supported by {agree[m]} others"
    for m in np.flatnonzero(disagree > agree):
        reasons[m] = f"{disagree[m]} nearby candidates disagree, {agree[m]} agree"
    return reasons


def surprise_reasons(sigmas: FloatArray, settings: VerificationSettings) -> list[str]:
    """Say for each candidate (M,) that it disagrees too much with the graph as it is, or the empty string."""
    return [
        f"would move the graph by {value:.1f} sigma" if value > settings.sigma_max else "" for value in sigmas.tolist()
    ]


def passing(reasons: list[str]) -> BoolArray:
    """Which candidates (M,) have no reason against them."""
    return np.array([not reason for reason in reasons], dtype=np.bool_)


def first_reasons(earlier: list[str], later: list[str]) -> list[str]:
    """Join two lists of reasons: the earlier one where there is one."""
    return [first or second for first, second in zip(earlier, later, strict=True)]


def gaussian_sigmas(chi2: FloatArray, dof: int) -> FloatArray:
    """Turn chi-squares (M,) of `dof` dimensions into the sigmas at which a Gaussian is as rare."""
    return np.asarray(np.sqrt(chdtri(1, np.maximum(chdtrc(dof, chi2), RAREST))))


def chi2_gate(sigma: float, dof: int) -> float:
    """Return the chi-square that a right constraint of `dof` dimensions exceeds as rarely as a Gaussian `sigma`s."""
    return float(chdtri(dof, chdtrc(1, sigma**2)))
