"""Every command but `optimize` through its own command line: output, exit codes, and one clear line for an error."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from posegraph_slam import __version__
from posegraph_slam.cli.application import app, one_line
from posegraph_slam.cli.console import print_table
from posegraph_slam.pipeline.configuration import Configuration, find_configuration
from posegraph_slam.pipeline.settings_files import Layer, build_settings

FIXED = ["--set", "drive.duration_s=3", "--set", "lidar.beams=181", "--set", "lidar.rate_hz=4"]
SMALL = [*FIXED, "--set", "kinect.images=false"]


def psg(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def fails(*arguments: str | Path) -> str:
    """Run a command that must fail by the user's fault; return its one line on stderr."""
    result = psg(*arguments)
    assert result.exit_code == 2, result.output
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("error: ")
    assert "Traceback" not in result.output
    return lines[0]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "log"
    result = psg("simulate", "--out", folder, "--seed", "5", *SMALL)
    assert result.exit_code == 0, result.output
    assert str(folder) in result.stdout
    return folder


def test_help_and_version() -> None:
    for command in ([], ["optimize"], ["inspect"], ["simulate"], ["datasets"], ["config"], ["config", "show"]):
        result = psg(*command, "--help")
        assert result.exit_code == 0
        assert result.stdout.startswith("Usage: ")
    assert psg("--version").stdout == f"psg {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["optimise"], "optimize"),
        (["inspect", "--jsn", "x"], "--json"),
        (["inspect"], "LOG"),
        (["simulate", "--seed", "many"], "--seed"),
        (["config", "sho"], "show"),
    ],
)
def test_wrong_usage_names_what_was_meant(arguments: list[str], hint: str) -> None:
    result = psg(*arguments)
    assert result.exit_code == 2
    assert hint in result.stderr


def test_datasets_lists_the_readers() -> None:
    text = psg("datasets").stdout
    readers = json.loads(psg("datasets", "--json").stdout)
    assert {"ece276a", "carmen"} <= {reader["name"] for reader in readers}
    for reader in readers:
        assert reader["name"] in text
        assert reader["layout"] in text


