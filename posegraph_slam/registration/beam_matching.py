"""Point-to-line matching of a laser scan to several reference scans at once, in numba.

The source scan is moved until its points lie on the lines of all reference scans (Censi 2008, with the references
placed in one frame by their known poses). Neighbours are found by bearing; a correspondence counts only where both
surfaces face the same way, so that the two sides of a wall are not taken for one.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import FloatArray
from posegraph_slam.jit import kernel
from posegraph_slam.registration.beam_scans import GEOMETRY_HEAD
from posegraph_slam.settings import Settings

NORMAL_SIGMA_RAD = 0.07
"""Standard deviation of a fitted normal: 1-2 cm of noise over the 0.2-0.4 m that a line is fitted to."""


class BeamMatchSettings(Settings):
    """How a scan is matched to lines of reference scans."""

    gate_start_m: float = Field(default=0.5, gt=0)
    """Correspondences further apart than this do not count in the first iteration."""
    gate_m: float = Field(default=0.25, gt=0)
    """The same once the gate has shrunk, by half of the difference an iteration."""
    robust_start_m: float = Field(default=0.3, gt=0)
    """Scale of the Geman-McClure weight in the first iteration."""
    robust_m: float = Field(default=0.08, gt=0)
    """The same once it has shrunk."""
    sigma_m: float = Field(default=0.03, gt=0)
    """Standard deviation of a point's distance to its line."""
    normal_angle_max_rad: float = Field(default=1.05, gt=0, lt=3.2)
    """Surfaces that face further apart than this are not the same."""
    iterations_max: int = Field(default=12, ge=4)
    """Steps after which the matching stops."""
    rotation_tolerance_rad: float = Field(default=1e-4, gt=0)
    """A step that turns less, and moves less than `translation_tolerance_m`, ends the matching."""
    translation_tolerance_m: float = Field(default=1e-3, gt=0)
    """A step that moves less, and turns less than `rotation_tolerance_rad`, ends the matching."""

    def vector(self) -> FloatArray:
        """Return the values in the order that `match_scan` expects."""
        return np.array(
            [
                max(self.gate_start_m, self.gate_m),
                self.gate_m,
                max(self.robust_start_m, self.robust_m),
                self.robust_m,
                self.sigma_m,
                np.cos(self.normal_angle_max_rad),
                self.iterations_max,
                self.rotation_tolerance_rad,
                self.translation_tolerance_m,
            ]
        )


@kernel
def compose(a, b):  # type: ignore[no-untyped-def]
    """Compose planar poses [x, y, theta]."""
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]])


@kernel
def between(a, b):  # type: ignore[no-untyped-def]
    """Return a^-1 b for planar poses [x, y, theta], theta wrapped into [-pi, pi)."""
    c, s = np.cos(a[2]), np.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    theta = (b[2] - a[2] + np.pi) % (2 * np.pi) - np.pi
    return np.array([c * dx + s * dy, -s * dx + c * dy, theta])


