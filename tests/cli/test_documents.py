"""The documents say what is true: keys that exist, examples that run, figures that were measured."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.settings_files import walk_fields, walk_sections
from posegraph_slam.sensors import RobotLog

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def test_every_key_that_the_tuning_page_names_exists() -> None:
    known = {name for name, _, _ in walk_fields(Configuration)} | {name for name, _ in walk_sections(Configuration)}
    text = (DOCS / "tuning.md").read_text(encoding="utf-8")
    named = set(re.findall(r"[`\s]([a-z_]+(?:\.[a-z_]+)+)(?:=|`)", text)) - {"loops.csv", "metrics.json"}
    named -= {name for name in named if name.endswith((".csv", ".json", ".png", ".md", ".g2o"))}
    assert len(named) > 30
    assert named <= known, sorted(named - known)


def test_the_example_reader_reads(tmp_path: Path) -> None:
    (code,) = python_blocks(DOCS / "formats" / "adding_a_reader.md")
    scope: dict[str, object] = {}
    exec(compile(code, "adding_a_reader.md", "exec"), scope)
    reader = scope["READER"]
    path = tmp_path / "drive.mylog"
    np.savetxt(path, np.column_stack([np.arange(3), np.full((3, 181), 2.5)]))
    assert reader.detects(path)  # type: ignore[attr-defined]
    log = reader.read(path)  # type: ignore[attr-defined]
    assert isinstance(log, RobotLog)
    assert log.scans is not None
    assert log.scans.ranges_m.shape == (3, 181)


def test_the_example_matcher_matches_and_follows_a_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    simulate(tiny_settings(duration_s=5.0), tmp_path / "demo" / "log")
    monkeypatch.chdir(tmp_path)
    matcher, trial = python_blocks(DOCS / "extending.md")
    scope: dict[str, object] = {}
    exec(compile(matcher, "extending.md", "exec"), scope)
    exec(compile(trial, "extending.md", "exec"), scope)
    assert "rmse" in capsys.readouterr().out
    error = scope["absolute_pose_error"](scope["path"], scope["log"].truth)  # type: ignore[attr-defined,operator]
    assert error.translation_m.rmse < 0.05
    assert scope["log"].truth.path_length_m > 0.5  # type: ignore[attr-defined]
    match = scope["match_to_gaussians"]
    nothing = match(np.zeros((3, 2)), np.ones((4, 2)), np.eye(3))  # type: ignore[operator]
    assert not nothing.usable
    corridor = np.column_stack([np.linspace(0, 10, 400), np.tile([0.0, 2.0], 200)])
    found = match(corridor + np.array([0.0, 0.1]), corridor, np.eye(3))  # type: ignore[operator]
    assert found.usable
    np.testing.assert_allclose(found.T_target_source[1, 2], -0.1, atol=0.01)
    assert np.abs(found.degenerate_directions[0, 0]) > 0.99


@pytest.fixture
def readme_table(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    spec = importlib.util.spec_from_file_location("readme_table", ROOT / "benchmarks" / "readme_table.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "readme_table", module)
    spec.loader.exec_module(module)
    return module


def test_the_readme_shows_what_was_measured(readme_table: ModuleType) -> None:
    rows = json.loads((ROOT / "benchmarks" / "results" / "slam2d.json").read_text(encoding="utf-8"))["rows"]
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = text.partition(readme_table.BEGIN)[2].partition(readme_table.END)[0].strip()
    assert shown == readme_table.readme_table(rows), "python benchmarks/readme_table.py writes it anew"


def test_every_reader_has_a_page_and_the_citation_the_version() -> None:
    import posegraph_slam
    from posegraph_slam.datasets.registry import BUILT_IN

    pages = " ".join(path.read_text(encoding="utf-8") for path in (DOCS / "formats").glob("*.md"))
    assert all(f"`{reader.name}`" in pages or f"{reader.name}.md" in pages for reader in BUILT_IN)
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"version: {posegraph_slam.__version__}" in citation
    assert "cff-version: 1.2.0" in citation


def test_every_page_is_listed() -> None:
    listing = (DOCS / "README.md").read_text(encoding="utf-8")
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")} - {"README.md"}
    assert not {page for page in pages if f"]({page}" not in listing}
