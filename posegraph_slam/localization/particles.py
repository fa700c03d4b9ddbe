"""The state of the filter: weighted particles in hypotheses, their means and covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.geometry import wrap_angle
from posegraph_slam.jit import kernel
from posegraph_slam.localization.resampling import normalised


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Particles:
    """`poses` (N, 3) [x, y, theta] with `log_weights` (N,); `hypothesis` (N,) numbers the place each stems from."""

    poses: FloatArray
    log_weights: FloatArray
    hypothesis: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "poses", read_only(self.poses))
        object.__setattr__(self, "log_weights", read_only(self.log_weights))
        object.__setattr__(self, "hypothesis", read_only(self.hypothesis, np.int64))

    def __len__(self) -> int:
        return int(self.poses.shape[0])

    @property
    def weights(self) -> FloatArray:
        """Weights (N,) that add up to one."""
        return normalised(self.log_weights)

    def with_poses(self, poses: FloatArray) -> Particles:
        """Return the particles moved to `poses`."""
        return Particles(poses=poses, log_weights=self.log_weights, hypothesis=self.hypothesis)

    def with_log_weights(self, log_weights: FloatArray) -> Particles:
        """Return the particles with other weights."""
        return Particles(poses=self.poses, log_weights=log_weights, hypothesis=self.hypothesis)

    def drawn(self, index: IntArray) -> Particles:
        """Return the particles at `index`, all of one weight."""
        return Particles(poses=self.poses[index], log_weights=np.zeros(len(index)), hypothesis=self.hypothesis[index])


def around(pose: FloatArray, sigmas: FloatArray, count: int, hypothesis: int, rng: np.random.Generator) -> Particles:
    """Draw `count` particles about `pose` (3,) with sigmas (3,) of x, y and heading."""
    poses = pose + sigmas * rng.standard_normal((count, 3))
    poses[:, 2] = wrap_angle(poses[:, 2])
    return Particles(poses=poses, log_weights=np.zeros(count), hypothesis=np.full(count, hypothesis))


def joined(parts: list[Particles]) -> Particles:
    """Return the particles of all parts, weights as they are."""
    return Particles(
        poses=np.concatenate([part.poses for part in parts]),
        log_weights=np.concatenate([part.log_weights for part in parts]),
        hypothesis=np.concatenate([part.hypothesis for part in parts]),
    )


@kernel
def moments(poses, weights, used):  # type: ignore[no-untyped-def]
    """Mean (3,) of the particles marked in `used`, covariance (3, 3) in the mean's own frame, and weight."""
    total, sx, sy, sc, ss = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(poses)):
        if used[k]:
            w = weights[k]
            total += w
            sx += w * poses[k, 0]
            sy += w * poses[k, 1]
            sc += w * np.cos(poses[k, 2])
            ss += w * np.sin(poses[k, 2])
    mean, covariance = np.zeros(3), np.zeros((3, 3))
    if total <= 0.0:
        return mean, covariance, 0.0
    mean[0], mean[1], mean[2] = sx / total, sy / total, np.arctan2(ss, sc)
    c, s = np.cos(mean[2]), np.sin(mean[2])
    d = np.zeros(3)
    for k in range(len(poses)):
        if used[k]:
            dx, dy = poses[k, 0] - mean[0], poses[k, 1] - mean[1]
            d[0], d[1] = c * dx + s * dy, -s * dx + c * dy
            d[2] = (poses[k, 2] - mean[2] + np.pi) % (2 * np.pi) - np.pi
            for i in range(3):
                for j in range(3):
                    covariance[i, j] += weights[k] / total * d[i] * d[j]
    return mean, covariance, total


def hypothesis_weights(particles: Particles, weights: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the numbers (H,) of the hypotheses and the weight (H,) of each."""
    numbers, inverse = np.unique(particles.hypothesis, return_inverse=True)
    return numbers, np.asarray(np.bincount(inverse, weights=weights), dtype=np.float64)


def merged(particles: Particles, gap_m: float, gap_rad: float) -> Particles:
    """Join hypotheses whose means lie within the gaps; the lower number, the older one, stays."""
    numbers = np.unique(particles.hypothesis)
    if len(numbers) < 2:
        return particles
    weights = particles.weights
    means = np.stack([moments(particles.poses, weights, particles.hypothesis == n)[0] for n in numbers])
    near = (np.hypot(*(means[:, None, :2] - means[None, :, :2]).transpose(2, 0, 1)) < gap_m) & (
        np.abs(wrap_angle(means[:, None, 2] - means[None, :, 2])) < gap_rad
    )
    first = numbers[near.argmax(axis=1)]
    if (first == numbers).all():
        return particles
    return Particles(
        poses=particles.poses,
        log_weights=particles.log_weights,
        hypothesis=first[np.searchsorted(numbers, particles.hypothesis)],
    )
