"""Registration of point sets and scans: one result type, several matchers."""

from posegraph_slam.registration.cloud import Cloud, prepare_cloud
from posegraph_slam.registration.correlative_matching import CorrelativeSettings, SearchKind, match_correlatively
from posegraph_slam.registration.downsampling import downsample
from posegraph_slam.registration.global_search import (
    GlobalRegistration,
    GlobalSearchSettings,
    StartKind,
    prepare_target,
    register_globally,
)
from posegraph_slam.registration.icp import icp
from posegraph_slam.registration.matchers import Matcher, available_matchers
from posegraph_slam.registration.result import RegistrationResult, RegistrationStatus
from posegraph_slam.registration.scan_pairs import PairResults, PointSets, match_consecutive, match_pairs
from posegraph_slam.registration.settings import AssociationKind, IcpSettings, Loss, ResidualKind

__all__ = [
    "AssociationKind",
    "Cloud",
    "CorrelativeSettings",
    "GlobalRegistration",
    "GlobalSearchSettings",
    "IcpSettings",
    "Loss",
    "Matcher",
    "PairResults",
    "PointSets",
    "RegistrationResult",
    "RegistrationStatus",
    "ResidualKind",
    "SearchKind",
    "StartKind",
    "available_matchers",
    "downsample",
    "icp",
    "match_consecutive",
    "match_correlatively",
    "match_pairs",
    "prepare_cloud",
    "prepare_target",
    "register_globally",
]
