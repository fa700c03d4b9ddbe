"""Configuration of loop closure: what is proposed, and what is accepted."""

from __future__ import annotations

from pydantic import Field

from posegraph_slam.registration.beam_matching import BeamMatchSettings
from posegraph_slam.registration.local_search import LocalSearchSettings
from posegraph_slam.settings import Settings


class ProposalSettings(Settings):
    """Which pairs of keyframes are tried."""

    fixed_interval: int = Field(default=10, ge=0)
    """Try every n-th keyframe with the one n before it; 0 switches it off."""
    proximity: bool = True
    """Try places that the estimate brings near each other after enough travel."""
    start_end: bool = True
    """Try the last keyframe with the first."""
    segment_length_m: float = Field(default=1.0, gt=0)
    """Keyframes are gathered into places of about this length of travel; one keyframe of each is tried."""
    view_distance_m: float = Field(default=3.0, gt=0)
    """Places further apart than this, beyond what drift explains, do not see the same surfaces."""
    travel_min_m: float = Field(default=15.0, gt=0)
    """Least travel between two places, counted through closures that are already accepted."""
    travel_first_m: float = Field(default=40.0, gt=0)
    """Longest travel of the first round; each round doubles it, so that short loops are closed first."""
    keyframes_apart_min: int = Field(default=0, ge=0)
    """Least number of keyframes between two places."""
    drift_per_m: float = Field(default=0.03, ge=0)
    """One sigma of position drift per metre of travel."""
    drift_rad_per_m: float = Field(default=0.0015, ge=0)
    """One sigma of heading drift per metre of travel."""
    drift_max_m: float = Field(default=12.0, gt=0)
    """The search window never reaches further than this,"""
    drift_max_rad: float = Field(default=0.8, gt=0)
    """nor turns further than this."""
    targets_max: int = Field(default=2, ge=1)
    """Places that are tried for one place in a round."""
    rounds_max: int = Field(default=12, ge=1)
    """Rounds of proposing, verifying and solving."""


class DriftSettings(Settings):
    """What is known of the chain's systematic errors before any loop is closed."""

    heading_sigma_rad_per_m: float = Field(default=0.0015, gt=0)
    """Standard deviation of the heading bias per metre of travel."""
    turn_scale_sigma: float = Field(default=0.02, gt=0)
    """Standard deviation of the share by which turns come out too large or too small."""


class VerificationSettings(Settings):
    """What a registered candidate must show to become a constraint."""

    references: int = Field(default=2, ge=0, le=32)
    """Keyframes before and after the target that are matched together with it."""
    score_min: float = Field(default=0.45, ge=0, le=1)
    """Least score of the search on the likelihood field."""
    matched_fraction_min: float = Field(default=0.45, ge=0, le=1)
    """Least share of the source's points, in view of the references, that lie on their surfaces."""
    agreement_min: float = Field(default=0.85, ge=0, le=1)
    """Least share of points on the other scan's surface among those not in space that it saw free."""
    overlap_min: float = Field(default=0.3, ge=0, le=1)
    """Least share of points that the other scan sees at all."""
    rmse_max_m: float = Field(default=0.06, gt=0)
    """Largest weighted residual."""
    support_min: int = Field(default=1, ge=0)
    """Other candidates nearby that must agree with one that was found in a window wider than `trusted_drift_m`."""
    trusted_drift_m: float = Field(default=0.5, gt=0)
    """Candidates found in a window no wider than this need no support."""
    consistency_m: float = Field(default=0.3, gt=0)
    """Two candidates agree when the loop through both closes this well,"""
    consistency_rad: float = Field(default=0.06, gt=0)
    """and turns back this well."""
    free_space_margin_m: float = Field(default=0.2, gt=0)
    """A point this much nearer than the other scan's surface contradicts it."""
    sigma_max: float = Field(default=3.0, gt=0)
    """A closure that disagrees by more sigmas than this, with what the graph says of the same motion before it is
    added or with the solved graph after, is not believed."""
    covariance_floor_m: float = Field(default=0.02, gt=0)
    """A closure is not known better than this,"""
    covariance_floor_rad: float = Field(default=0.005, gt=0)
    """nor than this."""
    drift: DriftSettings = DriftSettings()
    match: BeamMatchSettings = BeamMatchSettings(gate_start_m=0.6, robust_start_m=0.3, iterations_max=20)
    search: LocalSearchSettings = LocalSearchSettings()


class LoopClosureSettings(Settings):
    """Loop closure as a whole."""

    enabled: bool = True
    """Whether loops are closed at all."""
    proposals: ProposalSettings = ProposalSettings()
    verification: VerificationSettings = VerificationSettings()
