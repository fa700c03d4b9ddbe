"""The scan-matching stage: a pose for every scan, and the keyframes of the graph with the motion between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import FloatArray, IntArray, read_only
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress
from posegraph_slam.geometry import SE2, Trajectory, pose_from_xyt, xyt_from_pose
from posegraph_slam.odometry.estimate import OdometryEstimate, covariance_between
from posegraph_slam.odometry.hit_map_tracking import track_on_hits
from posegraph_slam.odometry.local_map import STATISTICS, track
from posegraph_slam.odometry.scan_to_scan import chain_by_icp
from posegraph_slam.odometry.wheel_calibration import UNCALIBRATED, WayByScans, WheelCalibration
from posegraph_slam.registration.beam_information import information_in_base, information_with_floor, inverse
from posegraph_slam.registration.beam_matching import BeamMatchSettings
from posegraph_slam.registration.beam_scans import BeamScans
from posegraph_slam.registration.hit_map_matching import HitMapSettings
from posegraph_slam.registration.local_search import LocalSearchSettings
from posegraph_slam.registration.settings import IcpSettings
from posegraph_slam.settings import Settings


class ScanMatchingSettings(Settings):
    """How scans are chained into a trajectory."""

    matcher: Literal["local_map", "scan_to_scan", "correlative", "none"] = "local_map"
    """`local_map`: to lines of the last keyframes; `scan_to_scan`: ICP to the scan before; `correlative`: to one
    growing map of hit counts; `none`: odometry alone."""
    references: int = Field(default=4, ge=1, le=64)
    """Keyframes that form the local map: the last two,"""
    reference_stride: int = Field(default=3, ge=1, le=64)
    """and, further back, every n-th."""
    keyframe_distance_m: float = Field(default=0.3, gt=0)
    """A new keyframe is added after this distance,"""
    keyframe_turn_rad: float = Field(default=0.2, gt=0)
    """or after this turn."""
    matched_fraction_min: float = Field(default=0.3, ge=0, le=1)
    """When less of a scan matches, a window around the prediction is searched."""
    search_reach_m: float = Field(default=1.0, gt=0)
    """Half the side of that window,"""
    search_reach_rad: float = Field(default=1.6, gt=0)
    """and the largest turn in it."""
    prediction_sigma_m: float = Field(default=0.01, gt=0)
    """Added to the odometry's own sigma of a step, because its errors are systematic rather than random."""
    prediction_sigma_rad: float = Field(default=0.01, gt=0)
    """The same for its heading."""
    scan_sigma_m: float = Field(default=0.005, gt=0)
    """Jitter of a matched scan in its local map, which odometry smooths in the end,"""
    scan_sigma_rad: float = Field(default=0.002, gt=0)
    """and of its heading."""
    covariance_floor_m: float = Field(default=0.01, gt=0)
    """The motion between keyframes is not known better than this, whatever the number of points says."""
    covariance_floor_rad: float = Field(default=0.003, gt=0)
    """The same for the turn between keyframes."""
    match: BeamMatchSettings = BeamMatchSettings()
    """Matching of a scan to the local map."""
    icp: IcpSettings = IcpSettings()
    """Registration of a scan to the one before it (`scan_to_scan`)."""
    search: LocalSearchSettings = LocalSearchSettings()
    hits: HitMapSettings = HitMapSettings()
    """Map and windows of `correlative`."""
    hits_size_m: float = Field(default=0.0, ge=0)
    """Side of that map, a square about the start; 0: it fits the log."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanMatchingResult:
    """T_odom_base at every scan (N, 3, 3), the scans that are keyframes (K,), and the noise of both.

    `keyframe_information` (K-1, 3, 3) belongs to the motion from keyframe k to k+1, `scan_information` (N, 3, 3) to
    the pose of each scan in the local map; both in the tangent of the right update in the base frame.
    `matched_fraction` (N,) is the share of a scan's points that found a surface; `searched` holds the scans for which
    a window was searched. `lag` of the odometry and duration of a `sweep`, both in scan intervals, were corrected, and
    so was the way of the `wheels` where they were calibrated.
    """

    trajectory: Trajectory
    keyframes: IntArray
    keyframe_information: FloatArray
    scan_information: FloatArray
    matched_fraction: FloatArray
    searched: IntArray
    lag: float = 0.0
    sweep: float = 0.0
    wheels: WheelCalibration = UNCALIBRATED
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "keyframes", read_only(self.keyframes, np.int64))
        object.__setattr__(self, "keyframe_information", read_only(self.keyframe_information))
        object.__setattr__(self, "scan_information", read_only(self.scan_information))
        object.__setattr__(self, "matched_fraction", read_only(self.matched_fraction))
        object.__setattr__(self, "searched", read_only(self.searched, np.int64))

    @property
    def way(self) -> WayByScans:
        """What the scans say of the way, to compare wheels with."""
        return WayByScans(poses=self.trajectory.poses, information=self.scan_information, keyframes=self.keyframes)


def match_scans(
    scans: BeamScans,
    odometry: OdometryEstimate,
    settings: ScanMatchingSettings,
    *,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
) -> ScanMatchingResult:
    """Chain all scans (N) from their odometry poses (N): see `ScanMatchingSettings.matcher`."""
    progress("scan matching", 0, len(scans))
    if settings.matcher == "local_map":
        result = _track_local_map(scans, odometry, settings)
    elif settings.matcher == "correlative":
        result = _match_on_hits(scans, odometry, settings)
    elif settings.matcher == "scan_to_scan":
        result = _chain_scans(scans, odometry, settings, executor or SerialExecutor(), progress)
    else:
        result = _odometry_alone(odometry, settings)
    progress("scan matching", len(scans), len(scans))
    return result


def select_keyframes(poses: FloatArray, settings: ScanMatchingSettings) -> IntArray:
    """Pick scans (K,) of a chain of poses (N, 3, 3) after each keyframe distance or turn, the first included."""
    step = SE2.log(SE2.between(poses[:-1], poses[1:]))
    progress = np.maximum(
        np.cumsum(np.hypot(step[:, 0], step[:, 1])) / settings.keyframe_distance_m,
        np.cumsum(np.abs(step[:, 2])) / settings.keyframe_turn_rad,
    )
    return np.flatnonzero(np.concatenate([[True], np.diff(np.floor(progress), prepend=0.0) > 0]))


def _scan_noise(count: int, settings: ScanMatchingSettings) -> FloatArray:
    """Information (N, 3, 3) of scans that no local map holds in place."""
    sigmas = np.array([settings.scan_sigma_m, settings.scan_sigma_m, settings.scan_sigma_rad])
    return np.tile(np.diag(sigmas**-2.0), (count, 1, 1))


def _track_local_map(
    scans: BeamScans, odometry: OdometryEstimate, settings: ScanMatchingSettings
) -> ScanMatchingResult:
    lidar = odometry.trajectory.poses @ scans.T_base_lidar
    increments, sigmas = np.zeros((len(scans), 3)), np.ones((len(scans), 3))
    increments[1:] = xyt_from_pose(SE2.between(lidar[:-1], lidar[1:]))
    floor = np.array([settings.prediction_sigma_m] * 2 + [settings.prediction_sigma_rad])
    sigmas[1:] = np.sqrt(np.diagonal(odometry.covariance, axis1=1, axis2=2) + floor**2)
    scheme = np.array(
        [
            settings.references,
            settings.keyframe_distance_m,
            settings.keyframe_turn_rad,
            settings.matched_fraction_min,
            settings.search_reach_m,
            settings.search_reach_rad,
            float(odometry.source == "none"),
            settings.reference_stride,
        ]
    )
    poses, stats, hessians, keyframes = track(
        increments,
        sigmas,
        scheme,
        settings.search.vector(),
        settings.match.vector(),
        scans.points,
        scans.lines,
        scans.kind,
        scans.thinned,
        scans.geometry,
    )
    assert stats.shape[1] == STATISTICS
    base = pose_from_xyt(poses) @ SE2.inverse(scans.T_base_lidar)
    start = odometry.trajectory.poses[0]
    base = start @ SE2.inverse(base[0]) @ base
    covariance = covariance_between(odometry.trajectory.poses, odometry.covariance, keyframes[:-1], keyframes[1:])
    matched = information_in_base(
        information_with_floor(hessians[keyframes[1:]], settings.covariance_floor_m, settings.covariance_floor_rad),
        scans.T_base_lidar,
    )
    fraction = stats[:, 1] / np.maximum(stats[:, 0], 1)
    fraction[0] = 1.0
    searched = np.flatnonzero(stats[:, 6])
    poor = int(np.sum(fraction < settings.matched_fraction_min))
    remarks = (f"{poor} of {len(scans)} scans match their surroundings poorly",) if poor > 0.02 * len(scans) else ()
    return ScanMatchingResult(
        trajectory=odometry.trajectory.with_poses(base),
        keyframes=keyframes,
        keyframe_information=matched + inverse(covariance),
        scan_information=information_in_base(
            information_with_floor(hessians, settings.scan_sigma_m, settings.scan_sigma_rad), scans.T_base_lidar
        ),
        matched_fraction=fraction,
        searched=searched,
        remarks=remarks,
    )


def _chain_scans(
    scans: BeamScans,
    odometry: OdometryEstimate,
    settings: ScanMatchingSettings,
    executor: Executor,
    progress: Progress,
) -> ScanMatchingResult:
    poses, information, pairs = chain_by_icp(scans, odometry, settings.icp, executor=executor, progress=progress)
    keyframes = select_keyframes(poses, settings)
    covariance = covariance_between(poses, inverse(information), keyframes[:-1], keyframes[1:])
    failed = np.flatnonzero(~pairs.usable)
    remark = f"{len(failed)} of {len(pairs)} scan pairs could not be registered: odometry took their place"
    return ScanMatchingResult(
        trajectory=odometry.trajectory.with_poses(poses),
        keyframes=keyframes,
        keyframe_information=inverse(covariance),
        scan_information=_scan_noise(len(poses), settings),
        matched_fraction=np.concatenate([[1.0], pairs.inlier_fraction]),
        searched=np.zeros(0, dtype=np.int64),
        remarks=(remark,) if len(failed) else (),
    )


def _match_on_hits(scans: BeamScans, odometry: OdometryEstimate, settings: ScanMatchingSettings) -> ScanMatchingResult:
    """Match to the map of hit counts: what a pose is known to is the step of the fine window, and a floor."""
    poses, share = track_on_hits(scans, odometry, settings.hits, settings.hits_size_m)
    fine, keyframes = settings.hits.fine, select_keyframes(poses, settings)
    sigma_m = np.hypot(fine.step_m, settings.covariance_floor_m)
    sigma_rad = np.hypot(fine.step_rad, settings.covariance_floor_rad)
    matched = np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])
    covariance = covariance_between(poses, odometry.covariance, keyframes[:-1], keyframes[1:])
    return ScanMatchingResult(
        trajectory=odometry.trajectory.with_poses(poses),
        keyframes=keyframes,
        keyframe_information=matched + inverse(covariance),
        scan_information=np.tile(matched, (len(poses), 1, 1)),
        matched_fraction=share,
        searched=np.zeros(0, dtype=np.int64),
    )


def _odometry_alone(odometry: OdometryEstimate, settings: ScanMatchingSettings) -> ScanMatchingResult:
    poses = odometry.trajectory.poses
    keyframes = select_keyframes(poses, settings)
    covariance = covariance_between(poses, odometry.covariance, keyframes[:-1], keyframes[1:])
    return ScanMatchingResult(
        trajectory=odometry.trajectory,
        keyframes=keyframes,
        keyframe_information=inverse(covariance),
        scan_information=_scan_noise(len(poses), settings),
        matched_fraction=np.zeros(len(poses)),
        searched=np.zeros(0, dtype=np.int64),
    )
