"""`psg report` on runs of every command that leaves a run directory, and what it refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from posegraph_slam.cli.application import app
from posegraph_slam.datasets.simulation import simulate, tiny_settings


def psg(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tiny_settings(duration_s=6.0), tmp_path_factory.mktemp("report") / "log")


@pytest.fixture(scope="module")
def run(log: Path) -> Path:
    out = log.parent / "run"
    assert psg("optimize", log, "--out", out, "--no-report", "-q").exit_code == 0
    assert not (out / "report.html").exists()
    return out


def test_report_is_written_into_the_run_or_elsewhere(run: Path, tmp_path: Path) -> None:
    result = psg("report", run)
    assert result.exit_code == 0
    assert result.stdout == f"report:   {run / 'report.html'}\n"
    assert psg("report", run, "--out", tmp_path / "there.html", "-q").stdout == ""
    assert (tmp_path / "there.html").read_bytes() == (run / "report.html").read_bytes()
    value = json.loads(psg("report", run, "--json").stdout)
    assert value["bytes"] == (run / "report.html").stat().st_size
    assert isinstance(value["warnings"], list)


def test_runs_of_other_commands_show_what_they_have(log: Path, run: Path, tmp_path: Path) -> None:
    quick = ["--set", "particle_slam.particles=3", "-q"]
    assert psg("pf-slam", log, "--out", tmp_path / "filtered", *quick).exit_code == 0
    localized = ["--out", tmp_path / "localized", "--start", "0,0,0", "-q"]
    assert psg("localize", run / "maps" / "map.yaml", log, *localized).exit_code == 0
    for name, words in (("filtered", "particle filter"), ("localized", "estimate")):
        assert psg("report", tmp_path / name).exit_code == 0
        assert words in (tmp_path / name / "report.html").read_text(encoding="utf-8")


def test_wrong_runs_are_named(run: Path, tmp_path: Path) -> None:
    def error(*arguments: str | Path) -> str:
        result = psg("report", *arguments)
        assert result.exit_code == 2
        assert result.stderr.count("\n") == 1
        return result.stderr

    assert "is not a run directory" in error(tmp_path)
    assert "is a folder; give the file" in error(run, "--out", tmp_path)
    broken = tmp_path / "broken"
    shutil.copytree(run, broken)
    (broken / "graph.g2o").write_text("VERTEX_SE2 0 0 0\n")
    assert "graph.g2o" in error(broken)
    (broken / "metrics.json").write_text("{")
    assert "metrics.json" in error(broken)
