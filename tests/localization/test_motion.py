"""Noise that scales with the motion."""

from __future__ import annotations

import numpy as np
import pytest

from posegraph_slam.geometry import pose_from_xyt, xyt_from_pose
from posegraph_slam.localization.motion import propagate, step_sigmas
from posegraph_slam.localization.settings import LocalizationSettings, MotionNoise


def test_without_noise_every_particle_makes_the_step_in_its_own_frame() -> None:
    rng = np.random.default_rng(0)
    particles, step = rng.uniform(-3, 3, (50, 3)), np.array([0.4, -0.1, 0.7])
    still = MotionNoise(
        translation_per_sqrt_m=0, translation_per_sqrt_rad=0, rotation_per_sqrt_rad=0, rotation_per_sqrt_m=0
    )
    moved = propagate(particles, step, still, rng)
    np.testing.assert_allclose(moved, xyt_from_pose(pose_from_xyt(particles) @ pose_from_xyt(step)), atol=1e-12)


def test_straight_motion_spreads_no_heading() -> None:
    rng = np.random.default_rng(1)
    for noise in (MotionNoise(), LocalizationSettings().matched_noise):
        particles = np.zeros((2000, 3))
        for _ in range(100):  # 10 m in all
            particles = propagate(particles, np.array([0.1, 0.0, 0.0]), noise, rng)
        assert particles[:, 2].std() < np.deg2rad(0.6)
        assert particles[:, 0].std() > 0.02
    sure = MotionNoise(rotation_per_sqrt_m=0)
    assert propagate(np.zeros((100, 3)), np.array([2.0, 0, 0]), sure, rng)[:, 2].std() == 0


def test_turning_spreads_heading_with_the_square_root_of_the_turn() -> None:
    noise = MotionNoise(rotation_per_sqrt_rad=0.1)
    rng = np.random.default_rng(2)
    little = propagate(np.zeros((20000, 3)), np.array([0, 0, 0.25]), noise, rng)[:, 2].std()
    much = propagate(np.zeros((20000, 3)), np.array([0, 0, 1.0]), noise, rng)[:, 2].std()
    assert (little, much) == (pytest.approx(0.05, rel=0.03), pytest.approx(0.1, rel=0.03))


def test_noise_does_not_depend_on_how_finely_a_motion_is_cut() -> None:
    whole = step_sigmas(np.array([1.0, 0.0, 0.5]), MotionNoise())
    part = step_sigmas(np.array([0.1, 0.0, 0.05]), MotionNoise())
    np.testing.assert_allclose(part * np.sqrt(10), whole)
    assert not step_sigmas(np.zeros(3), MotionNoise()).any()