def test_simulate_is_deterministic_and_careful(log: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    assert psg("simulate", "--out", again, "--seed", "5", "--quiet", *SMALL).stdout == ""
    for file in sorted(log.iterdir()):
        assert (again / file.name).read_bytes() == file.read_bytes(), file.name
    assert "overwrite" in fails("simulate", "--out", again, "--seed", "6", *SMALL)
    assert psg("simulate", "--out", again, "--seed", "6", "--overwrite", *SMALL).exit_code == 0
    assert any((again / file.name).read_bytes() != file.read_bytes() for file in log.iterdir())


def test_a_world_of_ramps_is_optimised_in_space(tmp_path: Path) -> None:
    small = ("--set", "lidar.beams=271", "--set", "lidar.rate_hz=5", "--set", "drive.duration_s=25")
    log, run = tmp_path / "hills", tmp_path / "run"
    assert psg("simulate", "--world", "ramps", "--out", log, "--seed", "3", *small, "--quiet").exit_code == 0
    world = json.loads((log / "world.json").read_text())
    assert len(world["ground_xa_xb_ya_yb_z_rise"]) > 5
    result = psg("optimize", log, "--set", "pose_graph.group=se3", "--out", run, "--quiet")
    assert result.exit_code == 0, result.output
    rows, true = (np.loadtxt(file) for file in (run / "trajectory.tum", log / "truth1.tum"))
    assert np.ptp(true[:, 3]) > 0.2
    assert np.abs((rows[:, 3] - rows[0, 3]) - (true[:, 3] - true[0, 3])).max() < 0.1
    assert "VERTEX_SE3:QUAT" in (run / "graph.g2o").read_text()
    assert (run / "figures" / "heights.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    again = psg("optimize", run, "--from", "graph", "--out", tmp_path / "again", "--quiet")
    assert again.exit_code == 0, again.output
    np.testing.assert_allclose(np.loadtxt(tmp_path / "again" / "trajectory.tum"), rows, atol=1e-6)
    assert "images are not rendered" in fails("simulate", "--set", "world.kind=ramps", "--out", tmp_path / "x")


def test_simulate_names_wrong_settings(tmp_path: Path) -> None:
    line = fails("simulate", "--out", tmp_path / "log", "--set", "drive.lapse=3")
    assert "unknown key 'drive.lapse'; did you mean 'drive.laps'?" in line
    assert "number > 0 and <= 1000" in fails("simulate", "--out", tmp_path / "log", "--set", "drive.laps=0")
    assert "psg simulate --show-settings" in fails("simulate", "--set", "qqqqqq=0")
    assert not (tmp_path / "log").exists()
    shown = tomllib.loads(psg("simulate", "--show-settings", "--seed", "9", *SMALL).stdout)
    assert (shown["seed"], shown["lidar"]["beams"]) == (9, 181)


def test_inspect_shows_streams_and_the_plan(log: Path) -> None:
    result = psg("inspect", log)
    assert result.exit_code == 0
    for word in (
        "scans",
        "encoders",
        "imu",
        "181 beams over 270.0 deg",
        "psg optimize would",
        "wheel encoders and gyro",
    ):
        assert word in result.stdout
    assert "warning: the imu stream" in result.stderr


def test_inspect_as_json(log: Path) -> None:
    result = psg("inspect", log, "--json", "--set", "mapping.resolution_m=0.2")
    value = json.loads(result.stdout)
    assert value["format"] == "ece276a"
    assert {stream["name"] for stream in value["streams"]} >= {"scans", "encoders", "imu"}
    assert any("cells of 0.2 m" in step for step in value["plan"])


def test_inspect_names_what_cannot_be_read(tmp_path: Path, log: Path) -> None:
    assert "no such file" in fails("inspect", tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    assert "empty" in fails("inspect", tmp_path / "empty")
    assert "did you mean 'carmen'?" in fails("inspect", log, "--format", "carmn")
    assert "'mapping.resolution_m' = -1" in fails("inspect", log, "--set", "mapping.resolution_m=-1")
    assert "neither a file nor a preset" in fails("inspect", log, "--config", "cours_report")


def test_config_show_reads_back_and_merges(tmp_path: Path) -> None:
    assert psg("config", "show").stdout == find_configuration("default").read_text(encoding="utf-8")
    mine = tmp_path / "mine.toml"
    mine.write_text("seed = 3\n[mapping]\nresolution_m = 0.1\n")
    shown = psg("config", "show", mine, "--set", "seed=4").stdout
    configuration = build_settings(Configuration, [Layer(source="shown", values=tomllib.loads(shown))])
    assert (configuration.seed, configuration.mapping.resolution_m) == (4, 0.1)
    assert json.loads(psg("config", "show", mine, "--json").stdout) == json.loads(
        Configuration.model_validate({"seed": 3, "mapping": {"resolution_m": 0.1}}).model_dump_json()
    )
    mine.write_text("[mapping]\nresolution = 0.1\n")
    line = fails("config", "show", mine)
    assert "mine.toml: unknown key 'mapping.resolution'; did you mean 'mapping.resolution_m'?" in line


def test_config_list_names_the_presets() -> None:
    text = psg("config", "list").stdout
    assert "default" in text
    assert "course_report" in text


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    result = psg("--debug", "inspect", tmp_path / "absent")
    assert result.exit_code == 2
    assert "Traceback" in result.stderr
    assert result.stderr.strip().splitlines()[-1].startswith("error: ")


def test_interrupt_ends_with_130(monkeypatch: pytest.MonkeyPatch, log: Path) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("posegraph_slam.datasets.read", interrupted)
    result = psg("inspect", log)
    assert result.exit_code == 130
    assert "interrupted" in result.stderr
    assert "Traceback" not in result.output


def test_a_bug_is_not_dressed_up(monkeypatch: pytest.MonkeyPatch, log: Path) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("posegraph_slam.datasets.read", broken)
    assert isinstance(psg("inspect", log).exception, ZeroDivisionError)


def test_system_errors_name_the_file() -> None:
    assert one_line(PermissionError(13, "Permission denied", "/root/x")) == "/root/x: Permission denied"
    assert one_line(OSError("two\nlines")) == "two lines"
    assert one_line(OSError()) == "OSError"
    long = one_line(OSError("a.tum: " + "9" * 100_000 + "; correct it"))
    assert long.startswith("a.tum: 9")
    assert long.endswith("9; correct it")
    assert len(long) < 4000
    assert one_line(MemoryError("Unable to allocate 9 GiB")).startswith("memory: not enough for this input (Unable to")


def test_tables_align_columns(capsys: pytest.CaptureFixture[str]) -> None:
    print_table([["", "a", "long name"], ["x [m]", "1.25", "–"]], title="T")
    assert capsys.readouterr().out == "T\n          a  long name\nx [m]  1.25          –\n"


def test_process_imports_nothing_heavy_for_help_and_exits_with_2(tmp_path: Path) -> None:
    code = (
        "import sys; sys.argv = ['psg', '--help']\n"
        "from posegraph_slam.cli import main\n"
        "try: main()\n"
        "finally: print(sorted({'numpy', 'gtsam', 'numba', 'matplotlib', 'cv2'} & set(sys.modules)))"
    )
    environment = {**os.environ, "NO_COLOR": "1"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert run.stdout.splitlines()[-1] == "[]", run.stderr
    absent = str(tmp_path / "absent")
    words = ["psg", "attitude", absent, "--out", "x.tum"]
    code = f"import sys; sys.argv = {words!r}\nfrom posegraph_slam.cli import main\nmain()"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert run.returncode == 2
    assert run.stderr == f"error: {absent}: no such file or folder; check the path\n"
