"""The front door for programs: what it exports, the examples of the documents, and the same files as the command."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import posegraph_slam as psg
from posegraph_slam.cli.application import app
from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.pipeline.run_directory import read_run_directory

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("README.md", "docs/python.md")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tiny_settings(duration_s=12.0), tmp_path_factory.mktemp("api") / "log")


@pytest.fixture(scope="module")
def run(log: Path) -> psg.Run:
    return psg.optimize(psg.read(log), {"mapping.resolution_m": 0.1}, workers=1)


def examples() -> list[tuple[str, str]]:
    """Every Python block of the pages, with the page and its number."""
    found = []
    for page in PAGES:
        blocks = re.findall(
            r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
        )
        assert blocks, page
        found += [(f"{page} {number}", block) for number, block in enumerate(blocks, 1)]
    return found


@pytest.mark.parametrize("code", [code for _, code in examples()], ids=[name for name, _ in examples()])
def test_examples_of_the_documents_run(
    code: str, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "log").symlink_to(log, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    scope: dict[str, object] = {}
    exec(compile(code, "example", "exec"), scope)
    if "run.save" in code:
        assert read_run_directory(tmp_path / "demo" / "run").metrics["scans"] == len(scope["run"].trajectory)  # type: ignore[attr-defined]
        assert capsys.readouterr().out.strip()


def test_names_are_imported_on_use_alone() -> None:
    code = (
        "import sys, posegraph_slam as psg\n"
        "heavy = {'numpy', 'scipy', 'gtsam', 'matplotlib', 'numba', 'pydantic', 'cv2'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "assert 'optimize' in dir(psg) and psg.InputError.__name__ == 'InputError'\n"
        "assert 'numpy' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_every_public_name_exists() -> None:
    for name in psg.__all__:
        assert getattr(psg, name) is not None
    with pytest.raises(AttributeError, match="optimise"):
        psg.optimise  # noqa: B018


def test_the_run_tells_of_trajectory_map_and_stages(run: psg.Run) -> None:
    assert isinstance(run.trajectory, psg.Trajectory)
    assert run.log.scans is not None
    assert len(run.trajectory) == len(run.log.scans)
    assert run.trajectory.parent == "map"
    assert isinstance(run.map, psg.OccupancyGrid)
    assert run.map.geometry.resolution_m == 0.1
    assert list(run.stages) == ["odometry", "scan matching", "optimised"]
    assert "APE position RMSE" in {row.name for row in run.table.rows}
    assert len(run.graph) == run.metrics["keyframes"]


def test_saving_leaves_what_the_command_leaves(run: psg.Run, log: Path, tmp_path: Path) -> None:
    folder = run.save(tmp_path / "run")
    arguments = [
        "optimize",
        str(log),
        "--set",
        "mapping.resolution_m=0.1",
        "--workers",
        "1",
        "--out",
        f"{tmp_path}/cli",
    ]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    mine, theirs = (
        {path.relative_to(top).as_posix(): path.read_bytes() for path in top.rglob("*") if path.is_file()}
        for top in (folder, tmp_path / "cli")
    )
    assert mine.keys() == theirs.keys()
    assert {name for name in mine if mine[name] != theirs[name]} <= {"run.json", "report.html"}
    with pytest.raises(psg.InputError, match="already holds a run"):
        run.save(folder)
    run.save(folder, overwrite=True, figures=False)
    assert not (folder / "figures").exists()


def test_a_run_of_a_log_in_memory_can_be_saved(run: psg.Run, tmp_path: Path) -> None:
    import dataclasses

    loose = dataclasses.replace(run, log=dataclasses.replace(run.log, path=Path("nowhere")))
    record = read_run_directory(loose.save(tmp_path / "run", figures=False)).record
    assert record["input"] == {"format": "ece276a", "path": "nowhere", "files": 0, "bytes": 0, "sha256": None}


def test_configuration_comes_in_every_form(log: Path, tmp_path: Path) -> None:
    from posegraph_slam.api import resolve_configuration

    assert resolve_configuration(None) == psg.Configuration()
    assert resolve_configuration({"mapping": {"resolution_m": 0.2}}).mapping.resolution_m == 0.2
    assert resolve_configuration("course_report") != psg.Configuration()
    file = tmp_path / "mine.toml"
    file.write_text("seed = 3\n")
    assert resolve_configuration(file, workers=2).seed == 3
    whole = psg.Configuration(seed=4)
    assert resolve_configuration(whole) is whole
    assert resolve_configuration(whole, seed=5, workers=2) == psg.Configuration(seed=5, workers=2)
    with pytest.raises(psg.ConfigurationError, match=r"did you mean 'mapping\.resolution_m'"):
        psg.optimize(log, {"mapping.resolution": 0.1})


def test_truth_can_be_a_file_or_a_trajectory(log: Path) -> None:
    known = read_tum(next(log.glob("truth*.tum")), parent="ref", child="base")
    shifted = known.with_poses(known.poses @ np.diag([1.0, 1, 1, 1]))
    fast = {"scan_matching.matcher": "none", "loop_closure.enabled": False, "maps": False}
    first = psg.optimize(log, fast, truth=shifted)
    second = psg.optimize(log, fast, truth=next(log.glob("truth*.tum")))
    assert first.map is None
    assert first.metrics["stages"]["odometry"]["ape"] == second.metrics["stages"]["odometry"]["ape"]


def test_simulate_writes_a_log(tmp_path: Path) -> None:
    settings = {"drive.duration_s": 3, "lidar": {"beams": 181, "rate_hz": 4}, "kinect.images": False}
    assert psg.read(psg.simulate(tmp_path / "log", settings)).format == "ece276a"
    with pytest.raises(psg.ConfigurationError, match="show-settings"):
        psg.simulate(tmp_path / "other", {"wheels": 3})
