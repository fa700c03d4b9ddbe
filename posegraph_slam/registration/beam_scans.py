"""Laser scans prepared for matching: points and surface normals, kept in the order of their beams.

Because beam k of a scan points at a known bearing, the neighbours of any point are found by arithmetic on its bearing
(as in PL-ICP, Censi 2008): no search tree has to be built or walked.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Executor, SerialExecutor, split_range
from posegraph_slam.geometry import planar_from_spatial
from posegraph_slam.jit import kernel
from posegraph_slam.sensors import LaserScans
from posegraph_slam.settings import Settings

GEOMETRY_HEAD = 2
"""Entries of `BeamScans.geometry` before those of the offsets."""
SCANS_A_CHUNK = 512
"""Scans in one unit of work."""


class BeamScanSettings(Settings):
    """How returns become points with normals."""

    range_max_m: float = Field(default=30.0, gt=0)
    """Returns beyond this trusted range are not matched."""
    range_min_m: float = Field(default=0.1, ge=0)
    """Returns nearer than this are not matched (the robot itself)."""
    normal_radius_m: float = Field(default=0.2, gt=0)
    """Neighbours within this distance define a normal; it grows where beams lie further apart."""
    normal_gap_max_m: float = Field(default=1.0, gt=0)
    """A point whose nearest neighbour is further away than this has no normal."""
    surface_sigma_m: float = Field(default=0.04, gt=0)
    """A neighbourhood that deviates more than this from a line has no normal (clutter, corners)."""
    source_spacing_m: float = Field(default=0.08, ge=0)
    """Source points are thinned along the surface to about this spacing; 0 keeps all."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BeamScans:
    """Points (N, B, 2) in the lidar frame and the line through each point's neighbourhood.

    `lines` (N, B, 3) hold a unit normal that faces the sensor and the line's offset: normal . x = offset on the line.
    `kind` (N, B): 0 no return, 1 point, 2 point with line; `thinned` (N, B) marks the points that stand for the scan
    when it is the source.
    """

    points: Float32Array
    lines: Float32Array
    kind: ByteArray
    thinned: BoolArray
    angle_min_rad: float
    angle_increment_rad: float
    T_base_lidar: FloatArray
    """Planar mounting (3, 3)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", read_only(self.points, np.float32))
        object.__setattr__(self, "lines", read_only(self.lines, np.float32))
        object.__setattr__(self, "kind", read_only(self.kind, np.uint8))
        object.__setattr__(self, "thinned", read_only(self.thinned, np.bool_))
        object.__setattr__(self, "T_base_lidar", read_only(self.T_base_lidar))

    def __len__(self) -> int:
        return int(self.points.shape[0])

    @property
    def geometry(self) -> FloatArray:
        """What kernels need of the beams: least angle, increment, and the least squared sine at each offset of beams.

        Entry `GEOMETRY_HEAD` + k is sin((k - 1/2) increment)^2: a return k beams from the bearing of a point at range
        r lies at least r times its root away; 0 for k = 0, infinite beyond a quarter turn.
        """
        angles = (np.arange(self.kind.shape[1]) - 0.5) * self.angle_increment_rad
        squared = np.where(angles < 0.5 * np.pi, np.sin(np.maximum(angles, 0.0)) ** 2, np.inf)
        return np.concatenate([[self.angle_min_rad, self.angle_increment_rad], squared])

    def select(self, index: IntArray) -> BeamScans:
        """Return the scans at `index`, in that order."""
        return BeamScans(
            points=self.points[index],
            lines=self.lines[index],
            kind=self.kind[index],
            thinned=self.thinned[index],
            angle_min_rad=self.angle_min_rad,
            angle_increment_rad=self.angle_increment_rad,
            T_base_lidar=self.T_base_lidar,
        )


def prepare_beam_scans(
    scans: LaserScans,
    settings: BeamScanSettings,
    executor: Executor | None = None,
    *,
    motion: FloatArray | None = None,
) -> BeamScans:
    """Turn ranges (N, B) into points with lines, dropping what is no trusted return.

    `motion` (N, 3) is the planar motion [x, y, theta] of the lidar during the sweep of each scan: its points are put
    where they would have been seen from the middle of the sweep. Without it the scans are taken as they are.
    """
    if scans.angle_increment_rad <= 0:
        raise InputError("laser scans", f"angle increment {scans.angle_increment_rad} rad is not positive")
    lower = max(settings.range_min_m, scans.range_min_m)
    upper = min(settings.range_max_m, scans.range_max_m)
    cos, sin = np.cos(scans.angles_rad), np.sin(scans.angles_rad)
    prepare = partial(
        _prepare_chunk,
        cos=cos,
        sin=sin,
        limits=np.array([lower, upper, settings.normal_radius_m, settings.normal_gap_max_m]),
        surface_sigma=settings.surface_sigma_m,
        spacing=settings.source_spacing_m,
    )
    moved = np.zeros((len(scans), 3)) if motion is None else motion
    chunks = [(scans.ranges_m[start:stop], moved[start:stop]) for start, stop in split_range(len(scans), SCANS_A_CHUNK)]
    parts = (executor or SerialExecutor()).map(prepare, chunks)
    points, lines, kind, thinned = (np.concatenate([part[k] for part in parts]) for k in range(4))
    return BeamScans(
        points=points,
        lines=lines,
        kind=kind,
        thinned=thinned,
        angle_min_rad=scans.angle_min_rad,
        angle_increment_rad=scans.angle_increment_rad,
        T_base_lidar=planar_from_spatial(scans.T_base_lidar),
    )


def _prepare_chunk(
    chunk: tuple[Float32Array, FloatArray],
    *,
    cos: FloatArray,
    sin: FloatArray,
    limits: FloatArray,
    surface_sigma: float,
    spacing: float,
) -> tuple[Float32Array, Float32Array, ByteArray, BoolArray]:
    ranges, motion = chunk
    points, lines, kind, thinned = _prepare(ranges, motion, cos, sin, limits, surface_sigma, spacing)
    return points, lines, kind, thinned


@kernel
def _prepare(ranges, motion, cos, sin, limits, surface_sigma, spacing):  # type: ignore[no-untyped-def]
    count, beams = ranges.shape
    points = np.zeros((count, beams, 2), np.float32)
    lines = np.zeros((count, beams, 3), np.float32)
    kind = np.zeros((count, beams), np.uint8)
    thinned = np.zeros((count, beams), np.bool_)
    increment = np.arctan2(cos[0] * sin[1] - sin[0] * cos[1], cos[0] * cos[1] + sin[0] * sin[1])
    for s in range(count):
        for b in range(beams):
            r = ranges[s, b]
            if r >= limits[0] and r < limits[1]:
                # to first order: a sweep turns by a few hundredths of a radian
                part = (b + 0.5) / beams - 0.5
                points[s, b, 0] = r * cos[b] + part * (motion[s, 0] - motion[s, 2] * r * sin[b])
                points[s, b, 1] = r * sin[b] + part * (motion[s, 1] + motion[s, 2] * r * cos[b])
                kind[s, b] = 1
        _fit_lines(points[s], kind[s], lines[s], limits[2], limits[3], surface_sigma)
        _thin(points[s], lines[s], kind[s], thinned[s], cos, sin, increment, spacing)
    return points, lines, kind, thinned


@kernel
def _fit_lines(points, kind, lines, radius_min, gap_max, surface_sigma):  # type: ignore[no-untyped-def]
    """Fit a line to the beams around each point that lie on its surface.

    Neighbours are found beam by beam; their sums come from running sums over the scan, so that the cost of a
    neighbour is one distance.
    """
    beams = len(kind)
    px, py = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
    sums = np.zeros((beams + 1, 5))
    for b in range(beams):
        sums[b + 1, 0] = sums[b, 0] + px[b]
        sums[b + 1, 1] = sums[b, 1] + py[b]
        sums[b + 1, 2] = sums[b, 2] + px[b] * px[b]
        sums[b + 1, 3] = sums[b, 3] + px[b] * py[b]
        sums[b + 1, 4] = sums[b, 4] + py[b] * py[b]
    for b in range(beams):
        if kind[b] == 0:
            continue
        x, y = px[b], py[b]
        gap2 = np.inf
        for k in (b - 1, b + 1):
            if 0 <= k < beams and kind[k] > 0:
                gap2 = min(gap2, (px[k] - x) ** 2 + (py[k] - y) ** 2)
        if gap2 > gap_max * gap_max:
            continue
        radius2 = max(radius_min * radius_min, 6.25 * gap2)
        first, last = b, b + 1
        while first > 0 and kind[first - 1] > 0 and (px[first - 1] - x) ** 2 + (py[first - 1] - y) ** 2 <= radius2:
            first -= 1
        while last < beams and kind[last] > 0 and (px[last] - x) ** 2 + (py[last] - y) ** 2 <= radius2:
            last += 1
        n = float(last - first)
        if n < 3.0:
            continue
        mx, my = (sums[last, 0] - sums[first, 0]) / n, (sums[last, 1] - sums[first, 1]) / n
        cxx = (sums[last, 2] - sums[first, 2]) / n - mx * mx
        cxy = (sums[last, 3] - sums[first, 3]) / n - mx * my
        cyy = (sums[last, 4] - sums[first, 4]) / n - my * my
        half_trace, half_diff = 0.5 * (cxx + cyy), 0.5 * (cxx - cyy)
        root = np.sqrt(half_diff * half_diff + cxy * cxy)
        smallest, largest = max(half_trace - root, 0.0), half_trace + root
        if smallest > surface_sigma * surface_sigma or not smallest < 0.1 * largest:
            continue
        # the eigenvector of the smallest eigenvalue, from the row of the matrix that is better conditioned
        nx, ny = (-cxy, half_diff + root) if half_diff > 0 else (half_diff - root, cxy)
        length = np.sqrt(nx * nx + ny * ny)
        nx, ny = nx / length, ny / length
        if nx * x + ny * y > 0:
            nx, ny = -nx, -ny
        lines[b, 0], lines[b, 1] = nx, ny
        lines[b, 2] = nx * mx + ny * my
        kind[b] = 2


@kernel
def _thin(points, lines, kind, thinned, cos, sin, increment, spacing):  # type: ignore[no-untyped-def]
    """Keep a point every `spacing` along the surface.

    The way between beams is taken from the fitted line, never from the points themselves: a choice that depends on a
    point's own noise prefers returns that err in the direction of the sweep, and turns every match a little.
    """
    way = spacing
    for b in range(len(kind)):
        if kind[b] == 2:
            incidence = max(-(lines[b, 0] * cos[b] + lines[b, 1] * sin[b]), 0.05)
            way += -lines[b, 2] / (incidence * incidence) * increment
        elif kind[b] == 1:
            way += np.hypot(points[b, 0], points[b, 1]) * increment
        if kind[b] > 0 and way >= spacing:
            thinned[b] = True
            way = 0.0
