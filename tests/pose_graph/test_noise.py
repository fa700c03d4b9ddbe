from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, SE3
from posegraph_slam.pose_graph.noise import (
    information_from_covariance,
    information_from_sigmas,
    information_isotropic,
)


@given(arrays(np.float64, (4, 3), elements=st.floats(1e-4, 1e3)))
def test_sigmas_and_covariance_agree(sigmas: np.ndarray) -> None:
    covariance = sigmas[..., None] ** 2 * np.eye(3)
    np.testing.assert_allclose(information_from_sigmas(sigmas), information_from_covariance(covariance), rtol=1e-12)


@given(arrays(np.float64, (2, 6, 6), elements=st.floats(-1, 1)))
def test_covariance_is_inverted_and_symmetric(matrix: np.ndarray) -> None:
    covariance = matrix @ np.swapaxes(matrix, 1, 2) + 0.1 * np.eye(6)
    information = information_from_covariance(covariance)
    np.testing.assert_allclose(information @ covariance, np.broadcast_to(np.eye(6), (2, 6, 6)), atol=1e-9)
    np.testing.assert_array_equal(information, np.swapaxes(information, 1, 2))


def test_isotropic_follows_the_tangent_order() -> None:
    planar = information_isotropic(SE2, sigma_translation_m=0.1, sigma_rotation_rad=0.5)
    spatial = information_isotropic(SE3, sigma_translation_m=0.1, sigma_rotation_rad=0.5)
    np.testing.assert_allclose(np.diag(planar), [100, 100, 4])
    np.testing.assert_allclose(np.diag(spatial), [4, 4, 4, 100, 100, 100])


@pytest.mark.parametrize("sigmas", [[0.1, 0.0, 0.1], [0.1, -1.0, 0.1], [0.1, np.nan, 0.1], [0.1, np.inf, 0.1]])
def test_bad_sigmas_are_refused(sigmas: list[float]) -> None:
    with pytest.raises(InputError, match="positive and finite"):
        information_from_sigmas(sigmas)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (np.diag([1.0, -1.0, 1.0]), "not positive definite"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "not symmetric"),
        (np.diag([1.0, np.nan]), "not finite"),
        (np.ones((2, 3)), "shape"),
    ],
)
def test_bad_covariances_are_refused(covariance: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        information_from_covariance(covariance)
