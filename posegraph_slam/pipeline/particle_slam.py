"""Particle-filter SLAM of a log on disk: from the log to a run directory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.datasets import read
from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.evaluation.summary import compare, evaluate_trajectory
from posegraph_slam.evaluation.tables import ComparisonTable
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.jit import measure_compile_time
from posegraph_slam.localization.particle_slam import ParticleSlamResult, particle_slam
from posegraph_slam.mapping.archive import write_occupancy
from posegraph_slam.mapping.crispness import crispness
from posegraph_slam.mapping.images import write_png
from posegraph_slam.mapping.nav2 import map_pixels, write_nav2
from posegraph_slam.odometry.scan_odometry import odometry_at_scans
from posegraph_slam.pipeline.clock import StageClock
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.optimize import usable_scans
from posegraph_slam.pipeline.run_directory import METRICS, RECORD, RunDirectory, create_run_directory, require_free
from posegraph_slam.pipeline.run_record import run_record


@dataclass(frozen=True, slots=True, kw_only=True)
class ParticleSlamSummary:
    """What a run gave: its folder, the comparison with odometry, its metrics and record, and remarks for people."""

    folder: Path
    table: ComparisonTable
    metrics: Mapping[str, Any]
    record: Mapping[str, Any]
    remarks: tuple[str, ...]


def run_particle_slam(
    log_path: Path,
    configuration: Configuration,
    *,
    out: Path,
    overwrite: bool = False,
    log_format: str | None = None,
    progress: Progress = silent_progress,
    command: Sequence[str] | None = None,
) -> ParticleSlamSummary:
    """Run the particle filter on the log at `log_path` and leave trajectory and map in the run directory `out`.

    Raises InputError where `out` is taken or the log cannot be used; nothing is then left.
    """
    require_free(out, overwrite=overwrite)
    clock = StageClock()
    with create_run_directory(out, overwrite=overwrite) as directory:
        with measure_compile_time() as compiling:
            with clock.stage("reading"):
                log = read(log_path, format=log_format)
                scans = usable_scans(log)
            with clock.stage("odometry"):
                odometry = odometry_at_scans(log, configuration.odometry)
            with clock.stage("particle filter"):
                result = particle_slam(
                    scans,
                    odometry.trajectory,
                    configuration.particle_slam,
                    rng=np.random.default_rng(configuration.seed),
                    progress=progress,
                )
        with clock.stage("evaluation"):
            measured = {
                "odometry": evaluate_trajectory(odometry.trajectory, truth=log.truth, relations=log.relations),
                "particle filter": evaluate_trajectory(
                    result.trajectory,
                    truth=log.truth,
                    relations=log.relations,
                    crispness=crispness(result.occupancy),
                ),
            }
            table = compare(measured)
        metrics = {
            "table": table.as_dict(),
            "stages": {name: each.as_dict() for name, each in measured.items()},
            "scans": len(scans),
            "resamplings": result.resamplings,
            "mean_effective_number": float(result.effective.mean()),
        }
        with clock.stage("saving"):
            directory.write_configuration(configuration)
            write_tum(odometry.trajectory, directory.path("odometry.tum"))
            save_particle_slam(result, directory)
            directory.write_json(METRICS, metrics)
        record = run_record(
            configuration,
            log_path,
            log_format=log.format,
            stages_s=clock.seconds,
            jit_compile_s=compiling.seconds,
            command=command,
        )
        directory.write_json(RECORD, record)
    return ParticleSlamSummary(
        folder=out, table=table, metrics=metrics, record=record, remarks=(*log.remarks, *odometry.remarks)
    )


def save_particle_slam(result: ParticleSlamResult, directory: RunDirectory) -> None:
    """Write the trajectory of the best particle and the map that it drew."""
    write_tum(result.trajectory, directory.path("trajectory.tum"))
    folder = directory.path("maps/map.pgm").parent
    write_nav2(result.occupancy, folder)
    write_png(map_pixels(result.occupancy), folder / "map.png")
    write_occupancy(result.occupancy, folder / "map.npz")
