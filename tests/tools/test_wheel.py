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


def psg(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    code = "from posegraph_slam.cli import main; main()"
    environment = {**os.environ, "PYTHONPATH": str(site)}
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=site, env=environment, capture_output=True, text=True, timeout=60
    )


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
    listed = psg(unpacked, "config", "list")
    assert listed.returncode == 0, listed.stderr
    assert {line.split()[0] for line in listed.stdout.splitlines()} == {
        path.stem for path in (ROOT / "configs").glob("*.toml")
    }
    shown = psg(unpacked, "config", "show", "course_report")
    assert shown.returncode == 0, shown.stderr
    assert "[loop_closure" in shown.stdout
    assert psg(unpacked, "simulate", "--show-settings").stdout.startswith("#")
