"""Localisation of a log in a known map: from two files to a run directory."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Unpack

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.geometry import Trajectory
from posegraph_slam.localization.health import Health
from posegraph_slam.localization.known_map import LocalizationResult, localize, prepare_map
from posegraph_slam.mapping.nav2 import read_nav2
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.odometry.scan_matching import match_scans
from posegraph_slam.odometry.scan_odometry import odometry_at_scans
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.optimize import usable_scans
from posegraph_slam.pipeline.recording import RunOptions, RunOutcome, recorded_run
from posegraph_slam.pipeline.run_directory import METRICS, RunDirectory
from posegraph_slam.pipeline.run_record import fingerprint
from posegraph_slam.registration.beam_scans import BeamScans, prepare_beam_scans
from posegraph_slam.sensors import RobotLog

STATES = "localization.csv"
COLUMNS = (
    "stamp_s", "health", "agreement", "share", "particles", "cov_xx", "cov_xy", "cov_xt", "cov_yy", "cov_yt", "cov_tt"
)  # fmt: skip


def motion_of_log(log: RobotLog, configuration: Configuration) -> tuple[BeamScans, Trajectory, tuple[str, ...]]:
    """Return a log's prepared scans, the motion that moves the particles (a pose a scan), and remarks."""
    scans = usable_scans(log)
    odometry = odometry_at_scans(log, configuration.odometry)
    beams = prepare_beam_scans(scans, configuration.scans)
    if configuration.localization.propagation == "odometry":
        return beams, odometry.trajectory, odometry.remarks
    matched = match_scans(beams, odometry, configuration.scan_matching)
    return beams, matched.trajectory, (*odometry.remarks, *matched.remarks)


def localize_log(
    grid: OccupancyGrid,
    log: RobotLog,
    configuration: Configuration,
    *,
    start: FloatArray | None = None,
    progress: Progress = silent_progress,
) -> tuple[LocalizationResult, tuple[str, ...]]:
    """Localise the scans of a log in a map; `start` (3,) [x, y, theta] is the first one's pose, searched where None."""
    beams, motion, remarks = motion_of_log(log, configuration)
    known = prepare_map(grid, configuration.localization)
    rng = np.random.default_rng(configuration.seed)
    result = localize(known, beams, motion, configuration.localization, rng=rng, start=start, progress=progress)
    return result, (*log.remarks, *remarks, *health_remarks(result))


def run_localization(
    map_path: Path,
    log_path: Path,
    configuration: Configuration,
    *,
    start: FloatArray | None = None,
    progress: Progress = silent_progress,
    **options: Unpack[RunOptions],
) -> RunOutcome:
    """Localise the log at `log_path` in the nav2 map at `map_path` and leave the result in the run directory `out`.

    Raises InputError where `out` is taken, or map or log cannot be used; nothing is then left.
    """
    with recorded_run(log_path, configuration, **options) as run:
        with run.clock.stage("reading"):
            grid = read_nav2(map_path)
            run.inputs["map"] = fingerprint(map_path)
        with run.clock.stage("localisation"):
            result, remarks = localize_log(grid, run.log, configuration, start=start, progress=progress)
        metrics = summarise(result)
        with run.clock.stage("saving"):
            save_localization(result, run.directory)
            run.directory.write_json(METRICS, metrics)
    return RunOutcome(folder=run.folder, metrics=metrics, record=run.record, remarks=remarks)


def save_localization(result: LocalizationResult, directory: RunDirectory) -> None:
    """Write the trajectory, and beside it health and covariance of every scan in the same order, that of the stamps."""
    write_tum(result.trajectory, directory.path("trajectory.tum"))
    order = np.argsort(result.trajectory.stamps_s, kind="stable")
    upper = np.triu_indices(3)
    covariance = result.covariance[:, upper[0], upper[1]]
    rows = (
        [
            f"{result.trajectory.stamps_s[k]:.9f}",
            Health(int(result.health[k])).name.lower(),
            result.agreement[k],
            result.share[k],
            result.particles[k],
            *covariance[k],
        ]
        for k in order
    )
    directory.write_rows(STATES, COLUMNS, rows)


def summarise(result: LocalizationResult) -> dict[str, Any]:
    """Return counts of the run for `metrics.json`."""
    known = result.health == Health.OK
    stamps = result.trajectory.stamps_s
    sigma = np.sqrt(result.covariance[:, 0, 0] + result.covariance[:, 1, 1])
    return {
        "scans": len(known),
        "health": {each.name.lower(): int((result.health == each).sum()) for each in Health},
        "first_known_s": float(stamps[known.argmax()] - stamps[0]) if known.any() else None,
        "times_lost": int(np.sum(known[:-1] & ~known[1:])),
        "known_at_the_end": bool(known[-1]),
        "mean_particles": float(result.particles.mean()),
        "median_position_sigma_m": float(np.median(sigma[known])) if known.any() else None,
    }


def health_remarks(result: LocalizationResult) -> tuple[str, ...]:
    """Say in plain words when the pose is not known."""
    known = result.health == Health.OK
    if not known.any():
        return ("the robot was never localised: no pose of this run can be trusted",)
    unknown = int((~known).sum())
    if not unknown:
        return ()
    return (f"the pose is not known at {unknown} of {len(known)} scans; {STATES} says which",)
