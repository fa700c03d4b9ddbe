"""Configuration of the particle filters: motion noise, sensor model, resampling, search and health."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from posegraph_slam.registration.beam_matching import BeamMatchSettings
from posegraph_slam.settings import Settings

ResamplingScheme = Literal["systematic", "low_variance", "stratified", "multinomial"]


class MotionNoise(Settings):
    """Noise of the propagation as a random walk: variances grow with the way and the turn, however finely it is cut.

    A motion of d metres and a radians gets the position variance translation_per_sqrt_m^2 d +
    translation_per_sqrt_rad^2 a and the heading variance rotation_per_sqrt_rad^2 a + rotation_per_sqrt_m^2 d.
    """

    translation_per_sqrt_m: float = Field(default=0.04, ge=0)
    """m of position sigma after driving 1 m."""
    translation_per_sqrt_rad: float = Field(default=0.02, ge=0)
    """m of position sigma after turning 1 rad."""
    rotation_per_sqrt_rad: float = Field(default=0.05, ge=0)
    """rad of heading sigma after turning 1 rad."""
    rotation_per_sqrt_m: float = Field(default=0.002, ge=0)
    """rad of heading sigma after driving 1 m straight: next to nothing, so that straight motion spreads no heading."""
    floor_m: float = Field(default=0.0, ge=0)
    """m of position sigma added to every step, moving or not."""
    floor_rad: float = Field(default=0.0, ge=0)
    """rad of heading sigma added to every step, moving or not."""


class ResamplingSettings(Settings):
    """When and how particles are drawn anew."""

    scheme: ResamplingScheme = "systematic"
    """systematic, low_variance and stratified spread the draws evenly; multinomial draws each by itself."""
    effective_share: float = Field(default=0.4, gt=0, le=1)
    """Particles are drawn anew when their effective number falls below this share."""


class ParticleNumberSettings(Settings):
    """How many particles there are: as many as the spread of their distribution needs (Fox 2003)."""

    minimum: int = Field(default=100, ge=10)
    """Fewest particles."""
    maximum: int = Field(default=3000, ge=10)
    """Most particles."""
    error: float = Field(default=0.05, gt=0, lt=1)
    """Largest Kullback-Leibler divergence between the particles and the distribution they stand for,"""
    quantile: float = Field(default=2.326, gt=0)
    """which is kept with the probability of this quantile of the normal distribution (2.326: 99 %)."""
    bin_m: float = Field(default=0.3, gt=0)
    """Side of the bins in which the distribution is counted,"""
    bin_rad: float = Field(default=0.17, gt=0)
    """and their width in heading."""

    @model_validator(mode="after")
    def _check_order(self) -> ParticleNumberSettings:
        if self.minimum > self.maximum:
            raise ValueError(f"minimum {self.minimum} must not exceed maximum {self.maximum}")
        return self


class BeamModelSettings(Settings):
    """Likelihood of a scan: how near its returns lie to the map's obstacles (Thrun et al. 2005, section 6.4)."""

    sigma_m: float = Field(default=0.1, gt=0)
    """Standard deviation of a return's distance to the nearest obstacle."""
    random_share: float = Field(default=0.1, gt=0, lt=1)
    """Share of returns from what the map does not hold: people, chairs, a door that moved."""
    unknown_likelihood: float = Field(default=0.3, ge=0, le=1)
    """Likelihood of a return from unknown space, against 1 on an obstacle."""
    beam_weight: float = Field(default=0.15, gt=0, le=1)
    """Part of a beam's log-likelihood that counts, since neighbouring beams err together."""
    points_max: int = Field(default=100, ge=10)
    """A scan is represented by at most this many returns."""


class GlobalSearchSettings(Settings):
    """Search of the whole map for places where the last scans fit."""

    resolution_m: float = Field(default=0.1, gt=0)
    """Step of the search in position; the step in heading moves the farthest point by as much."""
    sigma_m: float = Field(default=0.12, gt=0)
    """Width of the map's obstacles in the search."""
    unknown_likelihood: float = Field(default=0.3, ge=0, le=1)
    """Likelihood of a return from unknown space in the search, against 1 on an obstacle and 0 in free space."""
    range_max_m: float = Field(default=12.0, gt=0)
    """Returns further away are left out."""
    points_max: int = Field(default=120, ge=20)
    """The last scans are represented by at most this many points."""
    angle_step_rad: float = Field(default=0.02, gt=0, lt=1)
    """Smallest step in heading."""
    score_min: float = Field(default=0.3, ge=0, lt=1)
    """Least mean likelihood of the points at a candidate."""
    candidates_max: int = Field(default=100, ge=1)
    """Best places by score that are looked at closely,"""
    peaks_max: int = Field(default=30, ge=1)
    """and how many of them, by how far they agree with the map, become hypotheses."""
    separation_m: float = Field(default=0.8, gt=0)
    """Candidates nearer than this,"""
    separation_rad: float = Field(default=0.35, gt=0)
    """and turned by less than this, are one."""
    scans: int = Field(default=24, ge=1)
    """Scans that are searched together, placed by odometry."""
    every: int = Field(default=5, ge=1)
    """Updates between two searches while the pose is not known."""
    share: float = Field(default=0.5, gt=0, lt=1)
    """Share of the particles that is put on the candidates."""


