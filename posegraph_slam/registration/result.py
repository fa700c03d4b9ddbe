"""What every matcher returns."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from posegraph_slam.arrays import FloatArray, read_only


class RegistrationStatus(StrEnum):
    """How a registration ended; only CONVERGED and MAX_ITERATIONS carry a usable transform."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "max_iterations"
    TOO_FEW_POINTS = "too_few_points"
    TOO_FEW_INLIERS = "too_few_inliers"
    DEGENERATE = "degenerate"
    """The points leave the transform undetermined (all on one spot or one line): nothing can be said."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegistrationResult:
    """T_target_source (d+1, d+1) with its quality and uncertainty; meaningful only if `usable`.

    `information` (p, p) is the Hessian of the residuals over their variance in the tangent of the right update
    T exp(d), with a floor on its eigenvalues; `degenerate_directions` (k, p) are unit tangents that the points do
    not constrain (along a corridor, say), empty when all are constrained.
    """

    T_target_source: FloatArray
    status: RegistrationStatus
    inliers: int
    inlier_fraction: float
    rmse_m: float
    information: FloatArray
    degenerate_directions: FloatArray
    iterations: int

    def __post_init__(self) -> None:
        for name in ("T_target_source", "information", "degenerate_directions"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def usable(self) -> bool:
        """Whether the transform may be used."""
        return self.status in (RegistrationStatus.CONVERGED, RegistrationStatus.MAX_ITERATIONS)

    @property
    def degenerate(self) -> bool:
        """Whether some direction is left free."""
        return len(self.degenerate_directions) > 0
