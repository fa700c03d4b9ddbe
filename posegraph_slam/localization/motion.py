"""Propagation of particles by odometry, with noise that scales with the motion."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel
from posegraph_slam.localization.settings import MotionNoise


def step_sigmas(increments: FloatArray, noise: MotionNoise) -> FloatArray:
    """Return the sigmas (..., 2) [m, rad] of body-frame motions (..., 3) [x, y, theta]."""
    way, turn = np.hypot(increments[..., 0], increments[..., 1]), np.abs(increments[..., 2])
    position = noise.translation_per_sqrt_m**2 * way + noise.translation_per_sqrt_rad**2 * turn + noise.floor_m**2
    heading = noise.rotation_per_sqrt_m**2 * way + noise.rotation_per_sqrt_rad**2 * turn + noise.floor_rad**2
    return np.sqrt(np.stack([position, heading], axis=-1))


def propagate(particles: FloatArray, increment: FloatArray, noise: MotionNoise, rng: np.random.Generator) -> FloatArray:
    """Move particles (N, 3) by the body-frame odometry step `increment` (3,) and independent noise on it.

    x' = R(theta) (dx + e) + x and theta' = theta + dtheta + e: the step is turned into each particle's own frame.
    """
    sigma = step_sigmas(np.asarray(increment), noise)
    return np.asarray(moved(particles, np.asarray(increment), sigma, rng.standard_normal(particles.shape)))


@kernel
def moved(particles, increment, sigma, normals):  # type: ignore[no-untyped-def]
    """Return the particles (N, 3) moved by `increment` (3,) plus `normals` (N, 3) times sigma [m, rad]."""
    result = np.empty_like(particles)
    for k in range(len(particles)):
        c, s = np.cos(particles[k, 2]), np.sin(particles[k, 2])
        dx, dy = increment[0] + sigma[0] * normals[k, 0], increment[1] + sigma[0] * normals[k, 1]
        result[k, 0] = particles[k, 0] + c * dx - s * dy
        result[k, 1] = particles[k, 1] + s * dx + c * dy
        theta = particles[k, 2] + increment[2] + sigma[1] * normals[k, 2]
        result[k, 2] = (theta + np.pi) % (2 * np.pi) - np.pi
    return result
