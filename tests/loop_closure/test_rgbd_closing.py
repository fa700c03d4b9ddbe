"""Loop closure of an RGB-D camera: proposals, verification and what the graph becomes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.simulation.rgbd_room import (
    furnished_room,
    loop_through_room,
    noisy_depth,
    render_rgbd,
    small_camera,
)
from posegraph_slam.execution import SerialExecutor
from posegraph_slam.geometry import SE3
from posegraph_slam.loop_closure.appearance import appearance_similarity, nearest_word
from posegraph_slam.loop_closure.rgbd_closing import RgbdLoopRecord, RgbdLoopSettings, close_rgbd_loops
from posegraph_slam.loop_closure.rgbd_views import KeyframeViews, RgbdProposalSettings, propose_overlapping
from posegraph_slam.pose_graph.graph import ConstraintKind, PoseGraph
from posegraph_slam.pose_graph.noise import information_isotropic
from posegraph_slam.pose_graph.robust import RobustLoss, RobustSettings
from posegraph_slam.pose_graph.solver_settings import SolverSettings
from posegraph_slam.registration.rgbd_frame import RgbdFrame, prepare_frame

CAMERA = small_camera(240, 180)
POSES = loop_through_room(25, turns=1.1)
"""One round and a bit: the last keyframes see what the first ones saw."""
SOLVER = SolverSettings(robust=RobustSettings(loss=RobustLoss.HUBER))


def frame(k: int) -> RgbdFrame:
    colour, depth = render_rgbd(furnished_room(seed=3), CAMERA, POSES[k])
    units = noisy_depth(depth, CAMERA.depth_units_per_m, np.random.default_rng(k))
    return prepare_frame(colour, units, CAMERA.vector(), depth_units_per_m=5000, max_depth_m=10)


@pytest.fixture(scope="module")
def views() -> KeyframeViews:
    return KeyframeViews(frame, np.arange(len(POSES)), SerialExecutor())


def drifting_chain(step: FloatArray, *, sigma_m: float = 0.02, sigma_rad: float = 0.01) -> PoseGraph:
    """Return the chain of true motions, each with the same error `step` (6,)."""
    motions = SE3.between(POSES[:-1], POSES[1:]) @ SE3.exp(step)
    poses = [np.eye(4)]
    for T in motions:
        poses.append(poses[-1] @ T)
    count = len(poses)
    information = information_isotropic(SE3, sigma_translation_m=sigma_m, sigma_rotation_rad=sigma_rad)
    return PoseGraph.chain(
        np.stack(poses),
        np.arange(count),
        T_i_j=motions,
        information=np.tile(information, (count - 1, 1, 1)),
        kind=int(ConstraintKind.SCAN_MATCHING),
    )


def worst(poses: FloatArray) -> float:
    relative = SE3.local(SE3.between(POSES[:1], POSES), SE3.between(poses[:1], poses))
    return float(np.linalg.norm(relative[:, 3:], axis=1).max())


def test_parts_whose_motion_is_a_guess_are_joined_where_they_see_the_same(views: KeyframeViews) -> None:
    chain = drifting_chain(np.zeros(6))
    lost = 14
    T, information = chain.constraints.T_i_j.copy(), chain.constraints.information.copy()
    T[lost], information[lost] = np.eye(4), np.eye(6)
    poses = [np.eye(4)]
    for step in T:
        poses.append(poses[-1] @ step)
    constraints = replace(chain.constraints, T_i_j=T, information=information)
    chain = chain.with_constraints(constraints).with_poses(np.stack(poses))
    assert worst(chain.poses) > 0.1
    result = close_rgbd_loops(chain, views, RgbdLoopSettings(), SOLVER)
    within = [r for r in result.records if r.accepted and (r.source <= lost or r.target > lost)]
    assert within, "closures within a part, whose loops with those across would lead over the guess"
    assert any(r.accepted for r in result.records if r.target <= lost < r.source)
    assert worst(result.graph.poses) < 0.05


def test_closing_the_round_takes_out_the_drift(views: KeyframeViews) -> None:
    chain = drifting_chain(np.array([0, 0.004, 0, 0.004, 0, 0]))
    assert worst(chain.poses) > 0.05
    proposals = RgbdProposalSettings(targets_max=1, rounds_max=2)
    result = close_rgbd_loops(chain, views, RgbdLoopSettings(proposals=proposals), SOLVER)
    assert worst(result.graph.poses) < 0.03
    across = [r for r in result.records if r.accepted and r.source - r.target > 15]
    assert across, "the end of the round is tied to its beginning"
    for record in result.records:
        assert isinstance(record, RgbdLoopRecord)
        assert record.accepted == (not record.reason)
    accepted = result.graph.constraints.select(result.graph.constraints.is_loop)
    error = SE3.local(SE3.between(POSES[accepted.i], POSES[accepted.j]), accepted.T_i_j)
    assert np.linalg.norm(error[:, 3:], axis=1).max() < 0.03, "no accepted closure is wrong"


def test_appearance_finds_a_place_that_the_estimate_has_elsewhere(views: KeyframeViews) -> None:
    """The chain believes to be two metres off at the end: views do not overlap by it."""
    chain = drifting_chain(np.array([0, 0, 0, 0.08, 0, 0]), sigma_m=0.2, sigma_rad=0.05)
    assert worst(chain.poses) > 0.5
    proposals = RgbdProposalSettings(proximity=False, targets_max=1)
    result = close_rgbd_loops(chain, views, RgbdLoopSettings(proposals=proposals), SOLVER)
    across = [r for r in result.records if r.accepted and r.source - r.target > 15]
    assert across
    assert all(r.kind == "global" and r.feature_inliers >= 20 for r in across)
    ends = SE3.between(result.graph.poses[0], result.graph.poses[-1])
    assert np.linalg.norm(SE3.local(SE3.between(POSES[0], POSES[-1]), ends)[3:]) < 0.2


def test_overlap_follows_the_poses(views: KeyframeViews) -> None:
    settings = RgbdProposalSettings(overlap_min=0.3)
    pairs, overlap = propose_overlapping(POSES, views.views, settings)
    assert len(pairs)
    assert ((pairs[:, 1] - pairs[:, 0]) >= settings.keyframes_apart_min).all()
    assert overlap.min() >= 0.3
    ahead = POSES[:, :3, 2]
    cosine = np.sum(ahead[pairs[:, 0]] * ahead[pairs[:, 1]], axis=1)
    assert cosine.min() > np.cos(np.deg2rad(65)), "cameras that look apart share no view"
    counts = np.bincount(pairs[:, 1])
    assert counts.max() <= settings.targets_max


def test_a_place_resembles_itself_more_than_others(views: KeyframeViews) -> None:
    words = [view.features.words for view in views.views]
    similarity = appearance_similarity(words, 1024, np.random.default_rng(0))
    np.testing.assert_allclose(similarity, similarity.T, atol=1e-12)
    np.testing.assert_allclose(np.diag(similarity), 1)
    opposite = similarity[0, 8:16].max()
    assert similarity[0, -4:].max() > 1.5 * opposite
    empty = appearance_similarity([words[0], words[0][:0]], 16, np.random.default_rng(0))
    assert empty[0, 1] == 0


def test_nearest_word_counts_bits() -> None:
    rng = np.random.default_rng(2)
    a, b = (rng.integers(0, 2**63, (n, 4), dtype=np.uint64) for n in (20, 7))
    bits_a, bits_b = (np.unpackbits(x.view(np.uint8), axis=1) for x in (a, b))
    distance = np.sum(bits_a[:, None] != bits_b[None], axis=2)
    np.testing.assert_array_equal(nearest_word(a, b), distance.argmin(axis=1))
