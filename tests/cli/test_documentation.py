"""The documentation names every command and option, and its links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer

from posegraph_slam.cli.application import app
from posegraph_slam.pipeline.configuration import available_presets

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_has_a_page_with_every_option(name: str) -> None:
    text = (ROOT / "docs" / "commands" / f"{name}.md").read_text(encoding="utf-8")
    command = COMMANDS[name]
    options = {
        option
        for each in (command, *getattr(command, "commands", {}).values())
        for parameter in each.params
        for option in parameter.opts
        if option.startswith("--")
    }
    assert options <= {"--help", *re.findall(r"--[a-z-]+", text)}
    assert all(f"psg config {sub}" in text for sub in getattr(command, "commands", {}))
    assert f"commands/{name}.md" in (ROOT / "docs" / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_pages(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8")):
        assert "://" in target or (page.parent / target).exists(), f"{page.name}: {target}"


def test_presets_are_described() -> None:
    text = (ROOT / "docs" / "commands" / "config.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in text for name in available_presets())
