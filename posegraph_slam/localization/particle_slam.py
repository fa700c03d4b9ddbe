"""Particle-filter SLAM: particles move by odometry, the map weighs them, and the best of them draws the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.geometry import Trajectory, planar_from_spatial, pose_from_xyt, xyt_from_pose
from posegraph_slam.localization.free_space import draw_scan_by_polygon
from posegraph_slam.localization.motion import propagate
from posegraph_slam.localization.resampling import effective_number, normalised, resample
from posegraph_slam.localization.slam_map import draw_scan, empty_map
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.localization.slam_weights import log_weights
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.registration.beam_matching import between
from posegraph_slam.sensors import LaserScans


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ParticleSlamResult:
    """T_map_base of the best particle at every scan (N, 3, 3), the map it drew, and the effective number (N,)."""

    trajectory: Trajectory
    occupancy: OccupancyGrid
    effective: FloatArray
    resamplings: int

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
    to the map; the best one draws the scan; draw them anew when the effective number is low. One map is kept,
    whatever the number of particles. The result depends on the inputs and the generator alone.
    """
    if len(scans) != len(odometry) or len(scans) == 0:
        raise InputError("odometry", f"{len(odometry)} poses do not fit {len(scans)} scans", "give one pose a scan")
    path = xyt_from_pose(odometry.poses)
    slam_map = empty_map(_geometry(path, scans, settings), settings)
    draw = draw_scan if settings.free_cells == "rays" else draw_scan_by_polygon
    mounting = planar_from_spatial(scans.T_base_lidar)
    sensor = mounting[:2, 2].copy()
    particles = np.tile(path[0], (settings.particles, 1))
    weights = np.zeros(settings.particles)
    poses, effective = np.empty((len(scans), 3)), np.full(len(scans), float(settings.particles))
    since, resamplings = np.full(2, np.inf), 0
    for k in range(len(scans)):
        increment = between(path[max(k - 1, 0)], path[k])
        particles = propagate(particles, increment, settings.noise, rng)
        since += np.array([np.hypot(increment[0], increment[1]), abs(increment[2])])
        if since[0] >= settings.update_distance_m or since[1] >= settings.update_turn_rad:
            points = _base_points(scans, k, mounting, settings)
            if k > 0 and len(points):
                few = np.ascontiguousarray(points[:: -(-len(points) // settings.points_max)])
                weights = weights + log_weights(slam_map, particles, few, sensor, settings)
                weights -= weights.max()
            draw(slam_map, points, particles[int(weights.argmax())], sensor)
            since = np.zeros(2)
        poses[k] = particles[int(weights.argmax())]
        share = normalised(weights)
        effective[k] = effective_number(share)
        if effective[k] < settings.resampling.effective_share * settings.particles:
            particles = particles[resample(share, settings.particles, settings.resampling.scheme, rng)]
            weights = np.zeros(settings.particles)
            resamplings += 1
        if k % 200 == 0:
            progress("particle filter", k, len(scans))
    progress("particle filter", len(scans), len(scans))
    return ParticleSlamResult(
        trajectory=Trajectory(stamps_s=odometry.stamps_s, poses=pose_from_xyt(poses), parent="map", child="base"),
        occupancy=_cropped(slam_map.occupancy()),
        effective=effective,
        resamplings=resamplings,
    )


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
