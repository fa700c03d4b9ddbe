"""Closed-form rigid alignment of paired points in any dimension (Kabsch 1976, Umeyama 1991)."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray


def align_points(
    source: FloatArray, target: FloatArray, weights: FloatArray | None = None, *, with_scale: bool = False
) -> tuple[FloatArray, float, bool]:
    """Find T_target_source minimising sum w |R s + p - t|^2 over rotations (never a reflection).

    `source`, `target` (n, d) paired points, `weights` (n,) non-negative. Returns the transform (d+1, d+1), the scale
    (1 unless asked for) and whether the rotation is determined: False where the points, or their weights, leave a
    direction free (fewer than d independent ones), in which case a rotation of least turn about it is returned.
    With Q = sum w dm dz^T = U S V^T the rotation is U diag(1, .., det(U V^T)) V^T (eq. 29-34 of the course report).
    """
    d = source.shape[1]
    w = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=np.float64)
    total = w.sum()
    if len(source) == 0 or total <= 0:
        return np.eye(d + 1), 1.0, False
    mean_source, mean_target = w @ source / total, w @ target / total
    centred_source, centred_target = source - mean_source, target - mean_target
    Q = (centred_target * w[:, None]).T @ centred_source
    U, S, Vt = np.linalg.svd(Q)
    signs = np.ones(d)
    signs[-1] = np.sign(np.linalg.det(U @ Vt))
    R = (U * signs) @ Vt
    spread = float(w @ np.sum(centred_source**2, axis=1))
    scale = float(S @ signs) / spread if with_scale and spread > 0 else 1.0
    # d-1 independent directions fix a rotation; an equal pair of smallest values under a reflection does not
    margin = S[-2] + signs[-1] * S[-1]
    determined = bool(S[0] > 0 and margin > 1e-9 * S[0])
    T = np.eye(d + 1)
    T[:d, :d], T[:d, d] = scale * R, mean_target - scale * R @ mean_source
    return T, scale, determined
