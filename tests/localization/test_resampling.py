"""Weights, the four ways to draw particles anew, and their number."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.localization.resampling import (
    effective_number,
    needed_number,
    normalised,
    occupied_bins,
    resample,
)
from posegraph_slam.localization.settings import ParticleNumberSettings

SCHEMES = ("systematic", "low_variance", "stratified", "multinomial")
weight_lists = st.lists(st.floats(0, 1), min_size=1, max_size=40).filter(lambda w: sum(w) > 1e-3)


@given(st.lists(st.floats(-1e4, 1e3), min_size=1, max_size=30))
def test_weights_add_up_to_one_and_keep_their_ratios(values: list[float]) -> None:
    logs = np.array(values)
    weights = normalised(logs)
    assert weights.sum() == pytest.approx(1)
    big = logs > logs.max() - 200
    np.testing.assert_allclose(np.log(weights[big] / weights.max()), logs[big] - logs.max(), atol=1e-9)


def test_without_any_finite_weight_all_are_equal() -> None:
    np.testing.assert_array_equal(normalised(np.full(4, -np.inf)), np.full(4, 0.25))


def test_effective_number() -> None:
    assert effective_number(np.full(50, 0.02)) == pytest.approx(50)
    assert effective_number(np.eye(50)[3]) == pytest.approx(1)
    assert effective_number(np.array([0.5, 0.5, 0, 0])) == pytest.approx(2)


@given(weight_lists, st.integers(1, 200), st.sampled_from(["systematic", "low_variance"]), st.integers(0, 1000))
def test_a_comb_draws_each_particle_its_share_of_times(raw: list[float], count: int, scheme, seed: int) -> None:
    weights = np.array(raw) / np.sum(raw)
    drawn = np.bincount(resample(weights, count, scheme, np.random.default_rng(seed)), minlength=len(weights))
    assert drawn.sum() == count
    assert (drawn >= np.floor(weights * count - 1e-6)).all()
    assert (drawn <= np.ceil(weights * count + 1e-6)).all()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_draws_are_unbiased(scheme) -> None:
    rng = np.random.default_rng(1)
    weights = np.array([0.05, 0.4, 0.0, 0.25, 0.3])
    counts = np.zeros(5)
    for _ in range(4000):
        counts += np.bincount(resample(weights, 7, scheme, rng), minlength=5)
    np.testing.assert_allclose(counts / 28000, weights, atol=0.008)
    assert counts[2] == 0


def test_combs_vary_less_than_independent_draws() -> None:
    rng = np.random.default_rng(2)
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    spread = {
        scheme: np.var(
            [np.bincount(resample(weights, 15, scheme, rng), minlength=4) for _ in range(2000)], axis=0
        ).sum()
        for scheme in SCHEMES
    }
    assert spread["systematic"] < 0.3 * spread["multinomial"]
    assert spread["low_variance"] < 0.3 * spread["multinomial"]
    assert spread["systematic"] <= spread["stratified"] < spread["multinomial"]


def test_number_grows_with_the_spread_within_its_limits() -> None:
    settings = ParticleNumberSettings(minimum=50, maximum=2000)
    numbers = [needed_number(bins, settings) for bins in (1, 2, 5, 20, 100, 10000)]
    assert numbers[0] == 50
    assert numbers == sorted(numbers)
    assert numbers[-1] == 2000
    # Half the chi-square quantile over the error: 0.99 quantile of 19 degrees of freedom is 36.19.
    assert needed_number(20, settings) == pytest.approx(36.19 / 2 / 0.05, rel=0.01)


def test_bins_match_a_slow_count() -> None:
    rng = np.random.default_rng(3)
    particles = rng.uniform([-2, -2, -np.pi], [2, 2, np.pi], (500, 3))
    wide = round(2 * np.pi / 0.17)
    slow = {(int(x // 0.3), int(y // 0.3), int(t // 0.17) % wide) for x, y, t in particles}
    assert occupied_bins(particles, 0.3, 0.17) == len(slow)
