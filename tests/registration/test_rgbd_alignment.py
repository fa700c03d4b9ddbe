"""Direct alignment of RGB-D frames, and the motion of their features, on rendered views with known poses."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.simulation.rgbd_room import (
    bent_depth,
    furnished_room,
    loop_through_room,
    noisy_depth,
    render_rgbd,
    small_camera,
)
from posegraph_slam.geometry import SE3
from posegraph_slam.registration.feature_motion import motion_of_matches
from posegraph_slam.registration.features import detect_features, match_features
from posegraph_slam.registration.result import RegistrationStatus
from posegraph_slam.registration.rgbd_alignment import RgbdAlignmentSettings, align_frames
from posegraph_slam.registration.rgbd_frame import RgbdFrame, prepare_frame, prepare_reference
from posegraph_slam.registration.rgbd_kernels import align_level, left_update, linearise
from posegraph_slam.registration.rgbd_warp import Side, view_shift, warp

CAMERA = small_camera(160, 120)
LARGE = small_camera(320, 240)
SETTINGS = RgbdAlignmentSettings()
POSES = loop_through_room(120)


def view(
    T: FloatArray, *, noise: float = 0.0, seed: int = 0, gain: float = 1.0, camera=CAMERA, bend: float = 0.0
) -> RgbdFrame:
    """A view of the room whose inverse depth errs by up to `bend` (1/m), from the left border to the right one."""
    rng = np.random.default_rng(seed)
    colour, depth = render_rgbd(furnished_room(seed=3), camera, T)
    if noise > 0:
        colour = np.clip(np.rint(colour + 2 * rng.standard_normal(colour.shape)), 0, 255).astype(np.uint8)
    colour = np.clip(np.rint(gain * colour.astype(float)), 0, 255).astype(np.uint8)
    units = noisy_depth(bent_depth(depth, bend), camera.depth_units_per_m, rng, noise=noise)
    return prepare_frame(colour, units, camera.vector(), depth_units_per_m=camera.depth_units_per_m, max_depth_m=10.0)


def error(T: FloatArray, truth: FloatArray) -> tuple[float, float]:
    tangent = SE3.local(truth, T)
    return float(np.linalg.norm(tangent[3:])), float(np.rad2deg(np.linalg.norm(tangent[:3])))


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.parametrize("both", [False, True])
def test_finds_the_motion_between_near_frames(step: int, both: bool) -> None:
    target, source = prepare_reference(view(POSES[10])), view(POSES[10 + step])
    truth = SE3.between(POSES[10], POSES[10 + step])
    found = align_frames(target, prepare_reference(source) if both else source, np.eye(4), SETTINGS)
    assert found.status is RegistrationStatus.CONVERGED
    shift, turn = error(found.T_target_source, truth)
    assert shift < 0.002
    assert turn < 0.05
    assert found.overlap > 0.6
    assert found.agreement > 0.97
    assert found.correlation > 0.9


def test_a_change_of_exposure_does_not_move_it() -> None:
    target, truth = prepare_reference(view(POSES[20])), SE3.between(POSES[20], POSES[21])
    found = align_frames(target, view(POSES[21], gain=0.9), np.eye(4), SETTINGS)
    assert found.usable
    assert error(found.T_target_source, truth)[0] < 0.004


@pytest.mark.parametrize("inverse_depth_sigma", [0.0, 0.002])
def test_stated_uncertainty_covers_the_errors_of_noisy_frames(inverse_depth_sigma: float) -> None:
    # without the floors for what a simulation does not have: errors of calibration and of exposure
    none = {"sigma_share": 0.0, "sigma_floor_m": 1e-6, "sigma_floor_rad": 1e-6}
    settings = SETTINGS.model_copy(update=none | {"inverse_depth_sigma": inverse_depth_sigma})
    squared = []
    for k in range(0, 80, 8):
        target, source = view(POSES[k], noise=1, seed=k), view(POSES[k + 1], noise=1, seed=100 + k)
        found = align_frames(prepare_reference(target), prepare_reference(source), np.eye(4), settings)
        assert found.usable
        assert error(found.T_target_source, SE3.between(POSES[k], POSES[k + 1]))[0] < 0.006
        tangent = SE3.local(found.T_target_source, SE3.between(POSES[k], POSES[k + 1]))
        squared.append(tangent @ found.information @ tangent)
        np.testing.assert_allclose(found.information, found.information.T)
        assert np.linalg.eigvalsh(found.information)[0] > 0
    # six degrees of freedom; neither boasting by more than a factor of two in sigma nor saying nothing
    assert 0.5 < np.mean(squared) < 24


def test_swapping_the_frames_inverts_the_motion() -> None:
    a, b = prepare_reference(view(POSES[9], noise=1)), prepare_reference(view(POSES[10], noise=1, seed=1))
    forth, back = align_frames(a, b, np.eye(4), SETTINGS), align_frames(b, a, np.eye(4), SETTINGS)
    shift, turn = error(forth.T_target_source, SE3.inverse(back.T_target_source))
    assert shift < 1e-3
    assert turn < 0.02


def test_views_of_other_places_are_refused_with_a_reason() -> None:
    target, source = prepare_reference(view(POSES[0])), view(POSES[60])
    found = align_frames(target, source, np.eye(4), SETTINGS)
    assert not found.usable
    assert found.problem


def test_a_blank_wall_is_degenerate() -> None:
    depth = np.full((120, 160), 10_000, np.uint16)
    frame = prepare_frame(
        np.full((120, 160, 3), 128, np.uint8), depth, CAMERA.vector(), depth_units_per_m=5000, max_depth_m=10
    )
    lenient = SETTINGS.model_copy(update={"correlation_min": -1.0})
    found = align_frames(prepare_reference(frame), frame, np.eye(4), lenient)
    assert found.status is RegistrationStatus.DEGENERATE
    assert "only known to" in found.problem


def test_a_frame_without_depth_has_too_few_points() -> None:
    empty = prepare_frame(
        np.zeros((120, 160, 3), np.uint8), np.zeros((120, 160), np.uint16), CAMERA.vector(),
        depth_units_per_m=5000, max_depth_m=10,
    )  # fmt: skip
    found = align_frames(prepare_reference(empty), view(POSES[0]), np.eye(4), SETTINGS)
    assert found.status is RegistrationStatus.TOO_FEW_POINTS


def test_normals_face_the_camera_and_fit_the_surfaces() -> None:
    reference = prepare_reference(view(POSES[0]))
    p = reference.points[0]
    flat = p.normals[:, 2] != 0
    assert flat.mean() > 0.7
    np.testing.assert_allclose(np.linalg.norm(p.normals[flat], axis=1), 1, atol=1e-9)
    assert (np.sum(p.normals[flat] * p.points[flat], axis=1) < 0).all()
    # every face of the room is along an axis of the world
    world = np.abs(p.normals[flat] @ POSES[0][:3, :3].T)
    assert np.quantile(world.max(axis=1), 0.1) > 0.98


def test_the_gradient_vanishes_at_the_truth_and_points_back_beside_it() -> None:
    target, source = prepare_reference(view(POSES[3])), view(POSES[4])
    p, truth = target.points[0], SE3.between(POSES[3], POSES[4])
    side = Side(p.points, p.normals, p.gradients, p.intensity, p.sigma_m,
                source.intensity[0], source.depth[0], source.camera[0])  # fmt: skip
    floors, offsets, H, g = np.array([0.3, 2.0, 0.0, 1.0]), np.zeros(3), np.zeros((6, 6)), np.zeros(6)
    rng = np.random.default_rng(0)
    for _ in range(5):
        off = rng.normal(0, 1, 6) * np.array([2e-3] * 3 + [4e-3] * 3)
        linearise(side, left_update(truth, off), False, offsets, 0.06, floors, H, g)
        step = -np.linalg.solve(H, g)
        # one Gauss-Newton step undoes most of a small displacement
        assert np.linalg.norm(step + off) < 0.5 * np.linalg.norm(off)
    none = Side(*(values[:0] for values in side[:5]), *side[5:])
    T, _, settled = align_level(side, none, truth, offsets, 0.06, 20, floors)
    assert settled
    assert error(T, truth)[0] < 2e-3


def test_a_sensor_that_bends_surfaces_is_seen_through_unless_it_is_trusted() -> None:
    # two units of disparity of a structured-light sensor at either border, of opposite sign
    trust = SETTINGS.model_copy(update={"inverse_depth_sigma": 0.0})
    plain, bent = [], []
    for k in range(0, 100, 20):
        a, b = (prepare_reference(view(POSES[m], noise=1, seed=m, bend=0.006)) for m in (k, k + 4))
        truth = SE3.between(POSES[k], POSES[k + 4])
        trusting, found = align_frames(a, b, truth, trust), align_frames(a, b, truth, SETTINGS)
        np.testing.assert_array_equal(trusting.inverse_depth_offsets, 0)
        plain.append(error(trusting.T_target_source, truth))
        bent.append(error(found.T_target_source, truth))
        swapped = align_frames(b, a, SE3.inverse(truth), SETTINGS)
        shift, turn = error(found.T_target_source, SE3.inverse(swapped.T_target_source))
        assert shift < 0.004
        assert turn < 0.1
    # texture holds the rotation in both
    assert np.mean(bent, axis=0)[0] < 0.5 * np.mean(plain, axis=0)[0]
    assert np.mean(bent, axis=0)[1] < np.mean(plain, axis=0)[1]


def nearer(frame: RgbdFrame, offset: float) -> RgbdFrame:
    """The frame with all inverse depths larger by an offset (1/m)."""
    depth = tuple(np.where(d > 0, 1 / (1 / np.maximum(d, 0.1) + offset), 0).astype(np.float32) for d in frame.depth)
    return RgbdFrame(intensity=frame.intensity, depth=depth, camera=frame.camera)


def test_the_error_of_depth_between_two_views_is_found() -> None:
    asked, trust = (SETTINGS.model_copy(update={"inverse_depth_sigma": sigma}) for sigma in (0.03, 0.0))
    a, b, truth = view(POSES[5]), nearer(view(POSES[9]), 0.01), SE3.between(POSES[5], POSES[9])
    for source in (b, prepare_reference(b)):
        found = align_frames(prepare_reference(a), source, truth, asked)
        assert found.usable
        np.testing.assert_allclose(found.inverse_depth_offsets, [0.01, 0, 0], atol=2e-3)
        misled = align_frames(prepare_reference(a), source, truth, trust)
        assert error(found.T_target_source, truth)[0] < 0.25 * error(misled.T_target_source, truth)[0]
    back = align_frames(prepare_reference(b), prepare_reference(a), SE3.inverse(truth), asked)
    np.testing.assert_allclose(back.inverse_depth_offsets, [-0.01, 0, 0], atol=2e-3)


def test_a_sensor_errs_alike_in_two_frames_of_one_view() -> None:
    a, b = prepare_reference(view(POSES[5])), prepare_reference(nearer(view(POSES[5]), 0.003))
    found = align_frames(a, b, np.eye(4), SETTINGS)
    assert np.abs(found.inverse_depth_offsets).max() < 1e-4
    apart = prepare_reference(nearer(view(POSES[9]), 0.003))
    found = align_frames(a, apart, SE3.between(POSES[5], POSES[9]), SETTINGS)
    assert found.inverse_depth_offsets[0] > 1e-3


def side_of(target: FloatArray, source: FloatArray) -> Side:
    """Points of the view from one pose against the images from another."""
    p, frame = prepare_reference(view(target, camera=LARGE)).points[0], view(source, camera=LARGE)
    return Side(p.points, p.normals, p.gradients, p.intensity, p.sigma_m,
                frame.intensity[0], frame.depth[0], frame.camera[0])  # fmt: skip


def compared(side: Side, T: FloatArray, noise: float) -> tuple[FloatArray, FloatArray]:
    """Differences of brightness at T, and their deviations as multiples of the noise."""
    n = len(side.points)
    brightness, spread, none = np.empty(n), np.empty(n), np.zeros((n, 3))
    warp(side, T, False, np.zeros(3), 0.06, noise, np.empty(n), brightness, spread, none.copy(), none.copy(),
         np.zeros(n, np.uint8))  # fmt: skip
    return brightness, spread


def test_brightness_is_as_uncertain_as_the_depth_under_it() -> None:
    truth = SE3.between(POSES[3], POSES[6])
    side = side_of(POSES[3], POSES[6])
    brightness, spread = compared(side, truth, 1.0)
    further = side._replace(points=side.points * (1 + side.sigma / side.points[:, 2])[:, None])
    change = np.abs(compared(further, truth, 1.0)[0] - brightness)
    stated = np.sqrt(spread**2 - 1)
    known = np.isfinite(change) & (stated > 0.2)
    assert known.sum() > 500
    assert 0.8 < np.median(change[known] / stated[known]) < 1.25
    assert np.corrcoef(change[known], stated[known])[0, 1] > 0.7
    # without parallax the depth does not matter
    np.testing.assert_array_equal(compared(side, np.eye(4), 1.0)[1], 1.0)
    turned = SE3.exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(compared(side, turned, 1.0)[1], 1.0)


def test_uncertain_brightness_weighs_less_than_certain() -> None:
    blind = SETTINGS.model_copy(update={"image_noise": 1e6})
    off = {"weighed": [], "alike": []}
    for k in range(0, 110, 10):
        a, b = (prepare_reference(view(POSES[m], noise=2, seed=m, camera=LARGE)) for m in (k, k + 5))
        truth = SE3.between(POSES[k], POSES[k + 5])
        for name, settings in (("weighed", SETTINGS), ("alike", blind)):
            off[name].append(error(align_frames(a, b, truth, settings).T_target_source, truth))
    weighed, alike = (np.sqrt(np.mean(np.square(off[name]), axis=0)) for name in ("weighed", "alike"))
    assert (weighed < alike).all()


def test_the_shift_of_the_view_is_that_of_its_points() -> None:
    side = side_of(POSES[3], POSES[4])
    assert view_shift(side, np.eye(4)) == 0.0
    for angle in (0.02, 0.1, 0.3):
        shift = view_shift(side, SE3.exp(np.array([0.0, angle, 0.0, 0.0, 0.0, 0.0])))
        # a turn moves the middle of the image by f tan(angle), its borders by more
        assert 1.0 < shift / (side.camera[0] * np.tan(angle) / 160) < 1.35
    assert view_shift(side, SE3.exp(np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))) == 0.0  # nothing in view


def test_derivatives_of_the_offsets_are_those_of_the_distances() -> None:
    target, source = prepare_reference(view(POSES[3])), prepare_reference(view(POSES[4]))
    truth = SE3.between(POSES[3], POSES[4])
    for back in (False, True):
        points, frame = (source, target.frame) if back else (target, source.frame)
        p, T = points.points[0], SE3.inverse(truth) if back else truth
        side = Side(p.points, p.normals, p.gradients, p.intensity, p.sigma_m,
                    frame.intensity[0], frame.depth[0], frame.camera[0])  # fmt: skip
        n = len(p)

        def distances(offsets: FloatArray, side=side, T=T, back=back, n=n) -> tuple[FloatArray, FloatArray]:
            across, levers, none = np.empty(n), np.zeros((n, 3)), np.empty(n)
            warp(side, T, back, offsets, 0.06, 1.0, across, none, none.copy(), np.zeros((n, 3)), levers,
                 np.zeros(n, np.uint8))  # fmt: skip
            return across, levers

        at = np.array([1e-3, -2e-3, 1e-3])
        _, levers = distances(at)
        for a in range(3):
            step = np.eye(3)[a] * 1e-5
            difference = (distances(at + step)[0] - distances(at - step)[0]) / 2e-5
            known = np.isfinite(difference)
            assert known.sum() > 1000
            np.testing.assert_allclose(levers[known, a], difference[known], rtol=1e-4, atol=1e-3)


def test_features_find_a_wide_motion_that_alignment_alone_does_not() -> None:
    a, b = view(POSES[0], camera=LARGE), view(POSES[10], camera=LARGE)
    truth = SE3.between(POSES[0], POSES[10])
    features = [detect_features(f.intensity[0], f.depth[0], f.camera[0]) for f in (a, b)]
    pairs = match_features(*features)
    motion = motion_of_matches(*features, pairs, inliers_min=15)
    assert motion.found
    assert motion.inliers <= motion.matches == len(pairs)
    shift, turn = error(motion.T_target_source, truth)
    assert shift < 0.08
    assert turn < 2.0
    refined = align_frames(prepare_reference(a), b, motion.T_target_source, SETTINGS)
    assert refined.usable
    assert error(refined.T_target_source, truth)[0] < 0.005
    again = motion_of_matches(*features, pairs, inliers_min=15)
    np.testing.assert_array_equal(again.T_target_source, motion.T_target_source)


def test_features_of_unrelated_views_do_not_agree() -> None:
    features = [
        detect_features(f.intensity[0], f.depth[0], f.camera[0])
        for f in (view(POSES[0], camera=LARGE), view(POSES[60], camera=LARGE))
    ]
    motion = motion_of_matches(*features, match_features(*features), inliers_min=20)
    assert not motion.found


def test_matches_are_mutual_nearest_neighbours() -> None:
    frame = view(POSES[7], camera=LARGE)
    features = detect_features(frame.intensity[0], frame.depth[0], frame.camera[0])
    pairs = match_features(features, features)
    assert len(pairs) > 100
    np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])
    bits = np.unpackbits(features.words.view(np.uint8), axis=1).astype(np.int64)
    shuffled = np.random.default_rng(1).permutation(len(features))
    other = type(features)(
        points=features.points[shuffled], pixels=features.pixels[shuffled], words=features.words[shuffled],
        camera=features.camera,
    )  # fmt: skip
    for i, j in match_features(features, other)[:50]:
        distance = np.sum(bits[i][None] != bits[shuffled], axis=1)
        assert distance[j] == distance.min()
