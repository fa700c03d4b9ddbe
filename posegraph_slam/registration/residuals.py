"""What a registration minimises: point-to-point in closed form, point-to-plane by Gauss-Newton."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.geometry import SE2, SE3, align_points
from posegraph_slam.geometry.so3 import hat
from posegraph_slam.jit import kernel
from posegraph_slam.registration.frames import Frame, balanced_frame, split_directions
from posegraph_slam.registration.pairing import Pairs, Scene
from posegraph_slam.registration.settings import IcpSettings, ResidualKind


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


class GeneralisedIcp:
    """Shifts between paired points in the metric of the flat neighbourhoods of both (Segal, Haehnel, Thrun 2009).

    The neighbourhood at a point has variance 1 along its line or plane and `plane_share` across it. The metric is
    scaled so that a shift along two equal normals counts once.
    """

    def __init__(self, degeneracy_ratio: float, plane_share: float) -> None:
        self.degeneracy_ratio, self.plane_share = degeneracy_ratio, plane_share

    def dimension(self, scene: Scene) -> int:
        return 1

    def lengths(self, scene: Scene, pairs: Pairs) -> FloatArray:
        shift = scene.moved[pairs.source] - scene.target.points[pairs.target]
        return np.asarray(np.sqrt(np.einsum("ma,mab,mb->m", shift, self.metric(scene, pairs), shift)))

    def trust(self, scene: Scene, pairs: Pairs) -> FloatArray:
        return np.ones(len(pairs))

    def metric(self, scene: Scene, pairs: Pairs) -> FloatArray:
        """Metric (m, d, d) of every pair: 2 e (C_target + R C_source R^T)^-1 with C = 1 - (1 - e) n n^T."""
        d, e = scene.source.dimension, self.plane_share
        n = scene.target.surface.normals[pairs.target]
        m = scene.source.surface.normals[pairs.source] @ scene.T_target_source[:d, :d].T
        outer = np.einsum("ma,mb->mab", n, n) + np.einsum("ma,mb->mab", m, m)
        return np.asarray(2 * e * np.linalg.inv(2 * np.eye(d) - (1 - e) * outer))

    def improve(self, scene: Scene, pairs: Pairs, weights: FloatArray) -> FloatArray | None:
        d = scene.source.dimension
        group, R = (SE2 if d == 2 else SE3), scene.T_target_source[:d, :d]
        points = scene.source.points[pairs.source]
        centre = points.mean(axis=0)
        radius = max(float(np.sqrt(np.sum((points - centre) ** 2, axis=1).mean())), 1e-9)
        arm = (points - centre) / radius
        if d == 2:  # a turn moves a point at (x, y) by (-y, x)
            turn = np.stack([-arm[:, 1], arm[:, 0]], axis=1)[:, :, None]
            rows = np.concatenate([np.broadcast_to(np.eye(2), (len(arm), 2, 2)), turn], axis=2)
        else:
            rows = np.concatenate([-hat(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3))], axis=2)
        jacobian = R @ rows
        pulled = np.swapaxes(jacobian, 1, 2) @ (weights[:, None, None] * self.metric(scene, pairs))
        shift = scene.moved[pairs.source] - scene.target.points[pairs.target]
        basis, values, _ = split_directions(np.sum(pulled @ jacobian, axis=0), self.degeneracy_ratio)
        if len(values) == 0:
            return None
        step = -basis @ ((basis.T @ np.sum(pulled @ shift[:, :, None], axis=0)[:, 0]) / values)
        return group.retract(scene.T_target_source, balanced_frame(centre, radius).to_origin @ step)


def residual_for(settings: IcpSettings) -> Residual:
    """Return the residual that `settings` names."""
    if settings.residual is ResidualKind.POINT_TO_POINT:
        return PointToPoint()
    if settings.residual is ResidualKind.GENERALISED:
        return GeneralisedIcp(settings.degeneracy_ratio, settings.plane_share)
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
