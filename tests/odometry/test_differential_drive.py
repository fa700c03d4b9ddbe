"""The exact motion model: constant twists give exact arcs, and the closed form equals the product of exponentials."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.geometry import SE2
from posegraph_slam.odometry.differential_drive import (
    integrate_motion,
    motion_steps,
    wheel_difference,
    wheel_distance,
)


@given(
    speed=st.floats(-2, 2), rate=st.floats(-3, 3), duration=st.floats(0.1, 20), steps=st.integers(1, 300)
)  # fmt: skip
def test_a_constant_twist_gives_the_arc_whatever_the_steps(
    speed: float, rate: float, duration: float, steps: int
) -> None:
    tau = duration / steps
    poses = integrate_motion(np.full(steps, tau * speed), np.full(steps, tau * rate))
    expected = SE2.exp(np.array([speed, 0.0, rate]) * duration)
    np.testing.assert_allclose(poses[-1], expected, atol=1e-9)
    if abs(rate) > 1e-3:  # all poses lie on the circle of radius v / omega about its centre
        centre = np.array([0.0, speed / rate])
        radius = np.linalg.norm(poses[:, :2, 2] - centre, axis=1)
        np.testing.assert_allclose(radius, abs(speed / rate), rtol=1e-6, atol=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_the_cumulative_form_equals_the_product_of_exponentials(seed: int) -> None:
    rng = np.random.default_rng(seed)
    distance, turn = rng.normal(0, 0.3, 40), rng.normal(0, 0.5, 40)
    pose, expected = np.eye(3), [np.eye(3)]
    for step in motion_steps(distance, turn):
        pose = pose @ step
        expected.append(pose)
    np.testing.assert_allclose(integrate_motion(distance, turn), np.array(expected), atol=1e-12)


def test_no_steps_leave_the_start() -> None:
    np.testing.assert_array_equal(integrate_motion(np.zeros(0), np.zeros(0)), np.eye(3)[None])


def test_a_faster_right_side_turns_left() -> None:
    travel = np.array([[0.1, 0.3]])
    assert wheel_distance(travel)[0] == 0.2
    assert wheel_difference(travel)[0] > 0
