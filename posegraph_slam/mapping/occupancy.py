"""The occupancy grid: log-odds of every cell, summed over all scans of a trajectory."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field, model_validator

from posegraph_slam.arrays import BoolArray, Float32Array, FloatArray, IntArray, read_only
from posegraph_slam.errors import ConfigurationError, InputError
from posegraph_slam.execution import Progress, silent_progress, split_range
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.raycast import NEVER_SEEN, BeamLimits, add_scans, beam_bounds, check_ray_length
from posegraph_slam.sensors import LaserScans
from posegraph_slam.settings import Settings

OCCUPIED_PROBABILITY, FREE_PROBABILITY = 0.65, 0.35
"""A cell is occupied above the one and free below the other. One hit at log 4 gives 0.8 and one miss 0.2, so a single
observation decides; nav2's own free threshold of 0.196 would leave a cell seen free once unknown."""

UNITS_A_STEP = 4096
"""Evidence is summed in whole units of a hit's log-odds / 4096: equal hits and misses cancel exactly, in any order."""

SCANS_A_CHUNK = 2000
"""Scans between two reports of progress; the result does not depend on it."""


class OccupancySettings(Settings):
    """How scans become an occupancy grid (course report, eq. 10-15 and section III.E)."""

    resolution_m: float = Field(0.05, gt=0, le=10, description="Side of a cell.")
    occupied_log_odds: float = Field(math.log(4), gt=0, le=20, description="Log-odds that a hit adds to its cell.")
    free_log_odds: float = Field(math.log(4), gt=0, le=20, description="Log-odds that a miss takes from its cell.")
    clamp_log_odds: float = Field(4 * math.log(4), gt=0, le=100, description="Log-odds stay within +- this value.")
    fixed_size_m: float = Field(0.0, ge=0, description="Side of a square map centred at the origin; 0: fit the log.")
    margin_m: float = Field(0.5, ge=0, description="Room around everything seen, when the map fits the log.")
    min_range_m: float = Field(0.0, ge=0, description="Shortest trusted return; the sensor's own limit holds too.")
    max_range_m: float = Field(30.0, gt=0, description="Longest return that marks a cell, within the sensor's limit.")
    free_range_m: float = Field(30.0, gt=0, description="Beams free no cell farther away than this.")
    no_return_clear_m: float = Field(0.0, ge=0, description="How far beams without return free cells; 0: not at all.")
    beam_stride: int = Field(1, ge=1, description="Use every k-th beam.")

    @model_validator(mode="after")
    def _check_ranges(self) -> OccupancySettings:
        if self.min_range_m >= self.max_range_m:
            raise ValueError(f"min_range_m {self.min_range_m} must be below max_range_m {self.max_range_m}")
        return self


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OccupancyGrid:
    """Log-odds (R, C) float32 of every cell being occupied, and which cells (R, C) were ever observed.

    Cells never observed have log-odds zero. Row r, column c is the cell (r, c) of `geometry`, row 0 at the bottom.
    """

    geometry: GridGeometry
    log_odds: Float32Array
    observed: BoolArray

    def __post_init__(self) -> None:
        for name, dtype in (("log_odds", np.float32), ("observed", np.bool_)):
            array = read_only(getattr(self, name), dtype)
            if array.shape != self.geometry.shape:
                raise InputError("occupancy grid", f"{name} {array.shape} does not fit the grid {self.geometry.shape}")
            object.__setattr__(self, name, array)

    @property
    def probability(self) -> Float32Array:
        """Probability (R, C) of being occupied; 0.5 where never observed."""
        return np.asarray(1 / (1 + np.exp(-self.log_odds)), dtype=np.float32)

    @property
    def occupied(self) -> BoolArray:
        """Cells (R, C) with a probability above 0.65."""
        return np.asarray(self.log_odds > _log_odds(OCCUPIED_PROBABILITY))

    @property
    def free(self) -> BoolArray:
        """Cells (R, C) with a probability below 0.35."""
        return np.asarray(self.log_odds < _log_odds(FREE_PROBABILITY))


