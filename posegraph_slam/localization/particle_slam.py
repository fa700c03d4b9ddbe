"""Particle-filter SLAM: particles move by odometry, the map weighs them, and the best of them draws the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.geometry import Trajectory, planar_from_spatial, pose_from_xyt, xyt_from_pose
from posegraph_slam.localization.motion import propagate
from posegraph_slam.localization.particle_maps import ParticleMaps
from posegraph_slam.localization.resampling import effective_number, normalised, resample
from posegraph_slam.localization.shared_map import Maps, SharedMap
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.registration.beam_matching import between
from posegraph_slam.sensors import LaserScans


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ParticleSlamResult:
    """T_map_base at every scan (N, 3, 3), the map, the effective number of particles (N,), and what the maps took.

    With one map the poses are those of the particle that was best at each scan, which drew it; with one map a particle
    they are the path of the particle that is best in the end, whose map it is.
    """

    trajectory: Trajectory
    occupancy: OccupancyGrid
    effective: FloatArray
    resamplings: int
    map_bytes: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "effective", read_only(self.effective))


def particle_slam(
    scans: LaserScans,
    odometry: Trajectory,
    settings: ParticleSlamSettings,
    *,
    rng: np.random.Generator,
    progress: Progress = silent_progress,
) -> ParticleSlamResult:
    """Map and localise at once from scans (N) and their odometry poses (N, 3, 3).

    For every scan: move the particles by the odometry's increment in their own frames; weigh them by the scan's fit
    to the map; the best one draws the scan (or each, in its own map); draw them anew when the effective number is
    low. The result depends on the inputs and the generator alone.
    """
    if len(scans) != len(odometry) or len(scans) == 0:
        raise InputError("odometry", f"{len(odometry)} poses do not fit {len(scans)} scans", "give one pose a scan")
    path, count = xyt_from_pose(odometry.poses), settings.particles
    maps = _maps(_geometry(path, scans, settings), settings)
    mounting = planar_from_spatial(scans.T_base_lidar)
    sensor = mounting[:2, 2].copy()
    particles, weights = np.tile(path[0], (count, 1)), np.zeros(count)
    history = _History(len(scans), count, own_maps=settings.maps == "per_particle")
    effective, since, resamplings = np.empty(len(scans)), np.full(2, np.inf), 0
    for k in range(len(scans)):
        increment = between(path[max(k - 1, 0)], path[k])
        particles = propagate(particles, increment, settings.noise, rng)
        since += np.array([np.hypot(increment[0], increment[1]), abs(increment[2])])
        if since[0] >= settings.update_distance_m or since[1] >= settings.update_turn_rad:
            weights = maps.observe(particles, weights, _base_points(scans, k, mounting, settings), sensor)
            since = np.zeros(2)
        history.keep(k, particles, int(weights.argmax()))
        share = normalised(weights)
        effective[k] = effective_number(share)
        if effective[k] < settings.resampling.effective_share * count:
            ancestors = resample(share, count, settings.resampling.scheme, rng)
            particles, weights = particles[ancestors], np.zeros(count)
            maps.resample(ancestors)
            history.resample(k, ancestors)
            resamplings += 1
        if k % 200 == 0:
            progress("particle filter", k, len(scans))
    progress("particle filter", len(scans), len(scans))
    best = int(weights.argmax())
    poses = pose_from_xyt(history.path(best))
    return ParticleSlamResult(
        trajectory=Trajectory(stamps_s=odometry.stamps_s, poses=poses, parent="map", child="base"),
        occupancy=_cropped(maps.occupancy(best)),
        effective=effective,
        resamplings=resamplings,
        map_bytes=maps.peak_bytes,
    )


def _maps(geometry: GridGeometry, settings: ParticleSlamSettings) -> Maps:
    return SharedMap(geometry, settings) if settings.maps == "best" else ParticleMaps(geometry, settings)


class _History:
    """Poses of the best particle at each scan, or of all particles and who stems from whom."""

    def __init__(self, scans: int, particles: int, *, own_maps: bool) -> None:
        self._best = np.empty((scans, 3))
        self._all = np.empty((scans if own_maps else 0, particles, 3))
        self._ancestors: dict[int, IntArray] = {}

    def keep(self, scan: int, particles: FloatArray, best: int) -> None:
        """Remember the particles (N, 3) at a scan."""
        if len(self._all):
            self._all[scan] = particles
        else:
            self._best[scan] = particles[best]

    def resample(self, scan: int, ancestors: IntArray) -> None:
        """Remember that after `scan` particle k continued `ancestors[k]`."""
        if len(self._all):
            self._ancestors[scan] = ancestors

    def path(self, particle: int) -> FloatArray:
        """Return the poses (S, 3) of the particle's own path, or of the best at each scan."""
        if not len(self._all):
            return self._best
        end = len(self._all)
        for scan in sorted(self._ancestors, reverse=True):
            self._best[scan + 1 : end] = self._all[scan + 1 : end, particle]
            particle, end = int(self._ancestors[scan][particle]), scan + 1
        self._best[:end] = self._all[:end, particle]
        return self._best


def _base_points(scans: LaserScans, index: int, mounting: FloatArray, settings: ParticleSlamSettings) -> FloatArray:
    points = scans.points(index)
    points = points[np.hypot(points[:, 0], points[:, 1]) <= settings.range_max_m]
    return np.ascontiguousarray(points @ mounting[:2, :2].T + mounting[:2, 2])


def _geometry(path: FloatArray, scans: LaserScans, settings: ParticleSlamSettings) -> GridGeometry:
    """A grid that holds all a robot can see from the odometry's path, drifted by a fifth of its extent."""
    reach = min(settings.range_max_m, scans.range_max_m)
    margin = reach + 0.2 * float(np.ptp(path[:, :2], axis=0).max()) + 1.0
    return GridGeometry.around(path[:, :2], resolution_m=settings.resolution_m, margin_m=margin)


def _cropped(grid: OccupancyGrid) -> OccupancyGrid:
    """Cut away what was never observed around the map."""
    rows, columns = np.flatnonzero(grid.observed.any(axis=1)), np.flatnonzero(grid.observed.any(axis=0))
    if len(rows) == 0:
        raise InputError("laser scans", "hold no trusted return, so there is nothing to map", "check the range limits")
    top, left = rows[0], columns[0]
    part = np.s_[top : rows[-1] + 1, left : columns[-1] + 1]
    log_odds = grid.log_odds[part]
    geometry = GridGeometry(
        origin_m=grid.geometry.origin_m + np.array([left, top]) * grid.geometry.resolution_m,
        resolution_m=grid.geometry.resolution_m,
        shape=(log_odds.shape[0], log_odds.shape[1]),
    )
    return OccupancyGrid(geometry=geometry, log_odds=log_odds, observed=grid.observed[part])
