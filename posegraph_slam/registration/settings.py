"""Settings of the iterative closest point loop."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from functools import cached_property
from typing import Any, Self

from pydantic import Field

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.settings import Settings


class ResidualKind(StrEnum):
    """What is minimised between paired points."""

    POINT_TO_POINT = "point_to_point"
    """Distance between the points; solved in closed form (Kabsch)."""
    POINT_TO_PLANE = "point_to_plane"
    """Distance to the target's tangent plane, in 2D its tangent line; solved by Gauss-Newton."""
    GENERALISED = "generalised"
    """Distance weighed by the flat neighbourhoods of both points (generalised ICP); solved by Gauss-Newton."""


class AssociationKind(StrEnum):
    """How the nearest target point is searched; the pairs are the same, ties apart."""

    KD_TREE = "kd_tree"
    VOXEL_HASH = "voxel_hash"


class Loss(StrEnum):
    """Robust loss that weighs residuals down as they grow."""

    NONE = "none"
    HUBER = "huber"
    CAUCHY = "cauchy"
    GEMAN_MCCLURE = "geman_mcclure"
    TUKEY = "tukey"


class IcpSettings(Settings):
    """How two point sets are registered; lengths in metres, angles in radians. The defaults suit indoor laser scans."""

    residual: ResidualKind = ResidualKind.POINT_TO_PLANE
    """What is minimised; point_to_plane means point-to-line in 2D."""
    association: AssociationKind | None = None
    """How neighbours are searched: kd_tree or voxel_hash, in the loop of parts. None takes the compiled loop, with the
    KD-tree, wherever it has all that is asked for: everything but normal angles and reciprocal pairs."""
    max_distance_m: float = Field(default=0.5, gt=0)
    """Pairs farther apart are dropped."""
    keep_fraction: float = Field(default=1.0, gt=0, le=1)
    """Share of the nearest pairs that is kept (trimming)."""
    max_normal_angle_rad: float | None = Field(default=None, gt=0, le=math.pi / 2)
    """Pairs whose surface normals differ by more are dropped; none for no such test."""
    reciprocal: bool = False
    """Keep a pair only if its source point is also the nearest one to its target point."""
    loss: Loss = Loss.CAUCHY
    """Robust loss on the residuals of the remaining pairs."""
    loss_scale_m: float | None = Field(default=None, gt=0)
    """Standard deviation in which the loss measures a residual; none estimates it from the residuals at each step."""
    max_iterations: int = Field(default=50, ge=1, le=10_000)
    """Steps after which the loop stops without having converged."""
    rotation_tolerance_rad: float = Field(default=1e-5, gt=0, lt=0.1)
    """A step that turns less, and moves less than `translation_tolerance_m`, ends the loop."""
    translation_tolerance_m: float = Field(default=1e-5, gt=0, lt=0.1)
    """A step that moves less, and turns less than `rotation_tolerance_rad`, ends the loop."""
    min_inliers: int = Field(default=10, ge=3)
    """Fewer pairs than this end in a failure."""
    min_inlier_fraction: float = Field(default=0.1, ge=0, le=1)
    """A smaller share of paired source points ends in a failure."""
    normal_neighbours: int = Field(default=10, ge=3, le=1000)
    """Nearest points, itself among them, to which the tangent line or plane at a point is fitted."""
    plane_share: float = Field(default=1e-3, gt=0, le=1)
    """Variance of a neighbourhood across its line or plane, over that along it, in generalised ICP."""
    degeneracy_ratio: float = Field(default=0.01, gt=0, lt=1)
    """A direction whose share of the Hessian's largest eigenvalue is smaller counts as free."""
    sigma_floor_m: float = Field(default=1e-3, gt=0)
    """The residuals' standard deviation is taken as no smaller, so that perfect data are not infinitely certain."""
    free_sigma_m: float = Field(default=1.0, gt=0)
    """Standard deviation given to directions that the points leave free: the floor under the information."""

    uncertainty: bool = True
    """Whether information and free directions are worked out; without, zero and all directions come back, sooner."""

    @cached_property
    def for_kernels(self) -> tuple[int, int, FloatArray]:
        """Residual and loss as numbers, and the other values in the order that the kernels expect."""
        options = [
            self.max_distance_m, self.keep_fraction, self.loss_scale_m or 0.0, self.max_iterations,
            self.rotation_tolerance_rad, self.translation_tolerance_m, self.min_inliers, self.degeneracy_ratio,
            self.plane_share, self.sigma_floor_m, self.free_sigma_m, self.min_inlier_fraction, self.uncertainty,
        ]  # fmt: skip
        return list(ResidualKind).index(self.residual), list(Loss).index(self.loss), read_only(options)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Copy the settings with some of them changed; what was worked out for the kernels is not taken along."""
        copy = super().model_copy(update=update, deep=deep)
        copy.__dict__.pop("for_kernels", None)
        return copy

    @classmethod
    def point_to_point(cls) -> IcpSettings:
        """Plain trimmed Kabsch ICP as in the course report's scan matching: unweighted, in closed form.

        It creeps along walls: tolerances of 0.1 mm and 0.1 mrad take 31 rounds a pair of 1081 beams, a tenth of
        them 43 for an error 0.7 mm smaller.
        """
        return cls(
            residual=ResidualKind.POINT_TO_POINT,
            loss=Loss.NONE,
            keep_fraction=0.9,
            max_iterations=100,
            rotation_tolerance_rad=1e-4,
            translation_tolerance_m=1e-4,
        )

    @classmethod
    def point_to_line(cls) -> IcpSettings:
        """The default: Gauss-Newton on the distance to tangent lines (planes in 3D) with a Cauchy loss."""
        return cls()

    @classmethod
    def generalised(cls) -> IcpSettings:
        """Generalised ICP (Segal, Haehnel and Thrun 2009) with a Cauchy loss, for scans in space."""
        return cls(residual=ResidualKind.GENERALISED, max_distance_m=1.0)
