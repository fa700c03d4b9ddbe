"""Particle-filter SLAM of a log on disk: from the log to a run directory."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Unpack

import numpy as np

from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.evaluation.summary import TrajectoryMetrics, compare, evaluate_trajectory
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.geometry import Trajectory
from posegraph_slam.localization.particle_slam import ParticleSlamResult, particle_slam
from posegraph_slam.mapping.crispness import crispness
from posegraph_slam.odometry.scan_odometry import odometry_at_scans
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.optimize import usable_scans
from posegraph_slam.pipeline.recording import RunOptions, RunSummary, recorded_run
from posegraph_slam.pipeline.run_directory import METRICS
from posegraph_slam.pipeline.saving import save_occupancy
from posegraph_slam.sensors import RobotLog


def run_particle_slam(
    log_path: Path,
    configuration: Configuration,
    *,
    progress: Progress = silent_progress,
    **options: Unpack[RunOptions],
) -> RunSummary:
    """Run the particle filter on the log at `log_path` and leave trajectory and map in the run directory `out`.

    Raises InputError where `out` is taken or the log cannot be used; nothing is then left.
    """
    with recorded_run(log_path, configuration, **options) as run:
        scans = usable_scans(run.log)
        with run.clock.stage("odometry"):
            odometry = odometry_at_scans(run.log, configuration.odometry)
        with run.clock.stage("particle filter"):
            rng = np.random.default_rng(configuration.seed)
            result = particle_slam(scans, odometry.trajectory, configuration.particle_slam, rng=rng, progress=progress)
        with run.clock.stage("evaluation"):
            measured = measure(run.log, odometry.trajectory, result)
            table = compare(measured)
        metrics = {
            "table": table.as_dict(),
            "stages": {name: each.as_dict() for name, each in measured.items()},
            "scans": len(scans),
            "resamplings": result.resamplings,
            "map_memory_mib": result.map_bytes / 2**20,
            "mean_effective_number": float(result.effective.mean()),
        }
        with run.clock.stage("saving"):
            write_tum(odometry.trajectory, run.directory.path("odometry.tum"))
            write_tum(result.trajectory, run.directory.path("trajectory.tum"))
            save_occupancy(result.occupancy, run.directory)
            run.directory.write_json(METRICS, metrics)
    remarks = (*run.log.remarks, *odometry.remarks)
    return RunSummary(folder=run.folder, table=table, metrics=metrics, record=run.record, remarks=remarks)


def measure(log: RobotLog, odometry: Trajectory, result: ParticleSlamResult) -> Mapping[str, TrajectoryMetrics]:
    """Return what is known of the odometry's and the best particle's trajectories, by name."""
    sharp = crispness(result.occupancy)
    return {
        "odometry": evaluate_trajectory(odometry, truth=log.truth, relations=log.relations),
        "particle filter": evaluate_trajectory(
            result.trajectory, truth=log.truth, relations=log.relations, crispness=sharp
        ),
    }
