"""The two commands of the particle filters, from files to run directories."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from posegraph_slam.cli.application import app
from posegraph_slam.datasets import read
from posegraph_slam.datasets.simulation.humanoid import write_humanoid_log
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.geometry import SE2, pose_from_xyt, xyt_from_pose
from posegraph_slam.mapping.nav2 import write_nav2
from posegraph_slam.mapping.occupancy import build_occupancy
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.localize import localize_log

SAME_BYTES = ("trajectory.tum", "localization.csv", "metrics.json")


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk, and a map drawn from its true poses."""
    folder = tmp_path_factory.mktemp("walk")
    path = write_humanoid_log(folder, rng=np.random.default_rng(0), scans=160, beams=361)
    log = read(path)
    assert log.scans is not None
    assert log.truth is not None
    write_nav2(build_occupancy(log.scans, log.truth), folder)
    return path


def invoke(*arguments: str) -> str:
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="module")
def tracked(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "tracked"
    x, y, yaw = start_of(walk)
    invoke("localize", str(walk.with_name("map.yaml")), str(walk), "--out", str(out), "--start", f"{x},{y},{yaw}")
    return out


def start_of(walk: Path) -> tuple[float, float, float]:
    truth = read_tum(walk.with_name("truth.tum"), parent="ref", child="base").poses
    return float(truth[0, 0, 3]), float(truth[0, 1, 3]), float(np.arctan2(truth[0, 1, 0], truth[0, 0, 0]))


def test_localize_writes_poses_covariance_and_health(walk: Path, tracked: Path) -> None:
    truth = read_tum(walk.with_name("truth.tum"), parent="ref", child="base")
    found = read_tum(tracked / "trajectory.tum", parent="map", child="base")
    np.testing.assert_allclose(found.stamps_s, truth.stamps_s, atol=1e-6)
    error = np.linalg.norm(found.positions - truth.positions, axis=1)
    assert np.median(error) < 0.03
    with (tracked / "localization.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(found)
    np.testing.assert_allclose([float(row["stamp_s"]) for row in rows], found.stamps_s, atol=1e-6)
    assert {row["health"] for row in rows} == {"ok"}
    assert all(float(row["cov_xx"]) > 0 and float(row["cov_tt"]) > 0 for row in rows)
    metrics = json.loads((tracked / "metrics.json").read_text())
    assert metrics["health"] == {"lost": 0, "ambiguous": 0, "ok": len(rows)}
    record = json.loads((tracked / "run.json").read_text())
    assert record["map"]["path"].endswith("map.yaml")
    assert record["input"]["format"] == "humanoid"


def test_workers_and_repetition_change_no_byte(walk: Path, tracked: Path, tmp_path: Path) -> None:
    x, y, yaw = start_of(walk)
    out = tmp_path / "again"
    invoke("localize", str(walk.with_name("map.yaml")), str(walk), "--out", str(out), "--start", f"{x},{y},{yaw}",
           "--workers", "2")  # fmt: skip
    assert "workers = 2\n" in (out / "config.toml").read_text()
    for name in SAME_BYTES:
        assert (out / name).read_bytes() == (tracked / name).read_bytes(), name


def test_localize_finds_the_best_place_by_itself_and_says_that_another_fits(walk: Path, tmp_path: Path) -> None:
    """In these rooms a second place explains more than four fifths of the returns of so short a walk."""
    out = invoke("localize", str(walk.with_name("map.yaml")), str(walk), "--out", str(tmp_path / "run"), "--json")
    metrics = json.loads(out)["metrics"]
    assert metrics["health"]["ok"] == 0
    with (tmp_path / "run" / "localization.csv").open(encoding="utf-8") as file:
        last = list(csv.DictReader(file))[-1]
    assert last["health"] == "ambiguous"
    assert float(last["agreement"]) > 0.9
    truth = read_tum(walk.with_name("truth.tum"), parent="ref", child="base")
    found = read_tum(tmp_path / "run" / "trajectory.tum", parent="map", child="base")
    assert np.linalg.norm(found.positions[-1] - truth.positions[-1]) < 0.05


@pytest.mark.parametrize(("mode", "negate", "yaw"), [("trinary", 1, 0.0), ("scale", 0, 0.4), ("raw", 0, -2.0)])
def test_localize_takes_any_nav2_map(walk: Path, tmp_path: Path, mode: str, negate: int, yaw: float) -> None:
    """The same map in another mode, with a turned and shifted origin: poses turn and shift with it."""
    header = yaml.safe_load(walk.with_name("map.yaml").read_text())
    pixels = cv2.imread(str(walk.with_name(header["image"])), cv2.IMREAD_UNCHANGED)
    if mode == "raw":
        pixels = np.select([pixels == 0, pixels >= 250], [100, 0], 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "map.png"), 255 - pixels if negate else pixels)
    moved = SE2.exp(np.array([5.0, -3.0, yaw]))
    origin = xyt_from_pose(moved @ pose_from_xyt(np.array(header["origin"], dtype=float)))
    header |= {"image": "map.png", "mode": mode, "negate": negate, "origin": origin.tolist()}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(header))
    truth = read_tum(walk.with_name("truth.tum"), parent="ref", child="base").poses[:, [0, 1, 3]][:, :, [0, 1, 3]]
    x, y, heading = xyt_from_pose(moved @ truth[0])
    invoke("localize", str(tmp_path / "map.yaml"), str(walk), "--out", str(tmp_path / "run"),
           "--start", f"{x},{y},{heading}")  # fmt: skip
    found = read_tum(tmp_path / "run" / "trajectory.tum", parent="map", child="base")
    error = np.linalg.norm(found.positions[:, :2] - (moved @ truth)[:, :2, 2], axis=1)
    assert np.median(error) < 0.04
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["health"]["ok"] == len(found)


