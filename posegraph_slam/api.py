"""The front door for programs: read a log, optimise it, look at the result, save it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from posegraph_slam.datasets.registry import read as read_log
from posegraph_slam.datasets.trajectory_files import read_trajectory
from posegraph_slam.evaluation.tables import ComparisonTable
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.geometry import Trajectory
from posegraph_slam.jit import measure_compile_time
from posegraph_slam.mapping.colour_cloud import ColourCloud
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.mapping.texture import TextureMap
from posegraph_slam.pipeline.clock import StageClock
from posegraph_slam.pipeline.configuration import Configuration, load_configuration, usable_workers
from posegraph_slam.pipeline.executors import open_executor
from posegraph_slam.pipeline.jobs import JobResult, optimize_log, save_job
from posegraph_slam.pipeline.optimize_rgbd import RgbdResult
from posegraph_slam.pipeline.run_directory import RECORD, create_run_directory
from posegraph_slam.pipeline.run_record import run_record
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.sensors import RobotLog

Overrides = Configuration | Mapping[str, Any] | str | Path | None
"""A whole configuration, keys to change, or the name of a preset or TOML file."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """What `optimize` found in a log; `result` holds all of it, the properties what is asked for most."""

    log: RobotLog
    configuration: Configuration
    result: JobResult
    _clock: StageClock = field(repr=False)
    _compile_s: float = field(repr=False)

    @property
    def trajectory(self) -> Trajectory:
        """The optimised trajectory, map -> base, a pose for every scan; map -> camera, every frame, of an RGB-D log."""
        return self.result.trajectory

    @property
    def stages(self) -> Mapping[str, Trajectory]:
        """Trajectories by name: odometry, scan matching (of scans), optimised."""
        return self.result.stages

    @property
    def map(self) -> OccupancyGrid | None:
        """The occupancy map from the optimised trajectory; None where `maps` is off, and for RGB-D logs."""
        return None if isinstance(self.result, RgbdResult) else self.result.occupancy

    @property
    def texture(self) -> TextureMap | None:
        """The coloured floor; None where the log has no images."""
        return None if isinstance(self.result, RgbdResult) else self.result.texture

    @property
    def cloud(self) -> ColourCloud | None:
        """The coloured cloud of an RGB-D log; None for other logs, and where `maps` is off."""
        return self.result.cloud if isinstance(self.result, RgbdResult) else None

    @property
    def graph(self) -> PoseGraph:
        """The solved pose graph of the keyframes."""
        return self.result.graph

    @property
    def table(self) -> ComparisonTable:
        """The stages side by side: errors where the truth is known, start-end gap, length, crispness."""
        return self.result.comparison

    @property
    def metrics(self) -> Mapping[str, Any]:
        """The same and the counts of the run as plain numbers, as in metrics.json."""
        return self.result.metrics

    def save(self, folder: str | Path, *, overwrite: bool = False, figures: bool = True) -> Path:
        """Write everything into the run directory `folder`, as `psg optimize --out` does, and return it.

        `figures` are the pictures and the report.
        The folder appears when it is complete. Raises InputError where it holds a run and `overwrite` is not set, or
        anything else.
        """
        from posegraph_slam.report.page import write_report_of
        from posegraph_slam.report.run_figures import draw_figures  # matplotlib costs half a second

        clock = StageClock(dict(self._clock.seconds))
        with create_run_directory(Path(folder), overwrite=overwrite) as directory:
            with clock.stage("saving"):
                directory.write_configuration(self.configuration)
                save_job(self.result, directory)
            if figures:
                with clock.stage("figures"):
                    draw_figures(self.result, directory)
            record = run_record(
                self.configuration,
                self.log.path,
                log_format=self.log.format,
                stages_s=clock.seconds,
                jit_compile_s=self._compile_s,
            )
            directory.write_json(RECORD, record)
            if figures:
                write_report_of(directory, Path(folder).resolve().name)
        return Path(folder)


def read(
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002 - the word users know
    topics: Mapping[str, str] | None = None,
) -> RobotLog:
    """Read a log with the reader that recognises it, or with the one called `format` (`psg datasets` lists them).

    `topics` chooses those of a bag, such as `{"scan": "/front/scan"}`, where the guessed ones are not meant. Raises
    InputError naming the file and what is wrong with it.
    """
    return read_log(path, format=format, topics=topics)


def optimize(
    log: RobotLog | str | Path,
    config: Overrides = None,
    *,
    truth: Trajectory | str | Path | None = None,
    seed: int | None = None,
    workers: int | None = None,
    progress: Progress = silent_progress,
) -> Run:
    """Find the trajectory of a robot, or of an RGB-D camera, and its maps in a log, given as such or by its path.

    `config` changes the defaults: a dict of keys (`{"mapping.resolution_m": 0.1}` or nested), the name of a preset, a
    TOML file, or a whole `Configuration`; `seed` and `workers` win over it. `truth` are true body poses (a file or a
    trajectory) that replace the log's own. Results do not depend on `workers` (0: one a core). Raises
    ConfigurationError for a key that is unknown or out of range, InputError for a log that cannot be used.
    """
    configuration = resolve_configuration(config, seed=seed, workers=workers)
    clock = StageClock()
    with measure_compile_time() as compiling:
        with clock.stage("reading"):
            robot_log = log if isinstance(log, RobotLog) else read_log(log)
            if truth is not None:
                known = truth if isinstance(truth, Trajectory) else read_trajectory(truth)
                robot_log = dataclasses.replace(robot_log, truth=known)
        with open_executor(usable_workers(configuration)) as executor:
            result = optimize_log(robot_log, configuration, progress=progress, executor=executor)
    clock.seconds.update(result.stages_s)
    return Run(log=robot_log, configuration=configuration, result=result, _clock=clock, _compile_s=compiling.seconds)


def resolve_configuration(config: Overrides, *, seed: int | None = None, workers: int | None = None) -> Configuration:
    """Return the configuration that `config` means, with `seed` and `workers` where they are given."""
    if isinstance(config, Configuration):
        given = {"seed": seed, "workers": workers}
        layer = {key: value for key, value in given.items() if value is not None}
        return load_configuration([config.model_dump(mode="json"), layer]) if layer else config
    return load_configuration([] if config is None else [config], seed=seed, workers=workers)


def simulate(folder: str | Path, settings: Mapping[str, Any] | None = None, *, overwrite: bool = False) -> Path:
    """Write the log of a simulated robot, with its truth, into `folder`, and return it.

    `settings` are keys that `psg simulate --show-settings` lists, dotted or nested. Raises ConfigurationError for an
    unknown one, InputError where `folder` is taken.
    """
    from posegraph_slam.datasets.simulation import SimulationSettings
    from posegraph_slam.datasets.simulation import simulate as write_log
    from posegraph_slam.pipeline.settings_files import Layer, build_settings

    layers = [Layer(source="settings", values=settings or {})]
    chosen = build_settings(SimulationSettings, layers, listing="psg simulate --show-settings")
    return write_log(chosen, Path(folder), overwrite=overwrite)
