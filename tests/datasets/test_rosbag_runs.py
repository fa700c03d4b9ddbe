"""A bag through the commands: the same robot as a bag and as a folder gives the same trajectory."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from posegraph_slam import datasets
from posegraph_slam.cli.application import app
from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.evaluation.ape import absolute_pose_error
from posegraph_slam.geometry import planar_from_spatial, xyt_from_pose
from posegraph_slam.odometry.scan_odometry import odometry_at_scans

from .bag_writing import START_NS, Entry, Maker, store_as


def psg(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A simulated log, and the same robot's scans and odometry as a bag with two lasers."""
    folder = tmp_path_factory.mktemp("bag")
    log = datasets.read(simulate(tiny_settings(duration_s=12.0), folder / "log"))
    assert log.scans is not None
    assert log.truth is not None
    maker, scans = Maker(ros2=True), log.scans
    odometry = xyt_from_pose(odometry_at_scans(log).trajectory.poses)
    truth = xyt_from_pose(planar_from_spatial(log.truth.spatial().poses))
    link = maker.transform(0, "base_link", "laser", scans.T_base_lidar[:3, 3], (0, 0, 0))
    entries: list[Entry] = [("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, maker.transforms(link))]
    for k, stamp in enumerate(scans.stamps_s):
        ns = round(stamp * 1e9)
        scan = maker.scan(
            ns, scans.ranges_m[k], angle_min=scans.angle_min_rad, angle_increment=scans.angle_increment_rad,
            range_min=scans.range_min_m, range_max=scans.range_max_m,
        )  # fmt: skip
        entries += [
            ("/front/scan", "sensor_msgs/msg/LaserScan", ns, scan),
            ("/rear/scan", "sensor_msgs/msg/LaserScan", ns, scan),
            ("/odom", "nav_msgs/msg/Odometry", ns, maker.odometry(ns, tuple(odometry[k]))),
            ("/ground_truth", "nav_msgs/msg/Odometry", ns, maker.odometry(ns, tuple(truth[k]))),
        ]
    return log.path, store_as("mcap", folder, entries)


def test_a_bag_is_optimised_like_the_folder_that_it_was_made_from(robot: tuple[Path, Path], tmp_path: Path) -> None:
    folder, bag = robot
    for name, path in (("folder", folder), ("bag", bag)):
        result = psg("optimize", path, "--out", tmp_path / name, "--set", "maps=false")
        assert result.exit_code == 0, result.output
    assert "note: topics: scan /front/scan" in result.stderr
    truth = datasets.read(folder).truth
    assert truth is not None
    errors = [
        absolute_pose_error(read_tum(tmp_path / name / "trajectory.tum", parent="map", child="base"), truth)
        for name in ("folder", "bag")
    ]
    assert errors[1].translation_m.rmse < max(1.5 * errors[0].translation_m.rmse, 0.02)
    metrics = json.loads((tmp_path / "bag" / "metrics.json").read_text())
    assert metrics["stages"]["optimised"]["ape"]["translation_m"]["rmse"] == pytest.approx(
        errors[1].translation_m.rmse, rel=1e-6
    )


def test_topics_are_chosen_recorded_and_kept_when_a_run_starts_over(robot: tuple[Path, Path], tmp_path: Path) -> None:
    _, bag = robot
    quick = ("--set", "maps=false", "--no-loops")
    chosen = ("--topic", "scan=/rear/scan", "--topic", "truth=none")
    assert psg("optimize", bag, "--out", tmp_path / "run", *quick, *chosen).exit_code == 0
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["input"]["topics"] == {"scan": "/rear/scan", "truth": "none"}
    again = psg("optimize", tmp_path / "run", "--from", "graph", "--out", tmp_path / "again", "--json")
    assert json.loads(again.stdout)["run"]["input"]["topics"] == record["input"]["topics"]
    np.testing.assert_array_equal(
        *((read_tum(tmp_path / name / "odometry.tum", parent="odom", child="base").poses) for name in ("run", "again"))
    )


def test_inspect_prints_the_topics(robot: tuple[Path, Path]) -> None:
    _, bag = robot
    result = psg("inspect", bag, "--topic", "scan=/rear/scan")
    assert result.exit_code == 0
    assert "topics: scan /rear/scan (LaserScan" in result.stdout
    assert "also there: /front/scan" in result.stdout
    wrong = psg("inspect", bag, "--topic", "scan=/rear/scans")
    assert wrong.exit_code == 2
    assert "did you mean '/rear/scan'?" in wrong.stderr
    assert wrong.stderr.count("\n") == 1
