"""The Lie groups SO(2), SE(2), SO(3), SE(3) on stacked matrices, one record each.

A pose is a homogeneous matrix (d+1, d+1), a rotation a matrix (d, d); every function takes any batch shape in front.
Tangents follow GTSAM: SE(2) [x, y, theta], SE(3) [rotation, translation]; updates act on the right, T exp(d).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import so2, so3, spatial


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """A Lie group: matrix size, tangent size and its maps on stacked arrays.

    `exp` (..., p) -> (..., n, n); `log` its inverse; `adjoint` (..., p, p) with T exp(d) T^-1 = exp(Ad d);
    `right_jacobian` (..., p, p) with exp(d + e) ~ exp(d) exp(Jr(d) e).
    """

    name: str
    dimension: int
    """Dimension of the space that the group acts on."""
    dof: int
    matrix_size: int
    exp: Callable[[FloatArray], FloatArray]
    log: Callable[[FloatArray], FloatArray]
    inverse: Callable[[FloatArray], FloatArray]
    adjoint: Callable[[FloatArray], FloatArray]
    right_jacobian: Callable[[FloatArray], FloatArray]

    def rotation_part(self, tangent: FloatArray) -> FloatArray:
        """Return the rotation (..., p - d) of pose tangents (..., p), which is last in SE(2) and first in SE(3)."""
        return tangent[..., 2:] if self.dimension == 2 else tangent[..., :3]

    def translation_part(self, tangent: FloatArray) -> FloatArray:
        """Return the translation (..., d) of pose tangents (..., p)."""
        return tangent[..., :2] if self.dimension == 2 else tangent[..., 3:]

    def identity(self, *batch: int) -> FloatArray:
        """Return stacked identities of shape (*batch, n, n)."""
        return np.broadcast_to(np.eye(self.matrix_size), (*batch, self.matrix_size, self.matrix_size)).copy()

    def compose(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return a @ b for stacked elements."""
        return a @ b

    def between(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return a^-1 b: the pose of b in the frame of a."""
        return self.inverse(a) @ b

    def retract(self, a: FloatArray, delta: FloatArray) -> FloatArray:
        """Return a exp(delta)."""
        return a @ self.exp(delta)

    def local(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return log(a^-1 b), the inverse of `retract`."""
        return self.log(self.between(a, b))


SO2 = Group(name="SO(2)", dimension=2, dof=1, matrix_size=2, exp=so2.exp_rotation, log=so2.log_rotation,
            inverse=so2.transpose, adjoint=so2.adjoint_rotation, right_jacobian=so2.adjoint_rotation)  # fmt: skip
SE2 = Group(name="SE(2)", dimension=2, dof=3, matrix_size=3, exp=so2.exp_pose, log=so2.log_pose,
            inverse=spatial.inverse_pose, adjoint=so2.adjoint_pose,
            right_jacobian=so2.right_jacobian_pose)  # fmt: skip
SO3 = Group(name="SO(3)", dimension=3, dof=3, matrix_size=3, exp=so3.exp_rotation, log=so3.log_rotation,
            inverse=so2.transpose, adjoint=so3.adjoint_rotation,
            right_jacobian=so3.right_jacobian_rotation)  # fmt: skip
SE3 = Group(name="SE(3)", dimension=3, dof=6, matrix_size=4, exp=so3.exp_pose, log=so3.log_pose,
            inverse=spatial.inverse_pose, adjoint=so3.adjoint_pose,
            right_jacobian=so3.right_jacobian_pose)  # fmt: skip
