"""The map of particle-filter SLAM as particles share it: the best of them draws it."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.localization.free_space import draw_scan_by_polygon
from posegraph_slam.localization.slam_map import draw_scan, empty_map
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.localization.slam_weights import log_weights, weighed_scan
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid


class Maps(Protocol):
    """What the filter asks of its map or maps, which change as it goes."""

    def observe(self, particles: FloatArray, weights: FloatArray, points: FloatArray, sensor: FloatArray) -> FloatArray:
        """Weigh particles (N, 3) by a scan, draw it, and return the log-weights (N,), that were `weights` before.

        `points` (n, 2) are its returns, `sensor` (2,) the laser, in the base frame. The first scan weighs nothing.
        """

    def resample(self, ancestors: IntArray) -> None:
        """Give particle k the map of particle `ancestors[k]`."""

    def occupancy(self, particle: int) -> OccupancyGrid:
        """Return the map of a particle."""

    @property
    def peak_bytes(self) -> int:
        """Most memory that the cells took at any time."""


class SharedMap:
    """One map, whatever the number of particles."""

    def __init__(self, geometry: GridGeometry, settings: ParticleSlamSettings) -> None:
        self._map = empty_map(geometry, settings)
        self._settings = settings
        self._draw = draw_scan if settings.free_cells == "rays" else draw_scan_by_polygon
        self._empty = True

    def observe(self, particles: FloatArray, weights: FloatArray, points: FloatArray, sensor: FloatArray) -> FloatArray:
        """Weigh particles by a scan, and let the best draw it; see `Maps`."""
        if not self._empty and len(points):
            scan = weighed_scan(points, sensor, self._map.reach, self._settings)
            weights = weights + log_weights(self._map, particles, scan, self._settings)
            weights -= weights.max()
        self._draw(self._map, points, particles[int(weights.argmax())], sensor)
        self._empty = False
        return weights

    def resample(self, ancestors: IntArray) -> None:
        """Do nothing: all particles have the same map."""

    def occupancy(self, particle: int) -> OccupancyGrid:
        """Return the map, which is that of every particle."""
        return self._map.occupancy()

    @property
    def peak_bytes(self) -> int:
        """Memory that the cells take."""
        held = (self._map.evidence, self._map.near, self._map.stamps, self._map.free_before)
        return int(np.sum([array.nbytes for array in held if array is not None]))
