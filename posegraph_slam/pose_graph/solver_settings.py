"""Configuration of the solver and the record of a solution."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from pydantic import Field

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.pose_graph.robust import RobustSettings
from posegraph_slam.settings import Settings


class SolverKind(StrEnum):
    """Which implementation solves."""

    AUTO = "auto"
    """The sparse one where it knows the method."""
    GTSAM = "gtsam"
    SPARSE = "sparse"
    """The package's own: Levenberg-Marquardt and Gauss-Newton on a block Cholesky factorisation."""


class SolverMethod(StrEnum):
    """How each step is chosen."""

    LEVENBERG_MARQUARDT = "levenberg_marquardt"
    GAUSS_NEWTON = "gauss_newton"
    DOGLEG = "dogleg"
    ISAM2 = "isam2"
    """Nodes added batch by batch from the fixed one on (GTSAM): what an incremental use arrives at."""


class EliminationOrdering(StrEnum):
    """Order in which the linear system is eliminated."""

    AUTO = "auto"
    """METIS for graphs of more than four constraints a node, COLAMD otherwise."""
    COLAMD = "colamd"
    METIS = "metis"


class SolverSettings(Settings):
    """How a pose graph is solved."""

    kind: SolverKind = Field(default=SolverKind.AUTO, description="auto, gtsam or sparse")
    method: SolverMethod = Field(
        default=SolverMethod.LEVENBERG_MARQUARDT, description="levenberg_marquardt, gauss_newton, dogleg or isam2"
    )
    ordering: EliminationOrdering = Field(default=EliminationOrdering.AUTO, description="auto, colamd or metis")
    max_iterations: int = Field(default=100, ge=1, description="accepted steps at most")
    relative_tolerance: float = Field(
        default=1e-9, gt=0, lt=1, description="stop when the cost falls by less than this share"
    )
    absolute_tolerance: float = Field(default=1e-12, gt=0, description="stop when the cost falls by less than this")
    lambda_initial: float = Field(default=1e-5, gt=0, description="damping at the start (Levenberg-Marquardt)")
    retry: bool = Field(default=True, description="try other orderings and a clamped start when the solver stalls")
    robust: RobustSettings = Field(default=RobustSettings(), description="loss on loop constraints")


class StopReason(StrEnum):
    """Why a solver stopped."""

    CONVERGED = "converged"
    """The cost no longer falls and no single node could lower it."""
    ALREADY_OPTIMAL = "already_optimal"
    """The start could not be improved, and its gradient is small: nothing was to be done."""
    MAX_ITERATIONS = "max_iterations"
    STALLED = "stalled"
    """No step lowers the cost although the gradient is not small; the poses are the best met, not an optimum."""
    DIVERGED = "diverged"
    """The cost rose or stopped being finite; the poses are the best met."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IterationRecord:
    """Cost (K,), damping lambda (K,, NaN without one) and seconds (K,) since the start, one entry an iteration.

    Entry 0 is the start.
    """

    cost: FloatArray
    lambda_: FloatArray
    seconds: FloatArray

    def __post_init__(self) -> None:
        for name in ("cost", "lambda_", "seconds"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OptimizerRun:
    """Best poses (N, d+1, d+1) that an optimiser met, why it stopped, and its record.

    `possible_decrease` is the cost that moving each node alone would still save, if the optimiser knows it.
    """

    poses: FloatArray
    stop_reason: StopReason
    record: IterationRecord
    possible_decrease: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SolveResult:
    """Solved poses (N, d+1, d+1) with what the solver did.

    `cost` is the sum of rho over the constraints (half of chi-square without a robust loss), `cost_initial` the same
    at the start; `chi2` (E,) is not robustified; `weights` (E,) are the robust weights at the solution, 1 for
    constraints under no loss. `notes` says what else was tried when the first attempt failed.
    """

    poses: FloatArray
    cost_initial: float
    cost: float
    iterations: int
    stop_reason: StopReason
    record: IterationRecord
    chi2: FloatArray
    weights: FloatArray
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("poses", "chi2", "weights"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def converged(self) -> bool:
        """Whether the poses are a local optimum."""
        return self.stop_reason in (StopReason.CONVERGED, StopReason.ALREADY_OPTIMAL)
