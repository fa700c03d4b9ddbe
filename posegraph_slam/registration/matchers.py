"""Every matcher under its name, with one interface."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Protocol

from posegraph_slam.arrays import FloatArray
from posegraph_slam.registration.correlative_matching import CorrelativeSettings, SearchKind, match_correlatively
from posegraph_slam.registration.global_search import DEFAULT_SEARCH, GlobalSearchSettings, register_globally
from posegraph_slam.registration.icp import icp
from posegraph_slam.registration.result import RegistrationResult
from posegraph_slam.registration.settings import IcpSettings

QUICK_SEARCH = GlobalSearchSettings(rotations=300, survivors=(300, 60, 20), candidates=4)
"""A search that an object without near symmetries needs no more than."""


class Matcher(Protocol):
    """Registers source points (n, d) onto target points (m, d), from a guess or, if it searches, about one."""

    def __call__(
        self, source: FloatArray, target: FloatArray, T_target_source: FloatArray, /
    ) -> RegistrationResult: ...


def search_globally(
    source: FloatArray,
    target: FloatArray,
    T_target_source: FloatArray | None = None,
    settings: GlobalSearchSettings = DEFAULT_SEARCH,
) -> RegistrationResult:
    """Register points in space by `register_globally`, which needs no guess: the one given is not looked at."""
    return register_globally(source, target, settings).result


def available_matchers(dimension: int) -> Mapping[str, Matcher]:
    """Return the matchers for points of that dimension, 2 or 3, each with settings that suit a scan of a few metres."""
    loops: dict[str, Matcher] = {
        "point_to_point": partial(icp, settings=IcpSettings.point_to_point()),
        "point_to_plane": partial(icp, settings=IcpSettings.point_to_line()),
        "generalised": partial(icp, settings=IcpSettings.generalised()),
    }
    if dimension == 3:
        return {**loops, "global": partial(search_globally, settings=QUICK_SEARCH)}
    searches = {
        f"correlative_{kind}": partial(match_correlatively, settings=CorrelativeSettings(search=kind))
        for kind in SearchKind
    }
    return {**loops, **searches}
