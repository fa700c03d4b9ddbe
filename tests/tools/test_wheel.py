"""The wheel holds presets, types and the files of reports, nothing of the tests, and its commands find them."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel and unpack it; without a package index the build backend cannot be had."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet", "--no-deps"]
    built = subprocess.run([*command, "--wheel-dir", folder, ROOT], capture_output=True, text=True)
    if built.returncode and "hatchling" in built.stderr and "No matching distribution" in built.stderr:
        pytest.skip("the build backend cannot be downloaded")
    assert built.returncode == 0, built.stderr
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


@pytest.mark.slow
def test_the_wheel_is_complete(unpacked: Path) -> None:
    package = unpacked / "posegraph_slam"
    source = ROOT / "posegraph_slam"
    expected = {
        path.relative_to(source).as_posix()
        for path in source.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix not in (".nbi", ".nbc")
    }
    present = {path.relative_to(package).as_posix() for path in package.rglob("*") if path.is_file()}
    assert expected <= present
    presets = {f"presets/{path.name}" for path in (ROOT / "configs").glob("*.toml")}
    assert present - expected == presets
    assert "py.typed" in present
    assert {path.name.split("-")[0] for path in unpacked.iterdir()} == {"posegraph_slam"}
    (metadata,) = unpacked.glob("*.dist-info/METADATA")
    text = metadata.read_text(encoding="utf-8")
    assert "Requires-Dist: rosbags" in text
    assert "License-Expression: Apache-2.0" in text


@pytest.mark.slow
def test_its_commands_find_the_presets_outside_the_repository(unpacked: Path) -> None:
    code = (
        "from typer.testing import CliRunner; from posegraph_slam.cli.application import app\n"
        "for words in ('config list', 'config show course_report', 'datasets'):\n"
        "    result = CliRunner().invoke(app, words.split())\n"
        "    assert result.exit_code == 0, result.output\n"
        "    print(result.stdout)\n"
        "import posegraph_slam; print('from', posegraph_slam.__file__)\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=unpacked, env={**os.environ, "PYTHONPATH": str(unpacked)},
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    assert f"from {unpacked}" in found.stdout
    assert {path.stem for path in (ROOT / "configs").glob("*.toml")} <= set(found.stdout.split())
    assert "[loop_closure" in found.stdout
