"""What every command has in common: -q, -v, --json, completion, and the nearest name for a wrong one."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner, Result

from posegraph_slam import optimize
from posegraph_slam.cli.application import app
from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.errors import did_you_mean

WITHOUT_TABLE = {"simulate", "edit"}
"""Commands that write files or serve pages, and print no table."""


def psg(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


def commands(group: Any, prefix: str = "") -> Iterator[tuple[str, set[str]]]:
    """Names of all commands, those inside groups too, with their options."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{prefix}{name} ")
        else:
            yield f"{prefix}{name}", {option for parameter in command.params for option in parameter.opts}


OPTIONS = dict(commands(typer.main.get_command(app)))


@pytest.mark.parametrize("name", OPTIONS)
def test_every_command_can_be_quiet_or_verbose_and_tables_are_json_too(name: str) -> None:
    options = OPTIONS[name]
    assert {"-q", "--quiet", "-v", "--verbose"} <= options
    assert name in WITHOUT_TABLE or "--json" in options


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tiny_settings(duration_s=12.0), tmp_path_factory.mktemp("common") / "log")


@pytest.fixture(scope="module")
def run(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return optimize(log).save(tmp_path_factory.mktemp("common") / "run", figures=False)


def test_quiet_prints_nothing_and_verbose_time_and_memory(log: Path) -> None:
    for arguments in (("inspect", log), ("datasets",), ("config", "list"), ("config", "show")):
        quiet = psg(*arguments, "-q")
        assert (quiet.exit_code, quiet.output) == (0, "")
        verbose = psg(*arguments, "-v")
        assert "MiB of memory" in verbose.stderr
        assert "MiB of memory" not in verbose.stdout
        assert "MiB" not in psg(*arguments).stderr


def test_presets_are_listed_as_json() -> None:
    listed = json.loads(psg("config", "list", "--json").stdout)
    assert {"default", "course_report"} <= {each["name"] for each in listed}
    assert all(Path(each["file"]).is_file() for each in listed)


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["optimise", "x"], "optimize"),
        (["optimize", "x", "--overwirte"], "--overwrite"),
        (["optimize", "LOG", "--set", "mapping.resolution=0.1"], "did you mean 'mapping.resolution_m'?"),
        (["optimize", "LOG", "--config", "defualt"], "did you mean 'default'?"),
        (["optimize", "LOG", "--stages", "odometry,grph"], "did you mean 'graph'?"),
        (["optimize", "LOG", "--from", "matchng"], "did you mean 'matching'?"),
        (["optimize", "LOG", "--format", "carmenn"], "did you mean 'carmen'?"),
        (["inspect", "LOG", "--topic", "scn=/scan"], "did you mean 'scan'?"),
        (["convert", "LOG", "x", "--to", "kiti"], "did you mean 'kitti'?"),
        (["optimize", "LOG", "--set", "odometry.source=whels"], "did you mean 'wheels'?"),
        (["solve", "GRAPH", "--init", "chordl"], "--init: 'chordl' is not allowed; did you mean 'chordal'?"),
        (["solve", "GRAPH", "--robust", "hubr"], "--robust: 'hubr' is not allowed; did you mean 'huber'?"),
        (["solve", "GRAPH", "--component", "larges"], "did you mean 'largest'?"),
        (["solve", "GRAPH", "--drop-kind", "odometri"], "did you mean 'odometry'?"),
        (["evaluate", "LOG", "LOG", "--align", "se4"], "did you mean 'se"),
    ],
)
def test_the_nearest_name_is_suggested(arguments: list[str], hint: str, log: Path, run: Path) -> None:
    meant = {"LOG": log, "GRAPH": run / "graph.g2o"}
    result = psg(*(meant.get(argument, argument) for argument in arguments))
    assert result.exit_code == 2
    assert hint in result.stderr


def test_nothing_is_suggested_where_nothing_is_near() -> None:
    assert did_you_mean("xyzzy", ["carmen", "rosbag"]) == ""


def test_completion_is_installed_and_completes(tmp_path: Path) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("needs bash")
    command = tmp_path / "psg"
    command.write_text(f"#!{sys.executable}\nfrom posegraph_slam.cli import main\nmain()\n")
    command.chmod(0o755)
    environment = {**os.environ, "HOME": str(tmp_path), "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    # the second command keeps bash from replacing itself by the program, which looks for its shell
    subprocess.run([bash, "-c", "psg --install-completion; exit $?"], env=environment, check=True, timeout=60)
    script = tmp_path / ".bash_completions" / "psg.sh"
    assert str(script) in (tmp_path / ".bashrc").read_text()
    for words, expected in (("psg opt", "optimize"), ("psg optimize --over", "--overwrite"), ("psg config sh", "show")):
        asked = {"COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1), "_PSG_COMPLETE": "complete_bash"}
        found = subprocess.run([str(command)], env={**environment, **asked}, capture_output=True, text=True, timeout=60)
        assert expected in found.stdout.split()
    assert "_PSG_COMPLETE=complete_bash" in script.read_text()


class Recorder(ModuleType):
    """Stands in for rerun: notes what is logged where, and keeps the numbers."""

    def __init__(self) -> None:
        super().__init__("rerun")
        self.logged: dict[str, list[dict[str, Any]]] = {}
        self.times: list[float] = []
        self.saved: str | None = None

    def init(self, name: str, *, spawn: bool) -> None:
        self.spawned = spawn

    def save(self, path: str) -> None:
        self.saved = path

    def set_time(self, timeline: str, *, duration: float) -> None:
        self.times.append(duration)

    def log(self, path: str, what: dict[str, Any], *, static: bool = False) -> None:
        self.logged.setdefault(path, []).append(what)

    @staticmethod
    def _record(*values: Any, **fields: Any) -> dict[str, Any]:
        return {"values": values, **fields}

    Points3D = LineStrips3D = Arrows3D = _record


def test_view_shows_map_paths_closures_and_the_robot(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rerun = Recorder()
    monkeypatch.setitem(sys.modules, "rerun", rerun)
    shown = json.loads(psg("view", run, "--save", tmp_path / "out" / "run.rrd", "--json").stdout)
    assert rerun.saved == str(tmp_path / "out" / "run.rrd")
    assert rerun.spawned is False
    assert shown["paths"] == 3
    assert len(rerun.logged["map/walls"][0]["values"][0]) == shown["walls"] > 100
    (path,) = rerun.logged["paths/optimised"][0]["values"][0]
    assert path.shape[1] == 3
    closures = [each for name in ("accepted", "rejected") for each in rerun.logged.get(f"closures/{name}", [])]
    assert sum(len(each["values"][0]) for each in closures) == shown["accepted"] + shown["rejected"] > 0
    assert len(rerun.times) == len(rerun.logged["robot"]) == shown["poses"]
    assert np.all(np.diff(rerun.times) > 0)
    assert psg("view", run).exit_code == 0
    assert rerun.spawned is True


def test_view_without_rerun_says_how_to_install_it(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    result = psg("view", run)
    assert result.exit_code == 2
    assert "pip install 'posegraph_slam[viewer]'" in result.stderr
    assert result.stderr.count("\n") == 1
