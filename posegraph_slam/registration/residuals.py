"""What a registration minimises: point-to-point in closed form, point-to-plane by Gauss-Newton."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.geometry import SE2, SE3, align_points
from posegraph_slam.jit import kernel
from posegraph_slam.registration.pairing import Pairs, Scene
from posegraph_slam.registration.settings import IcpSettings, ResidualKind
from posegraph_slam.registration.uncertainty import Frame, balanced_frame, split_directions


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
    surface = scene.target.surface
    return signed_distances(scene.moved, pairs.source, surface.anchors, surface.normals, pairs.target)


def linearise(scene: Scene, pairs: Pairs) -> tuple[Frame, FloatArray]:
    """Return the balanced tangent frame and the Jacobian (m, p) of `plane_residuals` in it."""
    d = scene.source.dimension
    R = np.ascontiguousarray(scene.T_target_source[:d, :d])
    centre, radius, jacobian = plane_jacobian(
        scene.source.points, pairs.source, scene.target.surface.normals, pairs.target, R
    )
    return balanced_frame(centre, radius), jacobian


@kernel
def signed_distances(
    moved: FloatArray, source: IntArray, anchors: FloatArray, normals: FloatArray, target: IntArray
) -> FloatArray:
    """Distances n . (x - q) (m,) of rows `source` of moved (n, d) to the planes at rows `target`."""
    result = np.zeros(len(source))
    for row in range(len(source)):
        s, t = source[row], target[row]
        for a in range(moved.shape[1]):
            result[row] += (moved[s, a] - anchors[t, a]) * normals[t, a]
    return result


@kernel
def plane_jacobian(
    points: FloatArray, source: IntArray, normals: FloatArray, target: IntArray, R: FloatArray
) -> tuple[FloatArray, float, FloatArray]:
    """Centre (d,) and root mean square radius of the paired source points, and the Jacobian (m, p) about them.

    With arm a = (x - centre) / radius and the normal in the source frame n = R^T n_t, the right update moves the
    residual by dr/dv = n and dr/dw = a x n (Chen and Medioni 1992), in GTSAM's order.
    """
    m, d = len(source), points.shape[1]
    centre = np.zeros(d)
    for row in range(m):
        centre += points[source[row]] / m
    square = 0.0
    for row in range(m):
        for a in range(d):
            square += (points[source[row], a] - centre[a]) ** 2 / m
    radius = max(np.sqrt(square), 1e-9)
    jacobian = np.empty((m, 3 * (d - 1)))
    arm, n = np.zeros(d), np.zeros(d)
    for row in range(m):
        for a in range(d):
            arm[a] = (points[source[row], a] - centre[a]) / radius
            n[a] = 0.0
            for b in range(d):
                n[a] += R[b, a] * normals[target[row], b]
        if d == 2:
            jacobian[row, 0], jacobian[row, 1] = n[0], n[1]
            jacobian[row, 2] = arm[0] * n[1] - arm[1] * n[0]
        else:
            jacobian[row, 0] = arm[1] * n[2] - arm[2] * n[1]
            jacobian[row, 1] = arm[2] * n[0] - arm[0] * n[2]
            jacobian[row, 2] = arm[0] * n[1] - arm[1] * n[0]
            jacobian[row, 3], jacobian[row, 4], jacobian[row, 5] = n[0], n[1], n[2]
    return centre, radius, jacobian
