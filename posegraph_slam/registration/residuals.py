"""What a registration minimises: point-to-point in closed form, point-to-plane by Gauss-Newton."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE2, SE3, align_points
from posegraph_slam.registration.pairing import Pairs, Scene
from posegraph_slam.registration.settings import IcpSettings, ResidualKind
from posegraph_slam.registration.uncertainty import Frame, balanced_frame, plane_jacobian, split_directions


class Residual(Protocol):
    """A cost over pairs and the step that lowers it."""

    def dimension(self, scene: Scene) -> int:
        """Components of the residual of one pair."""

    def lengths(self, scene: Scene, pairs: Pairs) -> FloatArray:
        """Length of the residual (m,) of every pair."""

    def trust(self, scene: Scene, pairs: Pairs) -> FloatArray:
        """Weight (m,) of every pair by what is known of its target before any residual is seen."""

    def improve(self, scene: Scene, pairs: Pairs, weights: FloatArray) -> FloatArray | None:
        """Return a better T_target_source, or None where the pairs say nothing."""


class PointToPoint:
    """Distance between paired points, minimised in closed form by `align_points`."""

    def dimension(self, scene: Scene) -> int:
        return scene.source.dimension

    def lengths(self, scene: Scene, pairs: Pairs) -> FloatArray:
        return np.asarray(np.linalg.norm(scene.moved[pairs.source] - scene.target.points[pairs.target], axis=1))

    def trust(self, scene: Scene, pairs: Pairs) -> FloatArray:
        return np.ones(len(pairs))

    def improve(self, scene: Scene, pairs: Pairs, weights: FloatArray) -> FloatArray | None:
        T, _, determined = align_points(scene.source.points[pairs.source], scene.target.points[pairs.target], weights)
        return T if determined else None


class PointToPlane:
    """Distance to the tangent line (2D) or plane (3D) of the target; free directions keep their present value."""

    def __init__(self, degeneracy_ratio: float) -> None:
        self.degeneracy_ratio = degeneracy_ratio

    def dimension(self, scene: Scene) -> int:
        return 1

    def lengths(self, scene: Scene, pairs: Pairs) -> FloatArray:
        return np.abs(plane_residuals(scene, pairs))

    def trust(self, scene: Scene, pairs: Pairs) -> FloatArray:
        return scene.target.surface.trust[pairs.target]

    def improve(self, scene: Scene, pairs: Pairs, weights: FloatArray) -> FloatArray | None:
        frame, jacobian = linearise(scene, pairs)
        weighted = jacobian * weights[:, None]
        basis, values, _ = split_directions(jacobian.T @ weighted, self.degeneracy_ratio)
        if len(values) == 0:
            return None
        step = -basis @ ((basis.T @ (weighted.T @ plane_residuals(scene, pairs))) / values)
        group = SE2 if scene.source.dimension == 2 else SE3
        return group.retract(scene.T_target_source, frame.to_origin @ step)


def residual_for(settings: IcpSettings) -> Residual:
    """Return the residual that `settings` names."""
    if settings.residual is ResidualKind.POINT_TO_POINT:
        return PointToPoint()
    return PointToPlane(settings.degeneracy_ratio)


def plane_residuals(scene: Scene, pairs: Pairs) -> FloatArray:
    """Signed distances (m,) of the moved source points to the tangent lines or planes of their target points."""
    offset = scene.moved[pairs.source] - scene.target.surface.anchors[pairs.target]
    return np.asarray(np.einsum("md,md->m", offset, scene.target.surface.normals[pairs.target]))


def linearise(scene: Scene, pairs: Pairs) -> tuple[Frame, FloatArray]:
    """Return the balanced tangent frame and the Jacobian (m, p) of `plane_residuals` in it."""
    d = scene.source.dimension
    points = scene.source.points[pairs.source]
    frame = balanced_frame(points)
    return frame, plane_jacobian(
        points, scene.target.surface.normals[pairs.target] @ scene.T_target_source[:d, :d], frame
    )
