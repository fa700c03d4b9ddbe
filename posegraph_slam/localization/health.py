"""Is the pose known? The state of the estimate, from how well recent scans agree with the map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

from posegraph_slam.localization.settings import HealthSettings


class Health(IntEnum):
    """`OK`: the pose is known; `AMBIGUOUS`: several places fit, or the spread is wide; `LOST`: none fits."""

    LOST = 0
    AMBIGUOUS = 1
    OK = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """Of one scan at the best pose: returns in all, those that agree and those that conflict with the map.

    `share` is the weight of the best hypothesis, number `hypothesis`, and `sigma_m` its spread; `margin` is how much
    worse other places fitted when they were last looked for, in log-odds a return, and `rival_agreement` the share of
    returns that agree at a place which fits like the best of them.
    """

    hypothesis: int
    share: float
    sigma_m: float
    returns: int
    agree: int
    conflict: int
    margin: float = math.inf
    rival_agreement: float = -math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthState:
    """What is remembered of the best `hypothesis`: mean counts of its returns, and the updates."""

    health: Health
    hypothesis: int = 0
    updates: int = 0
    agree: float = 0.0
    telling: float = 0.0
    returns: float = 0.0

    @property
    def agreement(self) -> float:
        """Share of the telling returns that agree with the map; 0 before there are any."""
        return self.agree / self.telling if self.telling > 0 else 0.0

    @property
    def explained(self) -> float:
        """Share of all returns that agree: less than the agreement where the scans reach into unknown space."""
        return self.agree / self.returns if self.returns > 0 else 0.0


def assess(state: HealthState, evidence: Evidence, settings: HealthSettings) -> HealthState:
    """Return the state after an update.

    A known pose stays known while its agreement does; a new one is believed when one hypothesis has nearly all the
    weight and has agreed for a while. A scan that lies mostly in unknown space says nothing. Averaging counts, not
    shares, lets a scan speak in proportion to what it saw of the map: someone who walks by does not end a track.
    """
    if evidence.hypothesis != state.hypothesis:
        state = HealthState(health=state.health, hypothesis=evidence.hypothesis)
    telling = evidence.agree + evidence.conflict
    if telling >= settings.evidence_min and telling >= settings.evidence_share * evidence.returns:
        updates = state.updates + 1
        gain = 1 / min(updates, settings.memory_updates)
        state = replace(
            state,
            updates=updates,
            agree=state.agree + gain * (evidence.agree - state.agree),
            telling=state.telling + gain * (telling - state.telling),
            returns=state.returns + gain * (evidence.returns - state.returns),
        )
    return replace(state, health=_judged(state, evidence, settings))


def _judged(state: HealthState, evidence: Evidence, settings: HealthSettings) -> Health:
    if state.updates == 0:
        return state.health
    certain = evidence.share >= settings.share_min and evidence.sigma_m <= settings.sigma_max_m
    if state.agreement < settings.lost_below:
        # One scan is enough to end a track only once the mean holds: a fresh hypothesis gets its updates first.
        return Health.LOST if state.updates >= settings.updates_min else state.health
    if state.health is Health.OK:
        return Health.OK if certain else Health.AMBIGUOUS
    # Where a map is incomplete, something nearly fits in many places: a new place has to explain the whole scan.
    least = settings.clear_above if evidence.margin >= settings.clear_margin else settings.found_above
    if state.agreement < least or state.explained < settings.explained_min:
        return state.health
    # Looking along a corridor from either end, nearly all returns agree at both: the lead alone proves nothing yet.
    alone = evidence.margin >= settings.rival_margin and evidence.rival_agreement < settings.found_above
    return Health.OK if certain and alone and state.updates >= settings.updates_min else Health.AMBIGUOUS
