"""The main job end to end: files, figures of merit, determinism, and what it refuses."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from posegraph_slam.datasets import read
from posegraph_slam.datasets.simulation import LidarSettings, demo_settings, drive, simulate, tiny_settings
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.ape import absolute_pose_error
from posegraph_slam.evaluation.relations import relation_errors
from posegraph_slam.mapping.archive import read_occupancy
from posegraph_slam.mapping.nav2 import read_nav2
from posegraph_slam.pipeline.configuration import Configuration, load_configuration
from posegraph_slam.pipeline.executors import ThreadExecutor
from posegraph_slam.pipeline.optimize import OptimizationResult, optimize
from posegraph_slam.pipeline.run import RunSummary, run
from posegraph_slam.pose_graph.g2o import read_g2o
from posegraph_slam.report.run_figures import draw_figures
from posegraph_slam.sensors import RobotLog

FILES = {
    "run.json", "config.toml", "metrics.json", "loops.csv", "graph.g2o",
    "odometry.tum", "scan_matching.tum", "trajectory.tum",
    "maps/map.pgm", "maps/map.yaml", "maps/map.png", "maps/map.npz", "maps/texture.png",
    "figures/trajectories.png", "figures/map.png", "figures/texture.png",
}  # fmt: skip


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tiny_settings(duration_s=30.0, images=True), tmp_path_factory.mktemp("log") / "one")


@pytest.fixture(scope="module")
def told() -> set[str]:
    """Stages whose progress was told while the run of `finished` went on."""
    return set()


@pytest.fixture(scope="module")
def finished(simulated: Path, told: set[str], tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    return run(
        simulated,
        Configuration(),
        out=tmp_path_factory.mktemp("runs") / "run",
        draw=draw_figures,
        progress=lambda stage, done, total: told.add(stage),
    )


def test_the_run_directory_is_complete_and_readable(simulated: Path, finished: RunSummary) -> None:
    folder = finished.folder
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert present >= FILES
    log = read(simulated)
    assert log.scans is not None
    for name in ("odometry", "scan_matching", "trajectory"):
        stamps = read_tum(folder / f"{name}.tum", parent="map", child="base").stamps_s
        np.testing.assert_array_equal(stamps, log.scans.stamps_s)
    graph = read_g2o(folder / "graph.g2o")
    metrics = json.loads((folder / "metrics.json").read_text())
    assert len(graph) == metrics["keyframes"]
    with (folder / "loops.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == metrics["loops_proposed"]
    assert sum(row["accepted"] == "true" for row in rows) == metrics["loops_accepted"]
    assert all(row["reason"] for row in rows if row["accepted"] == "false")
    exact, coarse = read_occupancy(folder / "maps/map.npz"), read_nav2(folder / "maps/map.yaml")
    assert coarse.geometry.shape == exact.geometry.shape
    np.testing.assert_array_equal(coarse.occupied, exact.occupied)
    record = json.loads((folder / "run.json").read_text())
    assert record["configuration_sha256"]
    assert set(record["stages_s"]) >= {"reading", "odometry", "scan matching", "loop closure", "maps", "figures"}


def test_progress_reaches_every_stage(finished: RunSummary, told: set[str]) -> None:
    assert finished.folder.is_dir()
    assert told >= {"scan matching", "loop closure", "occupancy map", "texture map"}


def test_optimising_beats_scan_matching_beats_odometry() -> None:
    log = drive(demo_settings(lidar=LidarSettings(beams=361, rate_hz=5.0)))
    result = optimize(log, Configuration())
    assert log.truth is not None
    error = [absolute_pose_error(t, log.truth).translation_m.rmse for t in result.stages.values()]
    assert error[2] < 0.02
    assert error[2] < error[1] < error[0]
    assert list(result.stages) == ["odometry", "scan matching", "optimised"]


def test_without_loops_the_chain_stands(simulated: Path) -> None:
    log = read(simulated)
    result = optimize(log, load_configuration(overrides=["loop_closure.enabled=false", "smoothing=false"]))
    assert not result.loops
    np.testing.assert_allclose(result.trajectory.poses, result.stages["scan matching"].poses, atol=1e-9)


@pytest.mark.parametrize("scans", [0, 1])
def test_a_log_without_lidar_is_refused(scans: int) -> None:
    log = drive(tiny_settings())
    assert log.scans is not None
    short = dataclasses.replace(log, scans=log.scans.select(slice(0, scans)) if scans else None)
    with pytest.raises(InputError, match=f"has {scans} laser scans"):
        optimize(short, Configuration())


def test_scans_that_hit_nothing_are_refused() -> None:
    log = drive(tiny_settings())
    assert log.scans is not None
    blind = dataclasses.replace(log.scans, ranges_m=np.full_like(log.scans.ranges_m, np.nan))
    with pytest.raises(InputError, match="hit anything"):
        optimize(dataclasses.replace(log, scans=blind), Configuration())


def test_some_empty_scans_are_bridged() -> None:
    log = drive(tiny_settings(duration_s=20.0))
    assert log.scans is not None
    assert log.truth is not None
    ranges = np.array(log.scans.ranges_m)
    ranges[30:40] = np.nan
    result = optimize(dataclasses.replace(log, scans=dataclasses.replace(log.scans, ranges_m=ranges)), Configuration())
    assert absolute_pose_error(result.trajectory, log.truth).translation_m.max < 0.1


def real_run(log: Path, preset: list[str] | None = None) -> tuple[RobotLog, OptimizationResult]:
    read_log = read(log)
    with ThreadExecutor(2) as executor:
        return read_log, optimize(read_log, load_configuration(preset or []), executor=executor)


@pytest.mark.data
@pytest.mark.slow
def test_differential_drive_robot(psg_data: Path) -> None:
    log, result = real_run(psg_data / "ece276a/20")
    assert log.truth is not None
    assert absolute_pose_error(result.stages["odometry"], log.truth).translation_m.rmse < 0.85
    assert absolute_pose_error(result.trajectory, log.truth).translation_m.rmse < 0.03


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "translation_m", "rotation_deg"), [("intel", 0.0229, 0.453), ("fr079", 0.0452, 0.538)]
)
def test_laser_logs_against_the_published_figures_of_cartographer(
    psg_data: Path, name: str, translation_m: float, rotation_deg: float
) -> None:
    """Hess et al. 2016, table of the relations of Kuemmerle et al. 2009."""
    log, result = real_run(psg_data / f"carmen/{name}.clf")
    assert log.relations is not None
    errors = relation_errors(result.trajectory, log.relations)
    assert errors.all.translation_m.mean < translation_m
    assert errors.all.rotation_deg.mean < rotation_deg
