"""Closed-form rigid alignment of paired points in the plane and in space (Kabsch 1976, Umeyama 1991)."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray

RANK_TOLERANCE = 1e-9
"""Singular values under this share of the largest count as zero: points within 3e-5 of their length from a line."""


def align_points(
    source: FloatArray, target: FloatArray, weights: FloatArray | None = None, *, with_scale: bool = False
) -> tuple[FloatArray, float, bool]:
    """Find T_target_source minimising sum w |s R x + p - y|^2 over rotations (never a reflection).

    `source`, `target` (n, d) paired points, d = 2 or 3, `weights` (n,) non-negative. Returns the transform (d+1, d+1)
    with s R as its linear part, the scale s (1 unless asked for) and whether the rotation is determined: False where
    several rotations are equally good (one spot; one line in space; a reflection of equal smallest singular values),
    in which case the one of them that turns least is returned.
    With Q = sum w dy dx^T = U S V^T the rotation is U diag(1, .., det(U V^T)) V^T (Umeyama 1991, eq. 40-42).
    """
    d = source.shape[1]
    w = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=np.float64)
    total = w.sum()
    if len(source) == 0 or total <= 0:
        return np.eye(d + 1), 1.0, False
    mean_source, mean_target = w @ source / total, w @ target / total
    centred_source, centred_target = source - mean_source, target - mean_target
    R, quality, determined = _best_rotation((centred_target * w[:, None]).T @ centred_source)
    spread = float(w @ np.sum(centred_source**2, axis=1))
    scale = quality / spread if with_scale and spread > 0 else 1.0
    T = np.eye(d + 1)
    T[:d, :d], T[:d, d] = scale * R, mean_target - scale * R @ mean_source
    return T, scale, determined


def _best_rotation(Q: FloatArray) -> tuple[FloatArray, float, bool]:
    """Rotation R (d, d) that maximises tr(Q^T R), that maximum, and whether R is the only one."""
    R, S = _rotation_and_values(Q)
    # the two smallest signed values sum to the cost of turning in their plane; zero leaves that turn free
    determined = bool(S[-2] + S[-1] > RANK_TOLERANCE * S[0])
    if not determined:  # a small share of the identity picks the least turn among the equally good
        R, _ = _rotation_and_values(Q + (RANK_TOLERANCE * S[0] if S[0] > 0 else 1.0) * np.eye(len(Q)))
    return R, float(S.sum()), determined


def _rotation_and_values(Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Nearest rotation to Q, and its singular values with the sign of det(U V^T) on the last one."""
    U, S, Vt = np.linalg.svd(Q)
    sign = 1.0 if np.linalg.det(U @ Vt) > 0 else -1.0
    # the sign goes to one column of U: negating the whole matrix would leave a planar reflection a reflection
    U[:, -1] *= sign
    S[-1] *= sign
    return U @ Vt, S
