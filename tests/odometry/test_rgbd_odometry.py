"""Tracking an RGB-D camera through rendered frames: accuracy, gaps, and getting lost."""

from __future__ import annotations

from dataclasses import dataclass, field

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
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE3
from posegraph_slam.odometry.rgbd_odometry import track_rgbd
from posegraph_slam.odometry.rgbd_tracker import RgbdOdometrySettings
from posegraph_slam.pipeline.executors import make_executor
from posegraph_slam.registration.rgbd_frame import RgbdFrame, prepare_frame

CAMERA = small_camera(160, 120)
POSES = loop_through_room(120)
SETTINGS = RgbdOdometrySettings()


@dataclass
class Film:
    """Frames seen from some poses; `dark` ones hold nothing."""

    poses: FloatArray
    dark: tuple[int, ...] = ()
    asked: list[int] = field(default_factory=list)

    def __call__(self, k: int) -> RgbdFrame:
        self.asked.append(k)
        rng = np.random.default_rng(k)
        colour, depth = render_rgbd(furnished_room(seed=3), CAMERA, self.poses[k])
        units = noisy_depth(depth, CAMERA.depth_units_per_m, rng, noise=1.0)
        if k in self.dark:
            colour, units = np.zeros_like(colour), np.zeros_like(units)
        return prepare_frame(colour, units, CAMERA.vector(), depth_units_per_m=CAMERA.depth_units_per_m, max_depth_m=10)