class HealthSettings(Settings):
    """When the estimate is trusted."""

    agreement_m: float = Field(default=0.25, gt=0)
    """A return this near to an obstacle agrees with the map; one in known free space, or behind a wall, conflicts."""
    lost_below: float = Field(default=0.45, gt=0, lt=1)
    """Share of the telling returns that agree, below which the pose is lost."""
    found_above: float = Field(default=0.82, gt=0, lt=1)
    """A new place is believed when this share of the telling returns agrees,"""
    clear_above: float = Field(default=0.7, gt=0, lt=1)
    """or this share where it leads every other place clearly: things have moved since the map was drawn,"""
    explained_min: float = Field(default=0.5, ge=0, lt=1)
    """and this share of all returns, those in unknown space included."""
    memory_updates: float = Field(default=10.0, ge=1)
    """Updates over which the agreement is averaged."""
    evidence_min: int = Field(default=10, ge=1)
    """A scan with fewer returns in the known part of the map says nothing,"""
    evidence_share: float = Field(default=0.3, ge=0, le=1)
    """and neither does one of which this share lies there."""
    share_min: float = Field(default=0.9, gt=0.5, le=1)
    """Weight of the best hypothesis below which the pose is ambiguous."""
    sigma_max_m: float = Field(default=0.5, gt=0)
    """Position sigma above which the pose is ambiguous."""
    updates_min: int = Field(default=10, ge=1)
    """Updates that a new hypothesis must survive before it is believed,"""
    rival_margin: float = Field(default=0.2, ge=0)
    """and by how much, in log-odds a return, every other place must fit the remembered scans worse; 0.2 is about one
    conflicting return more in fifteen. Over a quarter of the scans twice as much is asked for, and a place where
    `found_above` of the returns agree is a rival however far behind."""
    clear_margin: float = Field(default=0.5, ge=0)
    """Log-odds a return, over all remembered scans, by which a place leads clearly."""
    remembered_scans: int = Field(default=96, ge=1)
    """Scans that rivals are compared by, the last ones that weighed the particles."""

    @model_validator(mode="after")
    def _check_order(self) -> HealthSettings:
        if not self.lost_below <= self.clear_above <= self.found_above:
            shares = f"lost_below {self.lost_below}, clear_above {self.clear_above}, found_above {self.found_above}"
            raise ValueError(f"{shares} must not fall in this order")
        return self


class LocalizationSettings(Settings):
    """Localisation in a known map."""

    propagation: Literal["scan_matching", "odometry"] = "scan_matching"
    """The motion that moves the particles: of scans matched to the ones before them, or of the odometry itself."""
    matched_noise: MotionNoise = MotionNoise(
        translation_per_sqrt_m=0.01,
        translation_per_sqrt_rad=0.005,
        rotation_per_sqrt_rad=0.02,
        rotation_per_sqrt_m=0.003,
    )
    """Noise of the motion by scan matching, good to about 1 %,"""
    odometry_noise: MotionNoise = MotionNoise(
        translation_per_sqrt_m=0.06, translation_per_sqrt_rad=0.03, rotation_per_sqrt_rad=0.15, rotation_per_sqrt_m=0.02
    )
    """and of the motion by odometry."""
    number: ParticleNumberSettings = ParticleNumberSettings()
    resampling: ResamplingSettings = ResamplingSettings()
    beam_model: BeamModelSettings = BeamModelSettings()
    match: BeamMatchSettings = BeamMatchSettings(gate_start_m=0.4, robust_start_m=0.2, sigma_m=0.2)
    """Refinement of the mean against lines of the map; its sigma allows for walls that err together."""
    search: GlobalSearchSettings = GlobalSearchSettings()
    health: HealthSettings = HealthSettings()
    update_distance_m: float = Field(default=0.1, ge=0)
    """Scans weigh the particles after this way,"""
    update_turn_rad: float = Field(default=0.1, ge=0)
    """or this turn: a robot at rest would count the same evidence over and over."""
    start_sigma_m: float = Field(default=0.2, gt=0)
    """Spread of the particles about a given start,"""
    start_sigma_rad: float = Field(default=0.1, gt=0)
    """and in heading."""
    refined_share: float = Field(default=0.1, ge=0, lt=1)
    """Share of the particles drawn about the refined mean at each resampling."""
    line_radius_m: float = Field(default=0.2, gt=0)
    """Obstacle cells within this distance define a line of the map."""
    covariance_floor_m: float = Field(default=0.015, gt=0)
    """Position sigma of the map itself, added to that of the estimate,"""
    covariance_floor_rad: float = Field(default=0.003, gt=0)
    """and its heading sigma."""

    @property
    def noise(self) -> MotionNoise:
        """Noise of the chosen propagation."""
        return self.matched_noise if self.propagation == "scan_matching" else self.odometry_noise
