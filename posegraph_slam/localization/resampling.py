"""Weights of particles, and drawing them anew: which, and how many."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.localization.settings import ParticleNumberSettings, ResamplingScheme


def normalised(log_weights: FloatArray) -> FloatArray:
    """Return weights (N,) that add up to one; log-weights far below the largest become zero, never NaN.

    All equal where no log-weight is finite: then nothing is known of the particles.
    """
    largest = log_weights.max(initial=-np.inf)
    if not np.isfinite(largest):
        return np.full(len(log_weights), 1 / max(len(log_weights), 1))
    weights = np.exp(log_weights - largest)
    return np.asarray(weights / weights.sum())


def effective_number(weights: FloatArray) -> float:
    """Return (sum w)^2 / sum w^2: N for equal weights, 1 where one particle has it all."""
    return float(weights.sum() ** 2 / (weights**2).sum())


def resample(weights: FloatArray, count: int, scheme: ResamplingScheme, rng: np.random.Generator) -> IntArray:
    """Draw `count` ancestors (indices) in proportion to `weights` (N,), which add up to one.

    Multinomial draws are independent. The others put a comb of step 1 / count on the cumulative weights, so that a
    particle of weight w is drawn floor(w count) or ceil(w count) times (stratified: one more or less at most):
    systematic shifts the comb by less than a step; low_variance adds the comb to one number in [0, 1) and wraps
    around; stratified shifts each tooth by itself (Douc and Cappe 2005).
    """
    cumulative = np.cumsum(weights)
    cumulative /= cumulative[-1]
    comb = np.arange(count) / count
    if scheme == "multinomial":
        positions = rng.random(count)
    elif scheme == "systematic":
        positions = comb + rng.random() / count
    elif scheme == "low_variance":
        positions = (rng.random() + comb) % 1.0
    else:
        positions = comb + rng.random(count) / count
    return np.minimum(np.searchsorted(cumulative, positions, side="right"), len(weights) - 1)


def occupied_bins(particles: FloatArray, bin_m: float, bin_rad: float) -> int:
    """Return how many bins of position and heading the particles (N, 3) fall into."""
    bins = np.floor(particles / [bin_m, bin_m, bin_rad]).astype(np.int64)
    bins[:, 2] %= max(round(2 * np.pi / bin_rad), 1)
    low, high = bins.min(axis=0), bins.max(axis=0)
    span = high - low + 1
    code = ((bins[:, 0] - low[0]) * span[1] + bins[:, 1] - low[1]) * span[2] + bins[:, 2] - low[2]
    return len(np.unique(code))


def needed_number(bins: int, settings: ParticleNumberSettings) -> int:
    """Return how many particles a distribution over `bins` bins needs for the allowed error (Fox 2003, eq. 7)."""
    if bins < 2:
        return settings.minimum
    a = 2.0 / (9.0 * (bins - 1))
    n = (bins - 1) / (2 * settings.error) * (1 - a + np.sqrt(a) * settings.quantile) ** 3
    return int(np.clip(np.ceil(n), settings.minimum, settings.maximum))