def errors(estimate: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    relative = SE3.local(SE3.between(truth[:1], truth), SE3.between(estimate[:1], estimate))
    return np.linalg.norm(relative[:, 3:], axis=1), np.rad2deg(np.linalg.norm(relative[:, :3], axis=1))


def test_follows_the_camera_and_begins_keyframes() -> None:
    film = Film(POSES[:24])
    found = track_rgbd(film, np.arange(24) / 30, SETTINGS)
    shift, turn = errors(found.trajectory.poses, POSES[:24])
    assert shift.max() < 0.02
    assert turn.max() < 0.4
    assert found.tracked.all()
    assert not found.guessed.any()
    assert sorted(set(film.asked)) == film.asked, "every frame is read once, in order"
    assert found.keyframes[0] == 0
    assert found.keyframes[-1] == 23, "the last frame is a node of the graph"
    assert 4 <= len(found.keyframes) < 20
    chained = POSES[0]
    for T in found.T_i_j:
        chained = chained @ T
    np.testing.assert_allclose(chained, POSES[0] @ found.trajectory.poses[23], atol=1e-9)


def test_does_not_depend_on_the_workers() -> None:
    one = track_rgbd(Film(POSES[:10]), np.arange(10.0), SETTINGS)
    with make_executor(3) as executor:  # type: ignore[union-attr]
        three = track_rgbd(Film(POSES[:10]), np.arange(10.0), SETTINGS, executor=executor)
    np.testing.assert_array_equal(one.trajectory.poses, three.trajectory.poses)
    np.testing.assert_array_equal(one.information, three.information)


def test_frames_that_show_nothing_are_interpolated() -> None:
    found = track_rgbd(Film(POSES[:10], dark=(4, 5)), np.arange(10.0), SETTINGS)
    np.testing.assert_array_equal(np.flatnonzero(~found.tracked), [4, 5])
    shift, _ = errors(found.trajectory.poses, POSES[:10])
    assert shift.max() < 0.02
    assert any("2 frames could not be aligned" in remark for remark in found.remarks)


def test_where_nothing_leads_on_the_motion_is_a_guess_that_says_so() -> None:
    poses = np.concatenate([POSES[:9], POSES[60:66]])
    settings = SETTINGS.model_copy(update={"lost_frames_max": 2})
    found = track_rgbd(Film(poses, dark=(5, 6, 7, 8)), np.arange(15.0), settings)
    np.testing.assert_array_equal(np.flatnonzero(~found.tracked), [5, 6, 7, 8])
    assert found.guessed.sum() == 1
    k = int(np.flatnonzero(found.guessed)[0])
    assert found.keyframes[k] == 4, "the last frame before the gap is a node"
    assert found.keyframes[k + 1] == 9, "and so is the first one behind it"
    assert np.linalg.inv(found.information[k])[3, 3] == pytest.approx(settings.lost_sigma_m**2)
    assert any("tracking was lost before frame 9" in remark for remark in found.remarks)
    # behind the gap the camera is tracked from the first frame on
    step = SE3.between(found.trajectory.poses[9], found.trajectory.poses[14])
    assert np.linalg.norm(SE3.local(SE3.between(poses[9], poses[14]), step)) < 0.05


def test_a_long_darkness_is_bridged_when_the_view_is_known_again() -> None:
    dark = tuple(range(4, 19))
    poses = np.concatenate([POSES[:4], np.repeat(POSES[4:5], 15, axis=0), POSES[4:8]])
    found = track_rgbd(Film(poses, dark=dark), np.arange(23.0), SETTINGS)
    np.testing.assert_array_equal(np.flatnonzero(~found.tracked), dark)
    assert not found.guessed.any()
    shift, _ = errors(found.trajectory.poses, poses)
    assert shift[found.tracked].max() < 0.02


def test_frames_seen_while_lost_are_placed_by_one_that_fits_both_places() -> None:
    # away at once to a view that has nothing in common with the last one, and back slowly to where it was
    film = Film(np.concatenate([POSES[:4], POSES[24:3:-3], POSES[4:7]]))
    found = track_rgbd(film, np.arange(14.0), SETTINGS)
    assert found.tracked.all()
    assert not found.guessed.any()
    shift, turn = errors(found.trajectory.poses, film.poses)
    assert shift.max() < 0.05
    assert turn.max() < 1.0


def test_views_of_elsewhere_that_lead_nowhere_are_left_out() -> None:
    elsewhere = POSES[[50, 51, 75, 100, 101]]
    film = Film(np.concatenate([POSES[:4], elsewhere, POSES[5:8]]))
    found = track_rgbd(film, np.arange(12.0), SETTINGS)
    np.testing.assert_array_equal(np.flatnonzero(~found.tracked), [4, 5, 6, 7, 8])
    assert not found.guessed.any()
    shift, _ = errors(found.trajectory.poses, film.poses)
    assert shift[found.tracked].max() < 0.02


def test_a_first_frame_that_shows_nothing_begins_nothing() -> None:
    found = track_rgbd(Film(POSES[:16], dark=(0, 1)), np.arange(16.0), SETTINGS)
    np.testing.assert_array_equal(np.flatnonzero(~found.tracked), [0, 1])
    assert found.keyframes[0] == 2
    np.testing.assert_array_equal(found.trajectory.poses[:3], np.tile(np.eye(4), (3, 1, 1)))


def test_features_bridge_a_leap() -> None:
    large = small_camera(320, 240)
    poses = POSES[[0, 1, 2, 12, 13]]

    def frames(k: int) -> RgbdFrame:
        colour, depth = render_rgbd(furnished_room(seed=3), large, poses[k])
        units = noisy_depth(depth, large.depth_units_per_m, np.random.default_rng(k))
        return prepare_frame(colour, units, large.vector(), depth_units_per_m=5000, max_depth_m=10)

    found = track_rgbd(frames, np.arange(5.0), SETTINGS)
    shift, turn = errors(found.trajectory.poses, poses)
    assert found.tracked.all()
    assert shift.max() < 0.03
    assert turn.max() < 0.6


def test_frames_that_have_nothing_in_common_are_refused() -> None:
    with pytest.raises(InputError, match="no frame can be aligned"):
        track_rgbd(Film(POSES[[0, 60]]), np.arange(2.0), SETTINGS)
    with pytest.raises(InputError, match="two or more"):
        track_rgbd(Film(POSES[:1]), np.arange(1.0), SETTINGS)
