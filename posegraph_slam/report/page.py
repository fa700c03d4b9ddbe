"""The report of a run as one HTML file that needs no network and no other file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from posegraph_slam.files import replacing
from posegraph_slam.pipeline.run_directory import REPORT, RunDirectory
from posegraph_slam.report import sections
from posegraph_slam.report.map_layers import map_layers
from posegraph_slam.report.markup import Markup, asset, content_hash, fill, join, json_block
from posegraph_slam.report.run_content import RunContent, read_run_content

STYLE, SCRIPTS, EDITOR_SCRIPTS = "report.css", ("map.js", "report.js"), ("edit.js",)


def write_report(run: Path, out: Path | None = None, *, name: str | None = None) -> Path:
    """Write the report of a run directory to `out`, by default report.html in it, and return its path.

    `name` is the run's name where the folder does not have it yet. The bytes depend on the run's files alone. Raises
    InputError where `run` is no run directory or one of its files cannot be read.
    """
    path = out or run / REPORT
    text = report_page(read_run_content(run, name=name))
    with replacing(path) as temporary:
        # names of files that are no text show a question mark
        temporary.write_text(text, encoding="utf-8", errors="replace", newline="\n")
    return path


def write_report_of(directory: RunDirectory, name: str) -> Path:
    """Write the report into a run directory that is complete but for it and will be called `name`."""
    return write_report(directory.folder, name=name)


def report_page(content: RunContent, *, editor: dict[str, Any] | None = None) -> str:
    """Return the page; `editor` holds what the editing script needs, None for a page that only shows.

    The content security policy allows the page's own style and script, pictures inside it and, for the editor, calls
    to the server that the page came from; all else is refused.
    """
    style = asset(STYLE)
    script = "\n".join(asset(name) for name in (*SCRIPTS, *(EDITOR_SCRIPTS if editor is not None else ())))
    parts = {
        "title": join(content.name, " · posegraph_slam"),
        "policy": join(content_policy(style, script, connect=editor is not None)),
        "style": Markup(style),
        "script": Markup(script),
        "head": sections.head(content),
        "figures": sections.figures(content),
        "findings": join(sections.worth_a_look(content)),
        "map": map_section(editing=editor is not None),
        "sections": join(
            sections.comparison(content.run.metrics),
            sections.closures(content),
            sections.residuals(content),
            sections.times(content.run.record),
            sections.notes(content),
            sections.configuration(content.run.configuration),
            sections.provenance(content.run.record),
        ),
        "data": join(
            json_block("data-layers", map_layers(content)),
            json_block("data-editor", editor) if editor is not None else None,
        ),
    }
    return fill(asset("report.html"), parts)


def content_policy(style: str, script: str, *, connect: bool) -> str:
    """Return the content security policy of a page with exactly this style and this script."""
    rules = [
        "default-src 'none'",
        "img-src data:",
        f"style-src {content_hash(style)}",
        f"script-src {content_hash(script)}",
        *(["connect-src 'self'"] if connect else []),
        "base-uri 'none'",
        "form-action 'none'",
    ]
    return "; ".join(rules)


def map_section(*, editing: bool) -> Markup:
    """Return the map with its controls, which the script fills."""
    return fill(asset("map.html"), {"editor": Markup(asset("edit.html")) if editing else Markup("")})
