"""RGB-D folders on the command line and from Python: results, notes, and errors in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

import posegraph_slam
from posegraph_slam.cli.application import app
from posegraph_slam.datasets.simulation.rgbd_room import (
    furnished_room,
    loop_through_room,
    small_camera,
    write_rgbd_log,
)


def psg(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rgbd") / "room"
    write_rgbd_log(folder, furnished_room(seed=3), small_camera(160, 120), loop_through_room(160)[:8])
    (folder / "camera.json").rename(folder.parent / "camera.json")
    return folder


def test_optimize_takes_intrinsics_from_a_file(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    result = psg("optimize", log, "--camera", log.parent / "camera.json", "--out", out)
    assert result.exit_code == 0
    assert "position from the first frame max" in result.stdout
    assert "intrinsics of the configuration: fx 131.2" in result.stderr
    assert "are assumed" in result.stderr, "the stamps still are"
    assert "no intrinsics" not in result.stderr
    assert (out / "maps/cloud.ply").is_file()
    assert (out / "report.html").is_file()
    rows = {row["metric"]: row["values"] for row in json.loads((out / "metrics.json").read_text())["table"]["rows"]}
    assert rows["APE position RMSE"]["optimised"] < 0.01


def test_inspect_tells_what_would_be_done(log: Path) -> None:
    result = psg("inspect", log)
    assert result.exit_code == 0
    assert "no intrinsics" in result.stdout
    assert "align 8 pairs of colour and depth images (160 x 120)" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("--camera", "absent.json"), "absent.json"),
        (("--set", "rgbd.camera.fx_px=-1"), "rgbd.camera.fx_px"),
        (("--set", "rgbd.cloud.max_depth_m=0.1"), "no voxel holds enough points"),
    ],
)
def test_errors_are_one_line(log: Path, tmp_path: Path, arguments: tuple[str, ...], problem: str) -> None:
    result = psg("optimize", log, "--out", tmp_path / "run", *arguments)
    assert result.exit_code == 2
    errors = [line for line in result.stderr.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert problem in errors[0]
    assert not (tmp_path / "run").exists()


def test_a_run_cannot_be_taken_up_at_the_graph(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert psg("optimize", log, "--out", out, "--set", "maps=false").exit_code == 0
    result = psg("optimize", out, "--from", "graph", "--out", tmp_path / "again")
    assert result.exit_code == 2
    assert "error:" in result.stderr
    again = psg("optimize", out, "--from", "matching", "--out", tmp_path / "again")
    assert again.exit_code == 0
    assert (out / "trajectory.tum").read_bytes() == (tmp_path / "again/trajectory.tum").read_bytes()


def test_python_gives_the_cloud(log: Path) -> None:
    run = posegraph_slam.optimize(log, {"rgbd.camera.file": str(log.parent / "camera.json")}, workers=1)
    assert run.cloud is not None
    assert run.cloud.points.shape == run.cloud.colours.shape
    assert run.map is None
    assert run.texture is None
    assert len(run.trajectory) == 8
