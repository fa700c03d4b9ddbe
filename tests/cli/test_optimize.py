"""`psg optimize` on a small simulated log: the run directory, the comparison, refusals, and the same bytes again."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from posegraph_slam.cli.application import app
from posegraph_slam.cli.optimisation import default_out
from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.pipeline.run_directory import read_run_directory

FILES = {
    "run.json",
    "report.html",
    "config.toml",
    "metrics.json",
    "odometry.tum",
    "scan_matching.npz",
    "scan_matching.tum",
    "trajectory.tum",
    "graph.g2o",
    "loops.csv",
    "maps/map.pgm",
    "maps/map.yaml",
    "maps/map.png",
    "maps/map.npz",
    "maps/texture.png",
    "figures/trajectories.png",
    "figures/map.png",
    "figures/texture.png",
}


def psg(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


def fails(*arguments: str | Path) -> str:
    result = psg(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tiny_settings(duration_s=16.0, images=True), tmp_path_factory.mktemp("optimize") / "log")


@pytest.fixture(scope="module")
def run(log: Path) -> Path:
    out = log.parent / "run"
    result = psg("optimize", log, "--out", out, "--workers", "1", "--verbose")
    assert result.exit_code == 0, result.output
    for word in ("odometry", "scan matching", "optimised", "APE position RMSE [m]", "start-end gap [m]", "peak memory"):
        assert word in result.stdout
    assert f"picture:  {out / 'figures' / 'map.png'}" in result.stdout
    assert f"report:   {out / 'report.html'}" in result.stdout
    return out


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_run_directory_is_complete(run: Path, log: Path) -> None:
    assert files(run) - {"figures/map_rejected.png"} == FILES
    stored = read_run_directory(run)
    assert stored.record["input"]["format"] == "ece276a"
    assert stored.record["input"]["path"] == str(log)
    assert {"reading", "odometry", "scan matching", "loop closure", "maps", "figures"} <= set(stored.record["stages_s"])
    assert stored.configuration.workers == 1
    assert {path.name for path in run.parent.iterdir()} >= {"run", "log"}
    assert not [path for path in run.parent.iterdir() if path.name.startswith(".")]


def test_trajectory_has_a_pose_for_every_scan_and_beats_odometry(run: Path, log: Path) -> None:
    stamps = np.load(next(log.glob("Hokuyo*.npz")), allow_pickle=False)["time_stamps"]
    for name in ("odometry", "scan_matching", "trajectory"):
        trajectory = read_tum(run / f"{name}.tum", parent="map", child="base")
        np.testing.assert_allclose(trajectory.stamps_s, np.sort(stamps), atol=1e-6)
    metrics = read_run_directory(run).metrics
    rows = {row["metric"]: row["values"] for row in metrics["table"]["rows"]}
    error = rows["APE position RMSE"]
    assert error["optimised"] < 0.03
    assert error["optimised"] <= error["odometry"]
    assert metrics["scans"] == len(stamps)


def test_pictures_have_content(run: Path) -> None:
    for name in ("trajectories", "map", "texture"):
        picture = matplotlib.image.imread(run / "figures" / f"{name}.png")
        assert min(picture.shape[:2]) > 500
        assert picture[..., :3].std() > 0.01


def test_loops_table_reads_back(run: Path) -> None:
    with (run / "loops.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    accepted = [row for row in rows if row["accepted"] == "true"]
    metrics = read_run_directory(run).metrics
    assert (len(rows), len(accepted)) == (metrics["loops_proposed"], metrics["loops_accepted"])


def test_same_bytes_again_with_other_workers_and_from_its_own_configuration(run: Path, log: Path) -> None:
    again = run.parent / "again"
    result = psg("optimize", log, "--out", again, "--config", run / "config.toml", "--workers", "2", "--quiet")
    assert result.exit_code == 0, result.output
    assert result.stdout == ""
    assert files(again) == files(run)
    for name in sorted(files(run) - {"run.json", "config.toml", "report.html"}):
        assert (again / name).read_bytes() == (run / name).read_bytes(), name
    hashes = [read_run_directory(folder).record["configuration_sha256"] for folder in (run, again)]
    assert hashes[0] == hashes[1]


def test_existing_run_is_refused_then_replaced(run: Path, log: Path) -> None:
    assert "already holds a run; add --overwrite" in fails("optimize", log, "--out", run)
    out = run.parent / "replaced"
    shutil.copytree(run, out)
    (out / "stale.txt").write_text("left over")
    result = psg("optimize", log, "--out", out, "--overwrite", "--json", "--set", "mapping.resolution_m=0.1",
                 "--stages", "odometry")  # fmt: skip
    value = json.loads(result.stdout)
    assert value["folder"] == str(out)
    assert value["metrics"]["scans"] > 0
    assert read_run_directory(out).configuration.mapping.resolution_m == 0.1
    assert not (out / "stale.txt").exists()


def test_another_truth_is_compared_with(run: Path, log: Path, tmp_path: Path) -> None:
    truth = run / "odometry.tum"
    quick = ("--stages", "odometry", "--set", "seed=1")
    result = psg("optimize", log, "--out", tmp_path / "run", "--truth", truth, "--json", *quick)
    rows = json.loads(result.stdout)["metrics"]["stages"]
    assert rows["odometry"]["ape"]["translation_m"]["rmse"] < 1e-5
    assert "absent.tum" in fails("optimize", log, "--out", tmp_path / "other", "--truth", tmp_path / "absent.tum")
    assert {path.name for path in tmp_path.iterdir()} == {"run"}


def test_logs_that_cannot_be_used_leave_nothing(log: Path, tmp_path: Path) -> None:
    blind = tmp_path / "blind"
    shutil.copytree(log, blind, ignore=shutil.ignore_patterns("Hokuyo*", "dataRGBD"))
    out = tmp_path / "run"
    assert "Hokuyo" in fails("optimize", blind, "--out", out) or "laser" in fails("optimize", blind, "--out", out)
    cut = tmp_path / "cut"
    shutil.copytree(log, cut, ignore=shutil.ignore_patterns("dataRGBD"))
    scans = next(cut.glob("Hokuyo*.npz"))
    scans.write_bytes(scans.read_bytes()[:5000])
    assert scans.name in fails("optimize", cut, "--out", out)
    assert "unknown key 'loop_closure.enabld'" in fails("optimize", log, "--out", out, "--set", "loop_closure.enabld=1")
    assert {path.name for path in tmp_path.iterdir()} == {"blind", "cut"}


@pytest.mark.parametrize(
    ("log_name", "name"),
    [("ece276a/20", "20"), ("intel.clf", "intel"), ("intel.clf.gz", "intel"), ("a.b.log", "a.b")],
)
def test_default_folder_is_named_after_the_log(log_name: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / log_name
    if path.suffix:
        path.touch()
    else:
        path.mkdir(parents=True)
    assert default_out(path) == Path("runs") / name


def test_stages_and_reruns_from_the_command_line(run: Path, tmp_path: Path) -> None:
    again = CliRunner().invoke(app, ["optimize", str(run), "--from", "graph", "--out", str(tmp_path / "again"), "-q"])
    assert again.exit_code == 0
    assert (tmp_path / "again/trajectory.tum").read_bytes() == (run / "trajectory.tum").read_bytes()
    short = ["optimize", str(run), "--no-report", "--from", "graph", "--no-loops", "--stages", "odometry,matching"]
    assert CliRunner().invoke(app, [*short, "--out", str(tmp_path / "short"), "-q"]).exit_code == 0
    assert not (tmp_path / "short/maps").exists()
    assert not (tmp_path / "short/report.html").exists()
    wrong = CliRunner().invoke(app, ["optimize", str(run), "--from", "maps"])
    assert wrong.exit_code == 2
    assert "it is matching or graph" in wrong.stderr
    wrong = CliRunner().invoke(app, ["optimize", str(run), "--stages", "loops"])
    assert wrong.exit_code == 2
    assert "'loops' is not a stage" in wrong.stderr
