"""The sections of a report that need no script: head, findings, comparison, closures, times, configuration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.report.charts import bar, residual_histograms, table
from posegraph_slam.report.findings import (
    better,
    clock,
    count,
    key_figures,
    printed,
    remarks,
    table_rows,
    warnings,
)
from posegraph_slam.report.markup import Markup, element, join
from posegraph_slam.report.run_content import RunContent
from posegraph_slam.settings import Settings

REASONS_SHOWN = 12
"""Reasons of refusal listed; rarer ones are gathered in a last row."""


def section(title: str, identity: str, *content: str | None) -> Markup:
    """Return a section with a heading that can be linked to."""
    return element("section", element("h2", title), *content, id=identity, class_="card")


def head(content: RunContent) -> Markup:
    """Return title and subtitle of the page."""
    source = content.run.record.get("input", {})
    path = str(source.get("path", ""))
    name = path.rstrip("/").rsplit("/", 1)[-1]
    said = [f"{source.get('format', 'log')} log", element("b", name, title=path)] if name else ["run"]
    stages = list(content.trajectories)
    what = f" · {stages[-1]}" if stages else ""
    version = content.run.record.get("posegraph_slam", "?")
    return join(
        element("p", "posegraph_slam", class_="kicker"),
        element("h1", content.name),
        element("p", said[0], " ", *said[1:], what, f" · version {version}", class_="subtitle"),
    )


def figures(content: RunContent) -> Markup:
    """Return the key figures as a list."""
    return element(
        "dl",
        *(
            element(
                "div",
                element("dt", figure.label[:1].upper() + figure.label[1:]),
                element("dd", figure.value),
                element("dd", figure.note, class_="note") if figure.note else None,
            )
            for figure in key_figures(content)
        ),
        class_="figures",
    )


def worth_a_look(content: RunContent) -> Markup | None:
    """Return what a user should look at."""
    sentences = warnings(content)
    return section("Worth a look", "warnings", _list(sentences)) if sentences else None


def notes(content: RunContent) -> Markup | None:
    """Return what was noted of the log on the way."""
    sentences = remarks(content)
    return section("Notes on the log", "notes", _list(sentences)) if sentences else None


def _list(sentences: list[str]) -> Markup:
    return element("ul", *(element("li", sentence[:1].upper() + sentence[1:]) for sentence in sentences))


def comparison(metrics: Mapping[str, Any]) -> Markup | None:
    """Return the table of the stages; the best value of a metric that can be better is marked."""
    rows = table_rows(metrics)
    if not rows:
        return None
    stages = list(rows[0]["values"])
    cells: list[list[str | Markup]] = []
    for row in rows:
        known = [value for value in row["values"].values() if value is not None]
        sign = better(row["metric"])
        best = max(known, key=lambda value: sign * value) if sign and len(known) > 1 else None
        unit = element("span", f" {row['unit']}", class_="unit") if row["unit"] else None
        cells.append(
            [
                element("span", row["metric"], unit),
                *(_compared(row, value, best is not None and value == best) for value in row["values"].values()),
            ]
        )
    note = "Marked: the best of each line. Start–end gap and path length are facts of the route, not errors."
    return section(
        "Comparison of the stages",
        "comparison",
        table(["", *stages], cells, caption="Metrics of each stage", class_="numbers"),
        element("p", note, class_="note"),
    )


def _compared(row: Mapping[str, Any], value: float | None, is_best: bool) -> Markup:
    if is_best:
        return element("td", element("strong", printed(row, value), title="best"), class_="best")
    return element("td", printed(row, value))


def closures(content: RunContent) -> Markup | None:
    """Return counts of the candidates by kind, and why candidates were refused."""
    if content.stored is None or not content.stored.records:
        return None
    records = content.stored.records
    proposed = Counter(record.kind for record in records)
    accepted = Counter(record.kind for record in records if record.accepted)
    kinds: list[list[str | Markup]] = [
        [kind.replace("_", " "), count(number), count(accepted[kind]), bar(accepted[kind] / number)]
        for kind, number in sorted(proposed.items())
    ]
    reasons = Counter(general_reason(record.reason) for record in records if not record.accepted).most_common()
    shown = reasons[:REASONS_SHOWN]
    rest = sum(number for _, number in reasons[REASONS_SHOWN:])
    shown += [("other reasons", rest)] if rest else []
    most = max((number for _, number in shown), default=1)
    why: list[list[str | Markup]] = [[reason, count(number), bar(number / most)] for reason, number in shown]
    parts = [table(["kind", "tried", "accepted", "share"], kinds, caption="Loop candidates by kind", class_="numbers")]
    if why:
        parts += [
            element("h3", "Why candidates were refused"),
            table(["reason", "count", ""], why, caption="Reasons of refusal", class_="numbers"),
        ]
    return section("Loop closures", "closures", *parts)


def general_reason(reason: str) -> str:
    """Return a reason without its numbers, so that equal ones can be counted."""
    words = reason.partition(":")[0].split()
    return " ".join("…" if any(letter.isdigit() for letter in word) else word for word in words)


def residuals(content: RunContent) -> Markup | None:
    """Return the histograms of the residuals at the solution."""
    if content.stored is None or len(content.stored.graph.constraints) == 0:
        return None
    note = (
        "Each histogram is a share of its own constraints; values beyond the axis are in the last bin. χ² to the "
        "right of the dashed line: the constraints claim to know more than they do; to the left: they know more than "
        "they claim."
    )
    return section("Residuals", "residuals", residual_histograms(content.stored), element("p", note, class_="note"))


def times(record: Mapping[str, Any]) -> Markup | None:
    """Return the seconds of each stage as bars."""
    stages = {str(name): float(seconds) for name, seconds in (record.get("stages_s") or {}).items()}
    if not stages:
        return None
    longest = max(*stages.values(), 1e-9)
    rows: list[list[str | Markup]] = [
        [name, f"{seconds:.2f}", bar(seconds / longest)] for name, seconds in stages.items()
    ]
    compiling = float(record.get("jit_compile_s") or 0.0)
    said = f"{clock(float(record.get('total_s') or 0.0))} in all"
    said += f", of which {compiling:.1f} s went into compiling kernels" if compiling > 0.05 else ""
    memory = record.get("peak_memory_mib")
    said += f"; peak memory {memory:.0f} MiB" if isinstance(memory, int | float) else ""
    return section(
        "Time",
        "time",
        table(["stage", "seconds", ""], rows, caption="Seconds of each stage", class_="numbers"),
        element("p", said + ".", class_="note"),
    )


def configuration(settings: Configuration) -> Markup:
    """Return every key; those that differ from their default are marked and listed first."""
    flat, standard = flattened(settings), flattened(type(settings)())
    changed = {key: value for key, value in flat.items() if value != standard.get(key)}
    parts: list[Markup] = []
    if changed:
        rows: list[list[str | Markup]] = [
            [element("code", key), element("code", value), element("code", standard.get(key, "–"))]
            for key, value in changed.items()
        ]
        parts.append(table(["changed key", "value", "default"], rows, caption="Keys that differ from their default"))
    else:
        parts.append(element("p", "Every key has its default value."))
    groups: dict[str, list[str]] = {}
    for key in flat:
        groups.setdefault(key.partition(".")[0] if "." in key else "general", []).append(key)
    for group, keys in groups.items():
        rows = [[element("code", key), element("code", flat[key])] for key in keys]
        inner = table(["key", "value"], rows, caption=f"Configuration of {group}")
        parts.append(element("details", element("summary", f"{group.replace('_', ' ')} ({len(keys)})"), inner))
    return section("Configuration", "configuration", *parts)


def flattened(settings: Settings, prefix: str = "") -> dict[str, str]:
    """Return the keys of nested settings as section.key, each value as text."""
    flat: dict[str, str] = {}
    for name in type(settings).model_fields:
        value = getattr(settings, name)
        if isinstance(value, Settings):
            flat |= flattened(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = str(getattr(value, "value", value))
    return flat


def provenance(record: Mapping[str, Any]) -> Markup:
    """Return where the run came from: command, input, versions."""
    source = record.get("input") or {}
    rows = {
        "command": " ".join(str(word) for word in record.get("command") or []),
        "input": source.get("path"),
        "input SHA-256": source.get("sha256"),
        "configuration SHA-256": record.get("configuration_sha256"),
        "seed": record.get("seed"),
        "python": record.get("python"),
        "platform": record.get("platform"),
        **(record.get("packages") or {}),
    }
    cells: list[list[str | Markup]] = [
        [name, element("code", str(value))] for name, value in rows.items() if value not in (None, "")
    ]
    return section("Provenance", "provenance", table(["", ""], cells, caption="Where the run came from"))