def build_occupancy(
    scans: LaserScans,
    trajectory: Trajectory,
    settings: OccupancySettings | None = None,
    *,
    weights: FloatArray | None = None,
    motion: FloatArray | None = None,
    progress: Progress = silent_progress,
) -> OccupancyGrid:
    """Return the occupancy grid of `scans` (N) seen from `trajectory`: T_map_base of every scan, in the same order.

    Scans are taken in recorded order, which matters where log-odds reach the clamp. `weights` (N,) >= 0 scales the
    evidence of each scan; a scan of weight 0 is left out. `motion` (N, 3) is the motion [x, y, theta] of the lidar
    during the sweep of each scan, none by default. Spatial poses and tilted sensors are projected onto the
    xy-plane. Raises InputError where the counts differ, poses are not finite or no beam is trusted.
    """
    settings = settings or OccupancySettings()
    T_map_lidar = _planar_sensor_poses(scans, trajectory)
    steps, clamp, unit = _steps(settings, weights, len(scans))
    ranges = read_only(scans.ranges_m[:, :: settings.beam_stride], np.float32)
    angles = scans.angles_rad[:: settings.beam_stride]
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    limits = _limits(settings, scans)
    moved = np.zeros((len(scans), 3)) if motion is None else motion
    used = steps.any(axis=1)
    geometry = _geometry(settings, beam_bounds(ranges[used], T_map_lidar[used], moved[used], directions, limits))
    T_cells_lidar = geometry.cells_from_map @ T_map_lidar
    evidence, stamps = np.full(geometry.shape, NEVER_SEEN), np.zeros(geometry.shape, dtype=np.uint8)
    check_ray_length(max(limits.free, limits.no_return) / settings.resolution_m)
    for start, stop in split_range(len(scans), SCANS_A_CHUNK):
        part = slice(start, stop)
        add_scans(
            ranges[part], T_cells_lidar[part], moved[part], directions, limits, steps[part], clamp, evidence, stamps
        )
        progress("occupancy map", stop, len(scans))
    observed = evidence != NEVER_SEEN
    evidence[~observed] = 0
    log_odds = evidence.astype(np.float32)
    log_odds *= np.float32(unit)
    return OccupancyGrid(geometry=geometry, log_odds=log_odds, observed=observed)


def _log_odds(probability: float) -> float:
    return math.log(probability / (1 - probability))


def _planar_sensor_poses(scans: LaserScans, trajectory: Trajectory) -> FloatArray:
    """Planar affine maps (N, 3, 3) from the lidar's xy-plane to the map's."""
    if len(trajectory) != len(scans):
        raise InputError("trajectory", f"{len(trajectory)} poses do not fit {len(scans)} scans", "give one pose a scan")
    T = trajectory.spatial().poses @ scans.T_base_lidar
    if not np.isfinite(T).all():
        bad = int(np.flatnonzero(~np.isfinite(T).all(axis=(1, 2)))[0])
        raise InputError("trajectory", f"the pose of scan {bad} is not finite")
    # Beams have z = 0 in the lidar frame: the column of z drops out, and so does the row of the height.
    return np.ascontiguousarray(T[:, [0, 1, 3]][:, :, [0, 1, 3]])


def _limits(settings: OccupancySettings, scans: LaserScans) -> BeamLimits:
    shortest = max(settings.min_range_m, scans.range_min_m)
    trusted = min(settings.max_range_m, scans.range_max_m)
    if shortest >= trusted:
        raise ConfigurationError(
            "mapping",
            f"no return is trusted: the shortest is {shortest} m and the longest {trusted} m",
            "check min_range_m and max_range_m against the sensor's limits",
        )
    return BeamLimits(shortest, trusted, scans.range_max_m, settings.free_range_m, settings.no_return_clear_m)


def _steps(settings: OccupancySettings, weights: FloatArray | None, scans: int) -> tuple[IntArray, int, float]:
    """Whole units that a hit adds and a miss takes in every scan (N, 2), the clamp, and the log-odds of a unit."""
    unit = settings.occupied_log_odds / UNITS_A_STEP
    factor = np.ones(scans) if weights is None else np.asarray(weights, dtype=np.float64)
    if factor.shape != (scans,) or not (np.isfinite(factor) & (factor >= 0)).all():
        raise InputError("weights", f"need one finite weight >= 0 for each of the {scans} scans")
    steps = np.rint(factor[:, None] * [UNITS_A_STEP, settings.free_log_odds / unit])
    clamp = round(settings.clamp_log_odds / unit)
    # Nothing can move a cell farther than from one clamp to the other; this also keeps the sums within 32 bits.
    return np.minimum(steps, 2 * clamp).astype(np.int64), clamp, unit


def _geometry(settings: OccupancySettings, bounds_m: FloatArray) -> GridGeometry:
    if settings.fixed_size_m > 0:
        return GridGeometry.square(settings.fixed_size_m, resolution_m=settings.resolution_m)
    if not np.isfinite(bounds_m).all():
        raise InputError("laser scans", "hold no trusted return, so there is nothing to map", "check the range limits")
    return GridGeometry.around(bounds_m, resolution_m=settings.resolution_m, margin_m=settings.margin_m)
