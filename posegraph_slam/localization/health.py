"""Is the pose known? The state of the estimate, from how well recent scans agree with the map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

from posegraph_slam.localization.settings import HealthSettings


class Health(IntEnum):
    """`OK`: the pose is known; `AMBIGUOUS`: several places fit, or the spread is wide; `LOST`: none fits."""

    LOST = 0
    AMBIGUOUS = 1
    OK = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthState:
    """What is remembered: the mean `agreement` of the best `hypothesis`, and the updates it is averaged over."""

    health: Health
    agreement: float
    updates: int
    hypothesis: int


def assess(
    state: HealthState,
    *,
    hypothesis: int,
    share: float,
    sigma_m: float,
    agree: int,
    conflict: int,
    settings: HealthSettings,
) -> HealthState:
    """Return the state after an update whose best hypothesis has weight `share` and position sigma `sigma_m`.

    A known pose stays known while its agreement does; a new one is believed when one hypothesis has nearly all the
    weight and has agreed for a while. The mean is that of the first updates, then an exponential one.
    """
    if hypothesis != state.hypothesis:
        state = replace(state, hypothesis=hypothesis, agreement=0.0, updates=0)
    if agree + conflict >= settings.evidence_min:
        updates = state.updates + 1
        now = agree / (agree + conflict)
        gain = 1 / min(updates, settings.memory_updates)
        state = replace(state, updates=updates, agreement=state.agreement + gain * (now - state.agreement))
    return replace(state, health=_judged(state, share, sigma_m, settings))


def _judged(state: HealthState, share: float, sigma_m: float, settings: HealthSettings) -> Health:
    certain = share >= settings.share_min and sigma_m <= settings.sigma_max_m
    known = state.updates > 0
    if known and state.agreement < settings.lost_below:
        return Health.LOST if state.health is Health.OK or state.updates >= settings.memory_updates else state.health
    if state.health is Health.OK:
        return Health.OK if certain else Health.AMBIGUOUS
    believed = state.updates >= settings.updates_min and state.agreement >= settings.found_above
    if certain and believed:
        return Health.OK
    return Health.AMBIGUOUS if known and state.agreement >= settings.found_above else state.health
