"""What a report says of a run in words: its key figures, and what a user should look at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from posegraph_slam.loop_closure.verification import gaussian_sigmas
from posegraph_slam.pose_graph.residuals import chi2
from posegraph_slam.report.run_content import RunContent

OUTSIDE_SIGMAS = 3.0
"""Closures further than this from the solution are pointed out."""
SEARCHED_SHARE = 0.05
"""Scans that needed a wide search are pointed out from this share on."""
LONG_PATH_M = 30.0
"""A path longer than this without any closure is pointed out."""

HEADLINES = ("APE position RMSE", "relations position mean", "start-end gap")
"""The metric of the first key figure: the first that the run has."""
SERIOUS = ("missing", " ends ", "cut off", "disagree", "did not converge")
"""What a remark says that a user should look at; the others are for the record."""
MAIN = ("APE position RMSE", "relations position mean", "map crispness")
"""Metrics that must not get worse from the first stage to the last."""
LOWER_IS_BETTER = ("APE", "RPE", "relations", "near relations", "far relations")


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A key figure: what it is called, its value with unit, and a line of context."""

    label: str
    value: str
    note: str = ""


def better(metric: str) -> int:
    """Return -1 where lower values of a metric are better, 1 where higher ones are, 0 where neither."""
    if metric.startswith(LOWER_IS_BETTER):
        return -1
    return 1 if metric == "map crispness" else 0


def table_rows(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a run's comparison, none where the run compares nothing."""
    return list(metrics.get("table", {}).get("rows") or [])


def printed(row: Mapping[str, Any], value: float | None) -> str:
    """Return a value of the comparison as the command line prints it."""
    return "–" if value is None else f"{value:.{row.get('decimals', 3)}f}"


def key_figures(content: RunContent) -> list[Figure]:
    """Return the figures at the head of a report, as far as the run knows them."""
    metrics, record = content.run.metrics, content.run.record
    figures = [*_headline(metrics)]
    if "loops_proposed" in metrics:
        figures.append(
            Figure(
                label="Loop closures",
                value=count(metrics.get("loops_accepted", 0)),
                note=f"of {count(metrics['loops_proposed'])} candidates",
            )
        )
    name, last = list(content.trajectories.items())[-1] if content.trajectories else ("", None)
    duration = 0.0
    if last is not None and len(last):
        duration = float(np.ptp(last.stamps_s))
        # files are in the order of their stamps; the path was measured in that of the scans, which may differ
        stage = metrics.get("stages", {}).get(name, {})
        length_m = (stage.get("path") or {}).get("length_m")
        length_m = last.path_length_m if length_m is None else length_m
        nodes = f", {count(metrics['keyframes'])} keyframes" if "keyframes" in metrics else ""
        figures.append(
            Figure(
                label="Path",
                value=f"{length_m:,.1f} m".replace(",", " "),
                note=f"{count(len(last))} scans{nodes}",
            )
        )
        figures.append(Figure(label="Log", value=clock(duration), note="recorded"))
    total = float(record.get("total_s") or 0.0)
    speed = f"{duration / total:.0f}× faster than recorded" if 0 < total < duration else ""
    figures.append(Figure(label="Computed in", value=clock(total), note=speed))
    return figures


def _headline(metrics: Mapping[str, Any]) -> Iterator[Figure]:
    rows = {row["metric"]: row for row in table_rows(metrics)}
    name = next((name for name in HEADLINES if name in rows), None)
    if name is None:
        return
    row = rows[name]
    values = list(row["values"].values())
    stages = list(row["values"])
    unit = f" {row['unit']}" if row["unit"] else ""
    yield Figure(
        label=name, value=f"{printed(row, values[-1])}{unit}", note=f"{stages[0]}: {printed(row, values[0])}{unit}"
    )


def count(number: int) -> str:
    """Write a count with thin spaces between thousands."""
    return f"{number:,}".replace(",", "\u2009")


def clock(seconds: float) -> str:
    """Write a duration as people say it."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def warnings(content: RunContent) -> list[str]:
    """Return sentences on what may be wrong with the run, the weightiest first."""
    metrics = content.run.metrics
    serious = [remark for remark in _noted(metrics) if any(words in remark for words in SERIOUS)]
    return [*_stored_warnings(content), *_worse(metrics), *_closures(content), *serious, *_searched(metrics)]


def remarks(content: RunContent) -> list[str]:
    """Return what the reader, odometry and scan matching had to say of the log."""
    return [remark for remark in _noted(content.run.metrics) if not any(words in remark for words in SERIOUS)]


def _noted(metrics: Mapping[str, Any]) -> list[str]:
    return [str(remark) for remark in metrics.get("remarks", [])]


def _stored_warnings(content: RunContent) -> list[str]:
    if "warnings" in content.run.metrics:
        return [str(warning) for warning in content.run.metrics["warnings"]]
    records = content.stored.records if content.stored else ()
    dropped = sum(not record.accepted and np.isfinite(record.sigmas_after) for record in records)
    return [f"{dropped} closures disagreed with the rest and were taken out"] if dropped else []


def _worse(metrics: Mapping[str, Any]) -> Iterator[str]:
    """Name the main metrics by which the last stage is worse than the first."""
    for row in table_rows(metrics):
        values = [value for value in row["values"].values() if value is not None]
        sign = better(row["metric"]) if row["metric"] in MAIN else 0
        tolerance = 10.0 ** -row.get("decimals", 3)
        if sign and len(values) > 1 and sign * (values[-1] - values[0]) < -tolerance:
            stages = list(row["values"])
            yield (
                f"{stages[-1]} is worse than {stages[0]}: {row['metric']} {printed(row, values[-1])} "
                f"against {printed(row, values[0])} {row['unit']}".rstrip()
            )


def _closures(content: RunContent) -> Iterator[str]:
    stored = content.stored
    if stored is None:
        return
    first, number = len(stored.graph) - 1, len(stored.record_of)
    steps = np.linalg.norm(np.diff(stored.graph.poses[:, :2, -1], axis=0), axis=1)
    if number == 0 and float(steps.sum()) > LONG_PATH_M:
        yield f"no loop was closed on a path of {steps.sum():.0f} m: its drift stays in the map"
        return
    sigmas = gaussian_sigmas(chi2(stored.graph)[first : first + number], stored.graph.group.dof)
    outside = int((sigmas > OUTSIDE_SIGMAS).sum())
    if outside == 1:
        yield f"1 closure disagrees with the rest by more than {OUTSIDE_SIGMAS:g} sigma: colour the map by χ² to see it"
    elif outside:
        yield (
            f"{outside} closures disagree with the rest by more than {OUTSIDE_SIGMAS:g} sigma: "
            "colour the map by χ² to see them"
        )


def _searched(metrics: Mapping[str, Any]) -> Iterator[str]:
    searched, scans = metrics.get("scans_searched", 0), metrics.get("scans", 0)
    if searched and searched > SEARCHED_SHARE * scans:
        yield f"{count(searched)} of {count(scans)} scans did not match at first and needed a wider search"