@kernel
def accumulate(source, ref, pose, gate, robust, min_cosine, points, lines, kind, thinned, geometry, H, g):  # type: ignore[no-untyped-def]
    """Add the point-to-line terms of scan `source` at `pose` (in the frame of scan `ref`) to H (3, 3) and g (3,).

    The nearest return of the reference is found exactly by growing a window of bearings: a return within distance d
    of a point at range r lies within asin(d / r) of its bearing. Weights follow Geman-McClure with scale `robust`.
    Returns the number of source points in view of the reference, of those with a correspondence, the sum of weights
    and of weighted squared residuals. All is in one body: a helper that takes arrays costs their reference counts
    at every point.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    angle_min, increment = geometry[0], geometry[1]
    beams = kind.shape[1]
    turn = int(np.round(2 * np.pi / increment))
    unseen = (turn - beams) // 2
    q = robust * robust
    seen, matched, weight_sum, error_sum = 0, 0, 0.0, 0.0
    h00, h01, h02, h11, h12, h22, g0, g1, g2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for b in range(beams):
        if not thinned[source, b]:
            continue
        px, py = points[source, b, 0], points[source, b, 1]
        x, y = c * px - s * py + pose[0], s * px + c * py + pose[1]
        r2 = x * x + y * y
        centre = int(np.round((np.arctan2(y, x) - angle_min) / increment))
        if centre < -unseen:
            centre += turn
        elif centre >= beams + unseen:
            centre -= turn
        if 0 <= centre < beams:
            seen += 1
        best, best_d2 = -1, gate * gate
        for offset in range(beams):
            if r2 * geometry[GEOMETRY_HEAD + offset] > best_d2:
                break
            for side in range(2):
                if offset == 0 and side == 1:
                    continue
                k = centre + offset if side == 1 else centre - offset
                if beams >= turn:
                    k %= turn
                if k < 0 or k >= beams or kind[ref, k] == 0:
                    continue
                d2 = (points[ref, k, 0] - x) ** 2 + (points[ref, k, 1] - y) ** 2
                if d2 < best_d2:
                    best, best_d2 = k, d2
        if best < 0 or kind[ref, best] != 2:
            continue
        nx, ny = lines[ref, best, 0], lines[ref, best, 1]
        if kind[source, b] == 2:
            mx, my = lines[source, b, 0], lines[source, b, 1]
            if nx * (c * mx - s * my) + ny * (s * mx + c * my) < min_cosine:
                continue
        e = nx * x + ny * y - lines[ref, best, 2]
        w = (q / (q + e * e)) ** 2
        j0, j1 = nx * c + ny * s, -nx * s + ny * c
        j2 = -j0 * py + j1 * px
        h00 += w * j0 * j0
        h01 += w * j0 * j1
        h02 += w * j0 * j2
        h11 += w * j1 * j1
        h12 += w * j1 * j2
        h22 += w * j2 * j2
        g0 += w * j0 * e
        g1 += w * j1 * e
        g2 += w * j2 * e
        matched += 1
        weight_sum += w
        error_sum += w * e * e
    H[0, 0] += h00
    H[0, 1] += h01
    H[0, 2] += h02
    H[1, 1] += h11
    H[1, 2] += h12
    H[2, 2] += h22
    g[0] += g0
    g[1] += g1
    g[2] += g2
    return seen, matched, weight_sum, error_sum


@kernel
def nearest_return(x, y, ref, limit2, points, kind, geometry):  # type: ignore[no-untyped-def]
    """Return the beam of scan `ref` whose return is nearest to (x, y) within the root of `limit2`, -1 for none.

    As in `accumulate`, which holds the same search in its own body.
    """
    beams = kind.shape[1]
    turn = int(np.round(2 * np.pi / geometry[1]))
    r2 = x * x + y * y
    centre = int(np.round((np.arctan2(y, x) - geometry[0]) / geometry[1]))
    best, best_d2 = -1, limit2
    for offset in range(beams):
        if r2 * geometry[GEOMETRY_HEAD + offset] > best_d2:
            break
        for k in (centre - offset, centre + offset):
            if beams >= turn:
                k %= turn
            if 0 <= k < beams and kind[ref, k] > 0:
                d2 = (points[ref, k, 0] - x) ** 2 + (points[ref, k, 1] - y) ** 2
                if d2 < best_d2:
                    best, best_d2 = k, d2
    return best


@kernel
def solve3(H, g):  # type: ignore[no-untyped-def]
    """Solve the symmetric positive definite system H d = g whose upper triangle is given."""
    a, b, c = H[0, 0], H[0, 1], H[0, 2]
    d, e, f = H[1, 1], H[1, 2], H[2, 2]
    l10, l20 = b / a, c / a
    d1 = d - l10 * b
    m = e - l10 * c
    l21 = m / d1
    d2 = f - l20 * c - l21 * m
    y0 = g[0]
    y1 = g[1] - l10 * y0
    y2 = g[2] - l20 * y0 - l21 * y1
    z2 = y2 / d2
    z1 = y1 / d1 - l21 * z2
    z0 = y0 / a - l10 * z1 - l20 * z2
    return z0, z1, z2


@kernel
def match_scan(source, refs, ref_poses, start, prior, settings, points, lines, kind, thinned, geometry):  # type: ignore[no-untyped-def]
    """Find the pose of scan `source` that fits the scans `refs` placed at `ref_poses` (R, 3), starting at `start`.

    `prior` (3, 3) is the information of `start` itself; `settings` a vector of gate_start, gate_end, robust_start,
    robust_end, sigma, min_cosine, iterations, rotation and translation tolerance. Returns the pose, the Hessian
    of the matches over sigma^2 (3, 3) less what the noise of the normals pretends to know, and statistics: seen,
    matched, weight sum, rmse, iterations, last step.
    """
    gate_start, gate_end, robust_start, robust_end = settings[0], settings[1], settings[2], settings[3]
    sigma2, min_cosine, iterations = settings[4] ** 2, settings[5], int(settings[6])
    pose = start.copy()
    H, g = np.zeros((3, 3)), np.zeros(3)
    stats = np.zeros(6)
    for iteration in range(iterations):
        shrink = 0.5**iteration
        gate = gate_end + (gate_start - gate_end) * shrink
        robust = robust_end + (robust_start - robust_end) * shrink
        H[:] = 0.0
        g[:] = 0.0
        stats[:4] = 0.0
        for r in range(len(refs)):
            relative = between(ref_poses[r], pose)
            seen, matched, weight, error = accumulate(
                source, refs[r], relative, gate, robust, min_cosine, points, lines, kind, thinned, geometry, H, g
            )
            stats[0] += seen
            stats[1] += matched
            stats[2] += weight
            stats[3] += error
        H /= sigma2
        g /= sigma2
        offset = between(start, pose)
        A = H + prior
        b = g + prior @ offset
        for k in range(3):
            A[k, k] += 1e-6 + 1e-9 * A[k, k]
        d0, d1, d2 = solve3(A, b)
        pose = compose(pose, np.array([-d0, -d1, -d2]))
        stats[4] = iteration + 1
        stats[5] = np.hypot(d0, d1)
        if iteration >= 3 and abs(d2) < settings[7] and stats[5] < settings[8]:
            break
    # normals err at random: that alone gives a corridor's free direction sum w sigma_normal^2, which is no information
    vain = NORMAL_SIGMA_RAD * NORMAL_SIGMA_RAD * stats[2] / sigma2
    H[0, 0] -= vain
    H[1, 1] -= vain
    stats[3] = np.sqrt(stats[3] / max(stats[2], 1e-12))
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
    return pose, H, stats


@kernel
def visibility(source, ref, pose, margin, points, kind, thinned, geometry):  # type: ignore[no-untyped-def]
    """Compare scan `source` at `pose` (in the frame of scan `ref`) with what `ref` saw along the same bearings.

    Returns how many source points agree with the reference's surface, lie in space that it saw free (nearer than all
    its neighbouring returns by `margin`), and are hidden behind its surface or out of its view.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    beams = kind.shape[1]
    turn = int(np.round(2 * np.pi / geometry[1]))
    agree, conflict, hidden = 0, 0, 0
    for b in range(beams):
        if not thinned[source, b]:
            continue
        px, py = points[source, b, 0], points[source, b, 1]
        x, y = c * px - s * py + pose[0], s * px + c * py + pose[1]
        r = np.hypot(x, y)
        k0 = int(np.round((np.arctan2(y, x) - geometry[0]) / geometry[1])) % turn
        nearest, farthest, returns = np.inf, 0.0, 0
        for step in range(-1, 2):
            k = (k0 + step) % turn
            if k < beams and kind[ref, k] > 0:
                rk = np.hypot(points[ref, k, 0], points[ref, k, 1])
                nearest, farthest = min(nearest, rk), max(farthest, rk)
                returns += 1
        if returns == 0 or r > farthest + margin:
            hidden += 1
        elif r < nearest - margin:
            conflict += 1
        else:
            agree += 1
    return agree, conflict, hidden
