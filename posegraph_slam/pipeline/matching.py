"""The scan-matching stage on a log: clocks compared, sweeps undone, scans chained."""

from __future__ import annotations

from dataclasses import replace

from posegraph_slam.arrays import FloatArray
from posegraph_slam.execution import Executor, Progress
from posegraph_slam.geometry import planar_from_spatial
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.scan_matching import ScanMatchingResult, match_scans
from posegraph_slam.odometry.timing import TimingSettings, estimate_timing, sweep_motion, turning_stretch, without_lag
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.registration.beam_scans import BeamScans, prepare_beam_scans
from posegraph_slam.sensors import LaserScans


def match_log(
    scans: LaserScans,
    odometry: OdometryEstimate,
    configuration: Configuration,
    *,
    executor: Executor,
    progress: Progress,
    known: ScanMatchingResult | None = None,
) -> ScanMatchingResult:
    """Chain all scans (N) from their odometry (N), after both clocks were compared; see `TimingSettings`.

    An earlier matching that is `known` has told the clocks. Where there is no odometry, the motion during a sweep is
    that of a first matching without regard to it.
    """
    matching, settings = configuration.scan_matching, configuration.timing
    lag, sweep = (0.0, 0.0) if known is None else (known.lag, known.sweep)
    if known is None and settings.estimate and matching.matcher != "none":
        stretch = turning_stretch(odometry, settings)
        beams = prepare_beam_scans(scans.select(stretch), configuration.scans, executor)
        timing = estimate_timing(beams, odometry.part(stretch), matching, settings)
        lag = timing.lag.share if timing.lag.significant(settings) else 0.0
        sweep = timing.sweep.share if timing.sweep.significant(settings) else 0.0
    odometry = without_lag(odometry, lag)
    motion = motion_in_sweep(scans, odometry.trajectory.poses, sweep, settings)
    if sweep and odometry.source == "none":
        beams = prepare_beam_scans(scans, configuration.scans, executor)
        first = match_scans(beams, odometry, matching, executor=executor, progress=progress)
        motion = motion_in_sweep(scans, first.trajectory.poses, sweep, settings)
    beams = prepare_beam_scans(scans, configuration.scans, executor, motion=motion)
    matched = match_scans(beams, odometry, matching, executor=executor, progress=progress)
    return replace(matched, lag=lag, sweep=sweep, remarks=(*matched.remarks, *_remarks(lag, sweep)))


def keyframe_scans(
    scans: LaserScans, matched: ScanMatchingResult, configuration: Configuration, executor: Executor
) -> BeamScans:
    """Return the keyframes (K) of a matched log, each as seen from the middle of its sweep."""
    motion = motion_in_sweep(scans, matched.trajectory.poses, matched.sweep, configuration.timing)
    at = matched.keyframes
    return prepare_beam_scans(scans.select(at), configuration.scans, executor, motion=motion[at])


def motion_in_sweep(scans: LaserScans, poses: FloatArray, sweep: float, settings: TimingSettings) -> FloatArray:
    """Return the motion (N, 3) of the lidar in each sweep, from planar base poses (N, 3, 3)."""
    return sweep_motion(poses @ planar_from_spatial(scans.T_base_lidar), sweep, settings)


def _remarks(lag: float, sweep: float) -> tuple[str, ...]:
    """Say what was corrected."""
    remarks = []
    if lag:
        way = "behind" if lag > 0 else "ahead of"
        remarks.append(f"the logged odometry is {abs(lag):.2f} scan intervals {way} the laser: corrected")
    if sweep:
        remarks.append(f"a sweep of the laser takes {abs(sweep):.3f} of the scan interval: its motion is undone")
    return tuple(remarks)
