"""Robust losses as weights of iteratively reweighted least squares (Zhang 1997, table 1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.registration.settings import Loss

HUBER_TUNING, CAUCHY_TUNING, GEMAN_MCCLURE_TUNING, TUKEY_TUNING = 1.345, 2.3849, 3.7874, 4.6851
"""Widths in standard deviations; each keeps 95 % of the efficiency of least squares on normal residuals."""

MEDIAN_OF_NORM = {1: 0.674490, 2: 1.177410, 3: 1.538172}
"""Median length of a standard normal vector by its dimension."""


def _none(u: FloatArray) -> FloatArray:
    return np.ones_like(u)


def _huber(u: FloatArray) -> FloatArray:
    return HUBER_TUNING / np.maximum(u, HUBER_TUNING)


def _cauchy(u: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + (u / CAUCHY_TUNING) ** 2))


def _geman_mcclure(u: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + (u / GEMAN_MCCLURE_TUNING) ** 2) ** 2)


def _tukey(u: FloatArray) -> FloatArray:
    return np.asarray(np.maximum(1.0 - (u / TUKEY_TUNING) ** 2, 0.0) ** 2)


_WEIGHTS: dict[Loss, Callable[[FloatArray], FloatArray]] = {
    Loss.NONE: _none,
    Loss.HUBER: _huber,
    Loss.CAUCHY: _cauchy,
    Loss.GEMAN_MCCLURE: _geman_mcclure,
    Loss.TUKEY: _tukey,
}


def robust_weights(loss: Loss, residual_norms: FloatArray, scale: float) -> FloatArray:
    """Return the weights rho'(u)/u (m,) in [0, 1] of residuals of length `residual_norms` (m,) and deviation `scale`.

    With u = residual / scale and tuning c: Huber min(1, c/u), Cauchy 1/(1 + (u/c)^2), Geman-McClure
    1/(1 + (u/c)^2)^2, Tukey (1 - (u/c)^2)^2 below c and 0 above.
    """
    return _WEIGHTS[loss](residual_norms / scale)


def residual_scale(residual_norms: FloatArray, dimension: int, floor: float) -> float:
    """Estimate the standard deviation of residuals, a component, from the median of their lengths (m,).

    `dimension` is that of the residual vector; no less than `floor` is returned.
    """
    if len(residual_norms) == 0:
        return floor
    middle = len(residual_norms) // 2
    median = np.partition(residual_norms, middle)[middle]
    return max(float(median) / MEDIAN_OF_NORM[dimension], floor)
