"""Configuration of particle-filter SLAM."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from posegraph_slam.localization.settings import MotionNoise, ResamplingSettings
from posegraph_slam.settings import Settings


class ParticleSlamSettings(Settings):
    """Particle-filter SLAM: particles share the map that the best of them draws, or each has its own."""

    particles: int = Field(default=100, ge=1)
    """Number of particles."""
    maps: Literal["best", "per_particle"] = "best"
    """One map that the best particle draws, or one of each particle: these cost memory and time, but each particle is
    then weighed by a map of its own path."""
    weighting: Literal["likelihood_field", "window_correlation", "cell_counts"] = "likelihood_field"
    """How a scan fits the map: distance of returns to obstacles, best correlation in a window, or agreeing cells."""
    free_cells: Literal["rays", "polygon"] = "rays"
    """Free space of a scan: the cells on its beams, or the inside of the polygon of its returns."""
    noise: MotionNoise = MotionNoise(
        translation_per_sqrt_m=0.03, translation_per_sqrt_rad=0.02, rotation_per_sqrt_rad=0.04, rotation_per_sqrt_m=0.01
    )
    """Noise of the odometry's steps."""
    resampling: ResamplingSettings = ResamplingSettings()
    resolution_m: float = Field(default=0.05, gt=0)
    """Side of a cell."""
    free_log_odds: float = Field(default=0.25 * math.log(4), gt=0)
    """Log-odds that a miss takes from its cell,"""
    occupied_per_free: float = Field(default=4.0, gt=0)
    """and how many times as much a hit adds: an obstacle seen is surer than free space between."""
    clamp_log_odds: float = Field(default=4 * math.log(4), gt=0)
    """Log-odds stay within +- this value."""
    occupied_above: float = Field(default=1.0, gt=0)
    """Log-odds above which a cell counts as an obstacle."""
    range_max_m: float = Field(default=25.0, gt=0)
    """Longer returns are not used."""
    points_max: int = Field(default=120, ge=10)
    """Returns of a scan that weigh the particles."""
    sigma_m: float = Field(default=0.1, gt=0)
    """Likelihood field: standard deviation of a return's distance to the nearest obstacle,"""
    random_share: float = Field(default=0.1, gt=0, lt=1)
    """share of returns from what the map does not hold,"""
    unknown_likelihood: float = Field(default=0.2, ge=0, le=1)
    """likelihood of a return from unknown space,"""
    beam_weight: float = Field(default=0.3, gt=0, le=1)
    """and the part of a beam's log-likelihood that counts."""
    window_cells: int = Field(default=9, ge=1, le=21)
    """Window correlation: side of the window of shifts, the best of which counts."""
    correlation_power: float = Field(default=20.0, gt=0)
    """Window correlation and cell counts: the weight is the score to this power; 1 is nearly flat over near poses."""
    update_distance_m: float = Field(default=0.05, ge=0)
    """Scans weigh the particles and draw the map after this way,"""
    update_turn_rad: float = Field(default=0.03, ge=0)
    """or this turn; 0 for every scan."""

    @model_validator(mode="after")
    def _check_maps(self) -> ParticleSlamSettings:
        if self.maps == "per_particle" and self.free_cells != "rays":
            raise ValueError(f"maps per_particle need free_cells rays, not {self.free_cells}")
        return self
