"""Small charts as inline SVG: histograms of residuals, and bars in tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtr

from posegraph_slam.arrays import FloatArray
from posegraph_slam.pipeline.stored_graph import StoredGraph
from posegraph_slam.pose_graph.graph import ConstraintKind
from posegraph_slam.pose_graph.residuals import chi2_of_residuals, constraint_residuals
from posegraph_slam.report.markup import Markup, element, join

BINS = 32
SHOWN_SHARE = 0.98
"""Part of the values that lie on the axis; the rest is in its last bin."""
CHI2_DECADES = (-3, 2)
"""Powers of ten between which chi-square is shown; what lies outside is in the first and the last bin."""
WIDTH, HEIGHT, FLOOR, TOP = 360.0, 190.0, 158.0, 12.0
LEFT, RIGHT = 8.0, 352.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Residuals:
    """Errors of the constraints of one origin at the solution: position (m), rotation (rad), chi-square (E,)."""

    position_m: FloatArray
    rotation_rad: FloatArray
    chi2: FloatArray


def residuals_by_origin(stored: StoredGraph) -> dict[str, Residuals]:
    """Return the residuals of scan matching, closures and overlaps; origins without constraints are left out."""
    graph, kind = stored.graph, stored.graph.constraints.kind
    errors = constraint_residuals(graph)
    squared = chi2_of_residuals(errors, graph.constraints.information)
    matching, overlap = kind == int(ConstraintKind.SCAN_MATCHING), kind == int(ConstraintKind.OVERLAP)
    closure = graph.constraints.is_loop & ~overlap & (kind != int(ConstraintKind.SAME_GROUND))
    origins = {"scan matching": matching, "closures": closure, "overlaps": overlap}
    # the tangent of SE(2) is [position, rotation], that of SE(3) [rotation, position]
    position, rotation = (slice(0, 2), slice(2, 3)) if graph.group.dimension == 2 else (slice(3, 6), slice(0, 3))
    return {
        name: Residuals(
            position_m=np.linalg.norm(errors[rows, position], axis=1),
            rotation_rad=np.linalg.norm(errors[rows, rotation], axis=1),
            chi2=squared[rows],
        )
        for name, rows in origins.items()
        if rows.any()
    }


def residual_histograms(stored: StoredGraph) -> Markup:
    """Draw the histograms of position, rotation and chi-square, each origin as a share of its own constraints."""
    by_origin = residuals_by_origin(stored)
    dof = stored.graph.group.dof
    metric = (
        ("Position residual", "mm", {name: 1000 * each.position_m for name, each in by_origin.items()}),
        ("Rotation residual", "°", {name: np.degrees(each.rotation_rad) for name, each in by_origin.items()}),
    )
    squared = {name: each.chi2 for name, each in by_origin.items()}
    figures = [histogram(title, unit, values, linear_axis(values, unit)) for title, unit, values in metric]
    figures.append(histogram("χ²", "", squared, decade_axis(), expected=lambda edges: np.asarray(chdtr(dof, edges))))
    return element("div", *figures, class_="charts")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Axis:
    """Edges of the bins (BINS + 1,), and the ticks: place in 0 to 1 and text."""

    edges: FloatArray
    ticks: tuple[tuple[float, str], ...]


def linear_axis(values: Mapping[str, FloatArray], unit: str) -> Axis:
    """Return an axis from zero to what `SHOWN_SHARE` of each origin stays below."""
    high = max([*(float(np.quantile(each, SHOWN_SHARE)) for each in values.values() if len(each)), 1e-6])
    step = round_step(high / 4)
    places = [number * step for number in range(int(high / step + 1e-9) + 1)]
    ticks = tuple((place / high, f"{place:.6g}" + (f" {unit}" if place == 0 else "")) for place in places)
    return Axis(edges=np.linspace(0.0, high, BINS + 1), ticks=ticks)


def decade_axis() -> Axis:
    """Return the logarithmic axis of chi-square."""
    low, high = CHI2_DECADES
    ticks = tuple(((power - low) / (high - low), f"{10.0**power:g}") for power in range(low, high + 1))
    return Axis(edges=np.logspace(low, high, BINS + 1), ticks=ticks)


def histogram(
    title: str,
    unit: str,
    values: Mapping[str, FloatArray],
    axis: Axis,
    *,
    expected: Callable[[FloatArray], FloatArray] | None = None,
) -> Markup:
    """Draw one panel; `expected` is the distribution function that right noise models would give, drawn as a line."""
    low, high = float(axis.edges[0]), float(axis.edges[-1])
    shares = {
        name: np.histogram(np.clip(each, low, high * (1 - 1e-9)), bins=axis.edges)[0] / max(len(each), 1)
        for name, each in values.items()
    }
    line = np.diff(expected(axis.edges)) if expected is not None else np.zeros(0)
    peak = max(*(float(share.max()) for share in shares.values()), float(line.max(initial=0.0)), 1e-9)
    drawn = [
        element("path", d=_steps(share / peak), class_=f"area origin-{number}")
        for number, share in enumerate(shares.values())
    ]
    if len(line):
        drawn.append(element("path", d=_curve(line / peak), class_="expected"))
    medians = ", ".join(f"{name} {np.median(each):.3g}" for name, each in values.items())
    label = f"{title}{f' in {unit}' if unit else ''}; medians: {medians}"
    chart = element(
        "svg",
        *drawn,
        element("line", x1=LEFT, x2=RIGHT, y1=FLOOR, y2=FLOOR, class_="axis"),
        *_ticks(axis),
        viewBox=f"0 0 {WIDTH:g} {HEIGHT:g}",
        role="img",
        aria_label=label,
    )
    rows = [
        element("li", element("span", class_=f"swatch origin-{number}"), f"{name}: median {np.median(each):.3g} {unit}")
        for number, (name, each) in enumerate(values.items())
    ]
    if len(line):
        rows.append(element("li", element("span", class_="swatch expected"), "what right noise models would give"))
    return element("figure", element("figcaption", title), chart, element("ul", *rows, class_="key"))


def _place(x: FloatArray, y: FloatArray) -> list[tuple[float, float]]:
    across = LEFT + (RIGHT - LEFT) * x
    up = FLOOR - (FLOOR - TOP) * y
    return list(zip(across.tolist(), up.tolist(), strict=True))


def _steps(share: FloatArray) -> str:
    """Outline of bars of heights `share` (BINS,) in 0 to 1, closed along the floor."""
    x = np.repeat(np.linspace(0, 1, len(share) + 1), 2)
    y = np.concatenate([[0.0], np.repeat(share, 2), [0.0]])
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in _place(x, y)) + "Z"


def _curve(share: FloatArray) -> str:
    x = (np.arange(len(share)) + 0.5) / len(share)
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in _place(x, share))


def _ticks(axis: Axis) -> list[Markup]:
    marks = []
    for place, text in axis.ticks:
        x = LEFT + (RIGHT - LEFT) * place
        anchor = "start" if place < 0.05 else "middle" if place < 0.95 else "end"
        marks.append(element("line", x1=f"{x:.1f}", x2=f"{x:.1f}", y1=FLOOR, y2=FLOOR + 4, class_="axis"))
        marks.append(element("text", text, x=f"{x:.1f}", y=FLOOR + 20, text_anchor=anchor))
    return marks


def round_step(least: float) -> float:
    """Return the smallest 1, 2 or 5 times a power of ten that is not below `least`."""
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= least * (1 - 1e-9)))


def bar(share: float) -> Markup:
    """Return a bar that fills `share` (0 to 1) of its table cell."""
    rect = element("rect", width=f"{100 * min(max(share, 0.0), 1.0):.2f}", height=10, rx=1)
    return element("svg", rect, viewBox="0 0 100 10", preserveAspectRatio="none", class_="bar", aria_hidden="true")


def table(header: list[str], rows: list[list[str | Markup]], *, caption: str, class_: str = "") -> Markup:
    """Return a table that scrolls sideways on narrow screens; the first cell of a row is its header."""
    head = element("tr", *(element("th", cell, scope="col") for cell in header))
    body = [element("tr", element("th", row[0], scope="row"), row_cells(row[1:])) for row in rows]
    whole = element(
        "table", element("caption", caption, class_="hidden"), element("thead", head), element("tbody", *body)
    )
    return element("div", whole, class_=f"scroll {class_}".strip(), tabindex=0, role="region", aria_label=caption)


def row_cells(cells: list[str | Markup]) -> Markup:
    """Return cells; those that are td already stay."""
    return join(
        *(cell if isinstance(cell, Markup) and cell.startswith("<td") else element("td", cell) for cell in cells)
    )
