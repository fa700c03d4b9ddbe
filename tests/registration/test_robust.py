"""Robust weights at values computed by hand, and their defining properties."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from posegraph_slam.registration.robust import residual_scale, robust_weights
from posegraph_slam.registration.settings import Loss
from posegraph_slam.registration.small_steps import robust_slope, robust_weight

TUNING = {Loss.HUBER: 1.345, Loss.CAUCHY: 2.3849, Loss.GEMAN_MCCLURE: 3.7874, Loss.TUKEY: 4.6851}


@pytest.mark.parametrize(
    ("loss", "multiple_of_tuning", "expected"),
    [
        (Loss.NONE, 100.0, 1.0),
        (Loss.HUBER, 0.5, 1.0),
        (Loss.HUBER, 1.0, 1.0),
        (Loss.HUBER, 2.0, 0.5),
        (Loss.HUBER, 10.0, 0.1),
        (Loss.CAUCHY, 0.0, 1.0),
        (Loss.CAUCHY, 1.0, 0.5),
        (Loss.CAUCHY, 2.0, 0.2),
        (Loss.CAUCHY, 3.0, 0.1),
        (Loss.GEMAN_MCCLURE, 0.0, 1.0),
        (Loss.GEMAN_MCCLURE, 1.0, 0.25),
        (Loss.GEMAN_MCCLURE, 2.0, 0.04),
        (Loss.GEMAN_MCCLURE, 3.0, 0.01),
        (Loss.TUKEY, 0.0, 1.0),
        (Loss.TUKEY, 0.5, 0.5625),
        (Loss.TUKEY, 1.0, 0.0),
        (Loss.TUKEY, 7.0, 0.0),
    ],
)
def test_weights_by_hand(loss: Loss, multiple_of_tuning: float, expected: float) -> None:
    scale = 0.02
    residual = np.array([multiple_of_tuning * TUNING.get(loss, 1.0) * scale])
    assert robust_weights(loss, residual, scale)[0] == pytest.approx(expected)


@pytest.mark.parametrize("loss", Loss)
def test_the_compiled_weight_is_the_same(loss: Loss) -> None:
    u = np.linspace(0, 6, 61)
    compiled = [robust_weight(list(Loss).index(loss), x) for x in u]
    np.testing.assert_allclose(compiled, robust_weights(loss, u, 1.0), rtol=1e-14)


@pytest.mark.parametrize("loss", Loss)
def test_slope_is_the_derivative_of_the_influence(loss: Loss) -> None:
    u, h = np.linspace(0.05, 6, 40) + 1e-3, 1e-6

    def influence(x: np.ndarray) -> np.ndarray:
        return x * robust_weights(loss, x, 1.0)

    numeric = (influence(u + h) - influence(u - h)) / (2 * h)
    np.testing.assert_allclose([robust_slope(list(Loss).index(loss), x) for x in u], numeric, atol=1e-8)


@pytest.mark.parametrize("loss", [loss for loss in Loss if loss is not Loss.NONE])
def test_normal_residuals_keep_95_percent_efficiency(loss: Loss) -> None:
    code = list(Loss).index(loss)

    def density(x: float) -> float:
        return float(np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi))

    slope = 2 * quad(lambda x: robust_slope(code, x) * density(x), 0, 9, points=[1.345])[0]
    power = 2 * quad(lambda x: (x * robust_weight(code, x)) ** 2 * density(x), 0, 9, points=[1.345])[0]
    assert slope**2 / power == pytest.approx(0.95, abs=1e-4)


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_scale_is_the_standard_deviation_despite_outliers(dimension: int) -> None:
    vectors = np.random.default_rng(0).normal(scale=0.05, size=(20_000, dimension))
    vectors[:500] = 100.0
    lengths = np.linalg.norm(vectors, axis=1)
    assert residual_scale(lengths, dimension, 1e-9) == pytest.approx(0.05, rel=0.05)


def test_scale_has_a_floor() -> None:
    assert residual_scale(np.zeros(5), 1, 1e-4) == 1e-4
    assert residual_scale(np.zeros(0), 1, 1e-4) == 1e-4
