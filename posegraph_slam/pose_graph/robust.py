"""Robust losses of the whitened error e = sqrt(chi-square), with the weights that they give a constraint.

Each loss is rho(e) with weight w(e) = rho'(e) / e, scaled so that rho(e) = e^2/2 near zero; the forms and the meaning
of the parameter are those of GTSAM's m-estimators, so that both solvers minimise the same cost.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import BoolArray, FloatArray
from posegraph_slam.settings import Settings


class RobustLoss(StrEnum):
    """How strongly a large error of a loop constraint still pulls."""

    NONE = "none"
    HUBER = "huber"
    CAUCHY = "cauchy"
    GEMAN_MCCLURE = "geman_mcclure"
    DCS = "dcs"
    """Dynamic covariance scaling (Agarwal et al. 2013)."""


DEFAULT_PARAMETER = {
    RobustLoss.NONE: 1.0,
    RobustLoss.HUBER: 1.345,
    RobustLoss.CAUCHY: 2.385,
    RobustLoss.GEMAN_MCCLURE: 3.0,
    RobustLoss.DCS: 1.0,
}
"""Huber and Cauchy: 95 % efficiency on a Gaussian error; DCS: phi = 1 as in its paper; Geman-McClure:
a gate of three deviations."""


class RobustSettings(Settings):
    """The loss put on loop constraints; odometry and scan matching of neighbours always count in full."""

    loss: RobustLoss = Field(default=RobustLoss.NONE, description="none, huber, cauchy, geman_mcclure or dcs")
    parameter: float | None = Field(
        default=None, gt=0, description="scale of the loss on the whitened error (DCS: on its square); unset: standard"
    )

    @property
    def scale(self) -> float:
        """The parameter in force."""
        return DEFAULT_PARAMETER[self.loss] if self.parameter is None else self.parameter


def robust_weights(chi2: FloatArray, settings: RobustSettings) -> FloatArray:
    """Return the weight in [0, 1] for each squared error, any shape."""
    c = settings.scale
    with np.errstate(divide="ignore"):
        match settings.loss:
            case RobustLoss.HUBER:
                return np.minimum(1.0, c / np.sqrt(chi2))
            case RobustLoss.CAUCHY:
                return np.asarray(c**2 / (c**2 + chi2))
            case RobustLoss.GEMAN_MCCLURE:
                return np.asarray((c**2 / (c**2 + chi2)) ** 2)
            case RobustLoss.DCS:
                return np.minimum(1.0, 2 * c / (c + chi2)) ** 2
            case RobustLoss.NONE:
                return np.ones_like(chi2)


def robust_costs(chi2: FloatArray, settings: RobustSettings) -> FloatArray:
    """Return rho(sqrt(chi2)) for each squared error, any shape."""
    c = settings.scale
    match settings.loss:
        case RobustLoss.HUBER:
            e = np.sqrt(chi2)
            return np.where(e <= c, 0.5 * chi2, c * (e - 0.5 * c))
        case RobustLoss.CAUCHY:
            return np.asarray(0.5 * c**2 * np.log1p(chi2 / c**2))
        case RobustLoss.GEMAN_MCCLURE:
            return np.asarray(0.5 * c**2 * chi2 / (c**2 + chi2))
        case RobustLoss.DCS:
            return np.where(chi2 <= c, 0.5 * chi2, 1.5 * c - 2 * c**2 / (c + chi2))
        case RobustLoss.NONE:
            return 0.5 * chi2


def constraint_costs(is_loop: BoolArray, chi2: FloatArray, settings: RobustSettings) -> FloatArray:
    """Return the cost (E,) of each constraint: under the loss for loops, half of chi-square for the others."""
    if settings.loss is RobustLoss.NONE:
        return 0.5 * chi2
    return np.where(is_loop, robust_costs(chi2, settings), 0.5 * chi2)


def constraint_weights(is_loop: BoolArray, chi2: FloatArray, settings: RobustSettings) -> FloatArray:
    """Return the robust weight (E,) of each constraint; 1 for those that close no loop."""
    return np.where(is_loop, robust_weights(chi2, settings), 1.0)
