"""Registration of point sets and scans: one result type, several matchers."""

from posegraph_slam.registration.cloud import Cloud, prepare_cloud
from posegraph_slam.registration.icp import icp
from posegraph_slam.registration.result import RegistrationResult, RegistrationStatus
from posegraph_slam.registration.scan_pairs import PairResults, PointSets, match_consecutive, match_pairs
from posegraph_slam.registration.settings import AssociationKind, IcpSettings, Loss, ResidualKind

__all__ = [
    "AssociationKind",
    "Cloud",
    "IcpSettings",
    "Loss",
    "PairResults",
    "PointSets",
    "RegistrationResult",
    "RegistrationStatus",
    "ResidualKind",
    "icp",
    "match_consecutive",
    "match_pairs",
    "prepare_cloud",
]