def test_pf_slam_with_a_map_for_each_particle(walk: Path, tmp_path: Path) -> None:
    out = invoke("pf-slam", str(walk), "--out", str(tmp_path / "run"), "--set", "particle_slam.maps=per_particle",
                 "--set", "particle_slam.particles=10", "--json")  # fmt: skip
    metrics = json.loads(out)["metrics"]
    rows = {row["metric"]: row["values"] for row in metrics["table"]["rows"]}
    assert rows["APE position RMSE"]["particle filter"] < 0.08
    assert metrics["map_memory_mib"] > 0


def test_maps_of_particles_and_filled_polygons_exclude_each_other(walk: Path, tmp_path: Path) -> None:
    arguments = ["pf-slam", str(walk), "--out", str(tmp_path / "run"), "--set", "particle_slam.maps=per_particle",
                 "--set", "particle_slam.free_cells=polygon"]  # fmt: skip
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "need free_cells rays" in result.output


def test_pf_slam_maps_and_compares(walk: Path, tmp_path: Path) -> None:
    runs = [tmp_path / "one", tmp_path / "two"]
    for run, workers in zip(runs, (1, 2), strict=True):
        invoke("pf-slam", str(walk), "--out", str(run), "--workers", str(workers), "--seed", "3")
        assert f"workers = {workers}\n" in (run / "config.toml").read_text()
    metrics = json.loads((runs[0] / "metrics.json").read_text())
    rows = {row["metric"]: row["values"] for row in metrics["table"]["rows"]}
    assert rows["APE position RMSE"]["particle filter"] < 0.05
    for name in ("trajectory.tum", "maps/map.pgm", "maps/map.npz", "metrics.json"):
        assert (runs[0] / name).read_bytes() == (runs[1] / name).read_bytes(), name


@pytest.mark.parametrize("command", ["pf-slam", "localize"])
def test_a_bad_number_of_workers_is_one_line(walk: Path, tmp_path: Path, command: str) -> None:
    inputs = [str(walk.with_name("map.yaml"))] if command == "localize" else []
    result = CliRunner().invoke(app, [command, *inputs, str(walk), "--out", str(tmp_path / "run"), "--workers", "-1"])
    assert result.exit_code == 2
    assert "--workers" in result.output
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("start", ["1,2", "1,2,x", "1,2,nan"])
def test_a_bad_start_is_one_line(walk: Path, tmp_path: Path, start: str) -> None:
    result = CliRunner().invoke(
        app, ["localize", str(walk.with_name("map.yaml")), str(walk), "--out", str(tmp_path / "run"), "--start", start]
    )
    assert result.exit_code == 2
    assert "is not a pose" in result.output
    assert not (tmp_path / "run").exists()


@pytest.mark.data
def test_localises_a_cut_of_intel_in_the_map_of_an_earlier_pass(psg_data: Path) -> None:
    """The robot drives its corridor twice within 2400 scans: a map of the first pass, the second localised in it."""
    from dataclasses import replace

    from posegraph_slam.pipeline.optimize import optimize

    log = read(psg_data / "carmen" / "intel.clf")
    assert log.scans is not None
    assert log.scan_odometry is not None
    cut = np.arange(2400)
    log = replace(log, scans=log.scans.select(cut), scan_odometry=log.scan_odometry.select(cut), relations=None)
    optimised = optimize(log, Configuration()).trajectory
    first, second = cut[:1600], cut[1600:]
    assert log.scans is not None
    assert log.scan_odometry is not None
    grid = build_occupancy(log.scans.select(first), optimised.select(first))
    later = replace(log, scans=log.scans.select(second), scan_odometry=log.scan_odometry.select(second))
    result, _ = localize_log(grid, later, Configuration())  # without a start
    error = np.linalg.norm(result.trajectory.positions - optimised.positions[second], axis=1)
    known = result.health == 2
    assert known.mean() > 0.9
    assert np.median(error[known]) < 0.05
    assert np.percentile(error[known], 99) < 0.2
