"""Search of a window of poses for the one at which a scan fits several reference scans, without a good guess."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.correlative import (
    FIELD_MAX,
    NO_DISC,
    branch_and_bound,
    likelihood_field,
    max_pooled,
    rotated_cells,
)
from posegraph_slam.settings import Settings


class LocalSearchSettings(Settings):
    """Likelihood field and points of the branch-and-bound search."""

    resolution_m: float = Field(default=0.1, gt=0)
    """Cell of the likelihood field and step of the search."""
    sigma_m: float = Field(default=0.1, gt=0)
    """Standard deviation of the Gaussian that each reference point leaves in the field."""
    range_max_m: float = Field(default=15.0, gt=0)
    """Points further from their sensor are left out; they sit on few, distant surfaces."""
    points_max: int = Field(default=120, ge=10)
    """The scan is represented by at most this many points."""

    rival_share: float = Field(default=0.9, gt=0, le=1)
    """A pose elsewhere in the window that reaches this share of the best score makes the result ambiguous; 1: never."""
    rival_distance_m: float = Field(default=1.5, gt=0)
    """Elsewhere is further than this from the best pose."""

    def vector(self) -> FloatArray:
        """Return the values in the order that `search_pose` expects."""
        return np.array(
            [
                self.resolution_m,
                self.sigma_m,
                self.range_max_m,
                self.points_max,
                self.rival_share,
                self.rival_distance_m,
            ]
        )


@kernel
def _place(refs, ref_poses, range_max, points, kind):  # type: ignore[no-untyped-def]
    """Returns of the reference scans within `range_max` of their sensor, in the common frame (n, 2)."""
    beams = kind.shape[1]
    placed = np.empty((len(refs) * beams, 2))
    count = 0
    for r in range(len(refs)):
        c, s = np.cos(ref_poses[r, 2]), np.sin(ref_poses[r, 2])
        for b in range(beams):
            x, y = points[refs[r], b, 0], points[refs[r], b, 1]
            if kind[refs[r], b] > 0 and x * x + y * y <= range_max * range_max:
                placed[count, 0] = c * x - s * y + ref_poses[r, 0]
                placed[count, 1] = s * x + c * y + ref_poses[r, 1]
                count += 1
    return placed[:count]


@kernel
def _source_points(source, range_max, points_max, points, thinned):  # type: ignore[no-untyped-def]
    """Evenly picked points (n, 2), `points_max` at most, of the scan within `range_max`, and their largest range."""
    beams = thinned.shape[1]
    chosen = np.empty(beams, np.int64)
    count, farthest = 0, 0.0
    for b in range(beams):
        r = np.hypot(points[source, b, 0], points[source, b, 1])
        if thinned[source, b] and r <= range_max:
            chosen[count] = b
            count += 1
            farthest = max(farthest, r)
    stride = max(1, (count + points_max - 1) // points_max)
    picked = np.empty(((count + stride - 1) // stride, 2))
    for k in range(len(picked)):
        b = chosen[k * stride]
        picked[k, 0], picked[k, 1] = points[source, b, 0], points[source, b, 1]
    return picked, farthest


@kernel
def search_pose(source, refs, ref_poses, start, reach_m, reach_rad, score_min, settings, points, kind, thinned):  # type: ignore[no-untyped-def]
    """Find the pose of scan `source` within `reach_m` and `reach_rad` of `start` that fits the scans `refs` best.

    `ref_poses` (R, 3) and `start` share one frame; `settings` as from `LocalSearchSettings.vector`. Returns the pose,
    its score in [0, 1], and whether a pose elsewhere scores nearly as high (`rival_share`); `start`, 0 and False when
    no pose scores `score_min`, or there is nothing to compare.
    """
    resolution, sigma, range_max, points_max = settings[0], settings[1], settings[2], int(settings[3])
    rival_share, rival_distance = settings[4], settings[5]
    target = _place(refs, ref_poses, range_max, points, kind)
    cloud, farthest = _source_points(source, range_max, points_max, points, thinned)
    if len(target) < 10 or len(cloud) < 10:
        return start.copy(), 0.0, False
    apart = int(np.ceil(rival_distance / resolution))
    reach = max(int(np.ceil(reach_m / resolution)), 1)
    levels = 0
    while levels < 6 and (2 << levels) <= reach:
        levels += 1
    low_x, low_y = target[:, 0].min() - 3 * sigma, target[:, 1].min() - 3 * sigma
    origin = np.array([low_x, low_y])
    columns = int((target[:, 0].max() + 3 * sigma - low_x) / resolution) + 1
    rows = int((target[:, 1].max() + 3 * sigma - low_y) / resolution) + 1
    pad = 1 << levels
    field = likelihood_field(target, origin, resolution, rows, columns, pad, sigma)
    step = resolution / max(farthest, 1.0)
    half = int(np.ceil(reach_rad / step))
    angles = step * np.arange(-half, half + 1)
    cells = rotated_cells(cloud, start, angles, origin, resolution, pad)
    stack = max_pooled(field, levels)
    a, dx, dy, score = branch_and_bound(stack, cells, reach, int(score_min * FIELD_MAX * len(cloud)), NO_DISC)
    if score < 0:
        return start.copy(), 0.0, False
    rival = False
    if reach > apart and rival_share < 1.0:
        rival = branch_and_bound(stack, cells, reach, int(rival_share * score), (dx, dy, apart))[3] >= 0
    pose = np.array([start[0] + dx * resolution, start[1] + dy * resolution, start[2] + angles[a]])
    return pose, score / (FIELD_MAX * len(cloud)), rival
