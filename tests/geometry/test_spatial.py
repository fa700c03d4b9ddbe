"""Rigid transforms and their planar forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.geometry import (
    SE2,
    SE3,
    inverse_pose,
    planar_from_spatial,
    pose_from_xyt,
    spatial_from_planar,
    transform_points,
    wrap_angle,
    xyt_from_pose,
)


@pytest.mark.parametrize("group", [SE2, SE3], ids=lambda g: g.name)
@pytest.mark.parametrize("batch", [(), (0,), (3,), (2, 3)])
def test_transforming_is_multiplying(group: type, batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    T = group.exp(rng.normal(size=(*batch, group.dof)))
    points = rng.normal(size=(*batch, 7, group.dimension))
    homogeneous = np.concatenate([points, np.ones((*batch, 7, 1))], axis=-1)
    expected = np.einsum("...ij,...nj->...ni", T, homogeneous)[..., :-1]
    np.testing.assert_allclose(transform_points(T, points), expected, atol=1e-13)
    np.testing.assert_allclose(inverse_pose(T) @ T, group.identity(*batch), atol=1e-13)
    np.testing.assert_allclose(transform_points(inverse_pose(T), transform_points(T, points)), points, atol=1e-13)


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.14, 3.14))
def test_planar_forms_are_one(x: float, y: float, theta: float) -> None:
    T = pose_from_xyt(np.array([x, y, theta]))
    np.testing.assert_allclose(xyt_from_pose(T), [x, y, theta], atol=1e-12)
    np.testing.assert_allclose(planar_from_spatial(spatial_from_planar(T)), T, atol=1e-12)


@given(st.floats(-1e4, 1e4))
def test_wrapping_keeps_the_direction(angle: float) -> None:
    wrapped = float(wrap_angle(np.array(angle)))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)
