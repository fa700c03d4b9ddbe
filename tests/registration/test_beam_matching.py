"""Point-to-line matching of scans against brute force and known motions."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.simulation import drive, tiny_settings
from posegraph_slam.geometry import SE2, planar_from_spatial, pose_from_xyt, xyt_from_pose
from posegraph_slam.registration.beam_matching import BeamMatchSettings, accumulate, between, compose, match_scan
from posegraph_slam.registration.beam_matching import visibility as count_visible
from posegraph_slam.registration.beam_scans import BeamScans, BeamScanSettings, prepare_beam_scans

FREE = np.eye(3) * 1e-6


@pytest.fixture(scope="module")
def scene() -> tuple[BeamScans, FloatArray]:
    """Scans of a simulated drive with the true lidar poses (N, 3, 3)."""
    log = drive(tiny_settings())
    assert log.scans is not None
    assert log.truth is not None
    scans = prepare_beam_scans(log.scans, BeamScanSettings())
    return scans, planar_from_spatial(log.truth.poses) @ scans.T_base_lidar


def match(scans: BeamScans, source: int, refs: list[int], ref_poses: FloatArray, start: FloatArray):  # type: ignore[no-untyped-def]
    return match_scan(
        source, np.array(refs), ref_poses, start, FREE, BeamMatchSettings().vector(),
        scans.points, scans.lines, scans.kind, scans.thinned, scans.geometry,
    )  # fmt: skip


def brute_force(scans: BeamScans, source: int, ref: int, pose: FloatArray, gate: float, robust: float):  # type: ignore[no-untyped-def]
    """The same sums with all distances and numpy."""
    points, lines, kind = scans.points.astype(np.float64), scans.lines.astype(np.float64), scans.kind
    R = pose_from_xyt(pose)
    chosen = np.flatnonzero(scans.thinned[source])
    p = points[source, chosen]
    q = p @ R[:2, :2].T + R[:2, 2]
    returns = np.flatnonzero(kind[ref])
    distance = np.linalg.norm(q[:, None] - points[ref, returns][None], axis=2)
    nearest = returns[distance.argmin(axis=1)]
    normal_source = lines[source, chosen, :2] @ R[:2, :2].T
    n = lines[ref, nearest, :2]
    ok = (distance.min(axis=1) < gate) & (kind[ref, nearest] == 2)
    ok &= (kind[source, chosen] != 2) | (np.sum(n * normal_source, axis=1) >= 0.5)
    e = np.sum(n * q, axis=1) - lines[ref, nearest, 2]
    w = (robust**2 / (robust**2 + e**2)) ** 2
    m = n @ R[:2, :2]
    J = np.column_stack([m, m[:, 1] * p[:, 0] - m[:, 0] * p[:, 1]])[ok]
    return (J * w[ok, None]).T @ J, J.T @ (w * e)[ok], int(ok.sum())


@pytest.mark.parametrize("offset", [[0.0, 0.0, 0.0], [0.1, -0.05, 0.03], [-0.3, 0.2, 0.4], [0.0, 0.0, 2.5]])
def test_sums_agree_with_brute_force(scene: tuple[BeamScans, FloatArray], offset: list[float]) -> None:
    scans, poses = scene
    relative = xyt_from_pose(SE2.between(poses[20], poses[24]) @ pose_from_xyt(np.array(offset)))
    H, g = np.zeros((3, 3)), np.zeros(3)
    seen, matched, _, _ = accumulate(
        24, 20, relative, 0.4, 0.1, 0.5, scans.points, scans.lines, scans.kind, scans.thinned, scans.geometry, H, g
    )
    H_slow, g_slow, matched_slow = brute_force(scans, 24, 20, relative, 0.4, 0.1)
    assert matched == matched_slow
    assert seen >= 0
    np.testing.assert_allclose(np.triu(H), np.triu(H_slow), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(g, g_slow, rtol=1e-6, atol=1e-6)


def test_known_motion_is_recovered_from_perturbed_starts(scene: tuple[BeamScans, FloatArray]) -> None:
    scans, poses = scene
    rng = np.random.default_rng(3)
    for source in range(8, 56, 6):
        refs = [source - 6, source - 4, source - 2]
        ref_poses = xyt_from_pose(SE2.between(poses[[refs[0]] * 3], poses[refs]))
        truth = xyt_from_pose(SE2.between(poses[refs[0]], poses[source]))
        start = compose(truth, rng.uniform(-1, 1, 3) * [0.15, 0.15, 0.08])
        found, hessian, stats = match(scans, source, refs, ref_poses, start)
        error = between(truth, found)
        assert np.hypot(error[0], error[1]) < 0.02
        assert abs(error[2]) < 0.005
        assert np.linalg.eigvalsh(hessian).min() > 0
        assert stats[1] > 0.5 * stats[0]


def test_inverse_is_consistent_and_the_result_is_deterministic(scene: tuple[BeamScans, FloatArray]) -> None:
    scans, poses = scene
    origin = np.zeros((1, 3))
    forward = xyt_from_pose(SE2.between(poses[30], poses[33]))
    there, _, _ = match(scans, 33, [30], origin, forward)
    back, _, _ = match(scans, 30, [33], origin, between(forward, np.zeros(3)))
    loop = compose(there, back)
    assert np.hypot(loop[0], loop[1]) < 0.02
    again, _, _ = match(scans, 33, [30], origin, forward)
    assert there.tobytes() == again.tobytes()


def test_moving_everything_moves_the_result(scene: tuple[BeamScans, FloatArray]) -> None:
    scans, poses = scene
    shift = np.array([100.0, -40.0, 1.2])
    start = xyt_from_pose(SE2.between(poses[30], poses[33]))
    plain, _, _ = match(scans, 33, [30], np.zeros((1, 3)), start)
    moved, _, _ = match(scans, 33, [30], shift[None], compose(shift, start))
    np.testing.assert_allclose(between(shift, moved), plain, atol=1e-9)


def test_without_overlap_nothing_matches_and_the_start_stays(scene: tuple[BeamScans, FloatArray]) -> None:
    scans, _ = scene
    start = np.array([500.0, 0.0, 0.0])
    found, hessian, stats = match(scans, 33, [30], np.zeros((1, 3)), start)
    assert stats[1] == 0
    assert not hessian.any()
    np.testing.assert_allclose(found, start, atol=1e-9)


def test_free_space_tells_a_true_pose_from_a_false_one(scene: tuple[BeamScans, FloatArray]) -> None:
    scans, poses = scene
    truth = xyt_from_pose(SE2.between(poses[30], poses[33]))
    arrays = (scans.points, scans.kind, scans.thinned, scans.geometry)
    agree, conflict, hidden = count_visible(33, 30, truth, 0.15, *arrays)
    assert agree > 10 * max(conflict, 1)
    assert agree + conflict + hidden == scans.thinned[33].sum()
    agree, conflict, _ = count_visible(33, 30, compose(truth, np.array([0.0, 1.0, 1.0])), 0.15, *arrays)
    assert conflict > 0.3 * agree
