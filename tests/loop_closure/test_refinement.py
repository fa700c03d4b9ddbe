"""Matching overlapping keyframes again."""

from __future__ import annotations

import numpy as np

from posegraph_slam.geometry import SE2, wrap_angle, xyt_from_pose
from posegraph_slam.loop_closure.refinement import RECENT, RefinementSettings, overlapping_pairs, refine_overlaps
from posegraph_slam.loop_closure.settings import VerificationSettings
from posegraph_slam.pipeline.executors import ThreadExecutor
from posegraph_slam.pose_graph.graph import ConstraintKind
from posegraph_slam.pose_graph.solver_settings import SolverSettings

from .conftest import Laps


def shaken(laps: Laps, sigma: float) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, [sigma, sigma, sigma / 5], (len(laps.truth), 3))
    noise[0] = 0
    return SE2.retract(laps.truth, noise)


def test_shaken_keyframes_are_put_right(laps: Laps) -> None:
    graph = laps.graph.with_poses(shaken(laps, 0.03))
    refined = refine_overlaps(graph, laps.scans, RefinementSettings(), VerificationSettings(), SolverSettings())
    assert laps.error_m(refined.poses) < 0.5 * laps.error_m(graph.poses)
    assert laps.error_m(refined.poses) < 0.05
    added = refined.constraints.kind == int(ConstraintKind.OVERLAP)
    assert added.sum() > 2 * len(refined)
    wrong = SE2.local(
        SE2.between(laps.truth[refined.constraints.i[added]], laps.truth[refined.constraints.j[added]]),
        refined.constraints.T_i_j[added],
    )
    assert np.hypot(wrong[:, 0], wrong[:, 1]).max() < 0.25


def test_pairs_are_near_alike_older_first_and_few(laps: Laps) -> None:
    settings = RefinementSettings(neighbours=4, revisits=3)
    pairs = overlapping_pairs(laps.graph.with_poses(laps.truth), settings)
    assert (pairs.target < pairs.source).all()
    xyt = xyt_from_pose(laps.truth)
    apart = np.linalg.norm(xyt[pairs.target, :2] - xyt[pairs.source, :2], axis=1)
    assert apart.max() <= settings.distance_max_m
    assert np.abs(wrap_angle(xyt[pairs.target, 2] - xyt[pairs.source, 2])).max() <= settings.turn_max_rad
    recent = pairs.source - pairs.target < RECENT
    assert np.bincount(pairs.source[recent]).max() <= 4
    assert np.bincount(pairs.source[~recent]).max() <= 3
    assert (~recent).any()


def test_no_rounds_change_nothing_and_workers_do_not_matter(laps: Laps) -> None:
    none = RefinementSettings(rounds=0)
    same = refine_overlaps(laps.graph, laps.scans, none, VerificationSettings(), SolverSettings())
    assert same.poses.tobytes() == laps.graph.poses.tobytes()
    arguments = (laps.graph, laps.scans, RefinementSettings(), VerificationSettings(), SolverSettings())
    one = refine_overlaps(*arguments)
    with ThreadExecutor(2) as executor:
        two = refine_overlaps(*arguments, executor=executor)
    assert one.poses.tobytes() == two.poses.tobytes()
