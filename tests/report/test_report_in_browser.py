"""The report in headless Chromium: no complaint, layers, pointer, touch and keyboard, dark and narrow screens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from posegraph_slam.report.page import write_report

HASH = "document.getElementById('canvas').toDataURL()"
VIEW = "({...report.map.view})"


@pytest.fixture(scope="module")
def page(browser: Any, small_run: Path) -> Iterator[Any]:
    shown = browser.open((small_run / "report.html").as_uri())
    shown.wait("report.map.images.occupancy.drawn && report.map.images.texture.drawn")
    shown.settle()
    yield shown
    assert shown.complaints() == []


@pytest.fixture
def fresh(page: Any) -> Any:
    page.run("report.map.showAll(), report.select(null), 1")
    page.settle()
    return page


def place(page: Any, expression: str) -> tuple[float, float]:
    """Window position of a point of the map given as {x, y} in metres."""
    page.run("document.getElementById('canvas').scrollIntoView({block: 'center', behavior: 'instant'}), 1")
    page.settle()
    found = page.run(
        f"(() => {{ const p = {expression}, b = report.map.canvas.getBoundingClientRect();"
        " return [b.left + report.map.px(p.x), b.top + report.map.py(p.y)]; })()"
    )
    return found[0], found[1]


def middle_of(kind: str) -> str:
    """Return the expression for the middle of an edge of a layer."""
    return (
        f"(() => {{ const e = report.map.edges.find(e => e.layer === '{kind}'), n = report.map.nodes;"
        " return {x: (n.x[e.i] + n.x[e.j]) / 2, y: (n.y[e.i] + n.y[e.j]) / 2}; })()"
    )


def test_nothing_is_asked_of_a_network(page: Any) -> None:
    assert page.requests()
    assert all(url.startswith(("file:///", "data:")) for url in page.requests())


def test_every_layer_can_be_switched(fresh: Any) -> None:
    layers = fresh.run("[...document.querySelectorAll('#layers input')].map(i => i.id)")
    assert layers == [
        f"layer-{name}"
        for name in ("occupancy", "texture", "path-0", "path-1", "path-2", "loops", "overlaps", "rejected")
    ]
    before = fresh.run(HASH)
    pictures = {before}
    for layer in layers:
        fresh.run(f"document.getElementById('{layer}').click(), 1")
        fresh.settle()
        pictures.add(fresh.run(HASH))
        fresh.run(f"document.getElementById('{layer}').click(), 1")
        fresh.settle()
        assert fresh.run(HASH) == before, layer
    assert len(pictures) == 1 + len(layers)


def test_edges_are_coloured_by_kind_and_by_chi2(fresh: Any) -> None:
    colours = "[...new Set(report.map.edges.filter(e => e.layer === 'loops').map(e => report.map.edgeColour(e)))]"
    by_kind, picture = fresh.run(colours), fresh.run(HASH)
    kinds = fresh.run("[...new Set(report.map.edges.filter(e => e.layer === 'loops').map(e => e.kind))]")
    assert len(by_kind) == len(kinds)
    fresh.run("document.querySelector('input[value=chi2]').click(), 1")
    fresh.settle()
    assert fresh.run(colours) != by_kind
    assert fresh.run(HASH) != picture
    assert "σ" in fresh.run("document.getElementById('legend').textContent")
    fresh.run("document.querySelector('input[value=kind]').click(), 1")
    fresh.settle()
    assert fresh.run(HASH) == picture


KEYS: list[tuple[str, Callable[[dict[str, float], dict[str, float]], bool]]] = [
    ("ArrowRight", lambda a, b: b["x"] > a["x"] and b["y"] == a["y"]),
    ("ArrowLeft", lambda a, b: b["x"] < a["x"] and b["y"] == a["y"]),
    ("ArrowUp", lambda a, b: b["y"] > a["y"] and b["x"] == a["x"]),
    ("ArrowDown", lambda a, b: b["y"] < a["y"] and b["x"] == a["x"]),
    ("+", lambda a, b: b["scale"] == pytest.approx(1.4 * a["scale"])),
    ("-", lambda a, b: b["scale"] == pytest.approx(a["scale"] / 1.4)),
]


@pytest.mark.parametrize(("key", "moved"), KEYS, ids=[key for key, _ in KEYS])
def test_map_moves_by_keyboard(fresh: Any, key: str, moved: Callable[..., bool]) -> None:
    fresh.run("document.getElementById('canvas').focus(), 1")
    start = fresh.run(VIEW)
    fresh.key(key)
    assert moved(start, fresh.run(VIEW))
    fresh.key("0")
    assert fresh.run(VIEW) == pytest.approx(start)


def test_loop_edges_are_read_by_keyboard(fresh: Any) -> None:
    fresh.run("document.getElementById('canvas').focus(), 1")
    fresh.key("n")
    first = fresh.run("document.getElementById('details').textContent")
    assert "σ from the solution" in first
    worst = fresh.run("Math.max(...report.map.edges.filter(e => report.map.shown(e)).map(e => e.sigma))")
    assert fresh.run("report.map.selected.sigma") == worst
    fresh.key("n")
    assert fresh.run("document.getElementById('details').textContent") != first
    fresh.key("p")
    assert fresh.run("document.getElementById('details').textContent") == first
    fresh.key("Escape")
    assert fresh.run("report.map.selected") is None


def test_a_rejected_candidate_tells_its_reason_when_pointed_at(fresh: Any) -> None:
    fresh.run("document.getElementById('layer-rejected').click(), 1")
    fresh.run("document.getElementById('layer-loops').click(), 1")
    x, y = place(fresh, middle_of("rejected"))
    fresh.mouse("mouseMoved", x, y)
    said = fresh.run("document.getElementById('details').textContent")
    reasons = fresh.run("report.map.edges.filter(e => e.layer === 'rejected').map(e => e.reason)")
    assert said.startswith("Rejected: ")
    assert any(reason in said for reason in reasons)
    fresh.click(x, y)
    assert fresh.run("report.map.selected.layer") == "rejected"
    fresh.run("document.getElementById('layer-rejected').click(), document.getElementById('layer-loops').click(), 1")


def test_map_moves_by_mouse(fresh: Any) -> None:
    x, y = place(fresh, "report.map.view")
    start = fresh.run(VIEW)
    fresh.mouse("mousePressed", x, y, button="left", clickCount=1)
    fresh.mouse("mouseMoved", x + 50, y + 30, button="left", buttons=1)
    fresh.mouse("mouseReleased", x + 50, y + 30, button="left", clickCount=1)
    fresh.settle()
    moved = fresh.run(VIEW)
    assert (start["x"] - moved["x"]) * start["scale"] == pytest.approx(50, abs=0.5)
    assert (moved["y"] - start["y"]) * start["scale"] == pytest.approx(30, abs=0.5)
    at = "report.map.toMap(100, 80)"
    corner = place(fresh, at)
    under = fresh.run(at)
    fresh.mouse("mouseWheel", *corner, deltaX=0, deltaY=-200)
    fresh.wait(f"report.map.view.scale > {moved['scale']} * 1.2")
    assert fresh.run(at)["x"] == pytest.approx(under["x"], abs=0.05)
    assert fresh.run(at)["y"] == pytest.approx(under["y"], abs=0.05)


def test_every_control_has_a_name(page: Any) -> None:
    nodes = page.call("Accessibility.getFullAXTree")["nodes"]
    controls = {"button", "checkbox", "radio", "application", "region", "img", "table", "DisclosureTriangle"}
    named = [
        (node["role"]["value"], node.get("name", {}).get("value", ""))
        for node in nodes
        if not node.get("ignored") and node.get("role", {}).get("value") in controls
    ]
    assert len([role for role, _ in named if role == "checkbox"]) >= 8
    assert [pair for pair in named if not pair[1]] == []


def test_keyboard_reaches_the_map_and_the_layers(browser: Any, small_run: Path) -> None:
    page = browser.open((small_run / "report.html").as_uri())
    reached = []
    for _ in range(6):
        page.key("Tab", code=9)
        reached.append(page.run("document.activeElement.id || document.activeElement.className"))
    assert reached == ["skip", "canvas", "zoom-in", "zoom-out", "zoom-home", "layer-occupancy"]
    assert page.run("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    before = page.run("document.activeElement.checked")
    page.key(" ", text=" ", code=32)
    assert page.run("document.activeElement.checked") is not before
    page.key(" ", text=" ", code=32)


def test_dark_colours_follow_the_system(browser: Any, small_run: Path) -> None:
    page = browser.open((small_run / "report.html").as_uri())
    page.wait("report.map.images.occupancy.drawn")
    brightness = (
        "(() => { const from = report.map.canvas, canvas = document.createElement('canvas');"
        " canvas.width = canvas.height = 300; const c = canvas.getContext('2d', {willReadFrequently: true});"
        " c.drawImage(from, 0, 0, 300, 300); const d = c.getImageData(0, 0, 300, 300).data;"
        " let sum = 0; for (let k = 0; k < d.length; k += 4) sum += d[k] + d[k + 1] + d[k + 2];"
        " return sum / d.length * 4 / 3; })()"
    )
    background = "getComputedStyle(document.body).backgroundColor"
    page.run("['layer-texture'].forEach(i => document.getElementById(i).click()), 1")
    page.settle()
    light = page.run(brightness), page.run(background)
    page.dark(True)
    page.wait(f"{background} !== '{light[1]}'")
    page.settle()
    assert page.run(brightness) < 0.4 * light[0]
    assert page.complaints() == []


def test_phone_shows_all_without_scrolling_sideways(browser: Any, small_run: Path) -> None:
    page = browser.open((small_run / "report.html").as_uri(), width=360, height=740, phone=True)
    assert page.run("document.documentElement.scrollWidth") <= 360
    assert page.run("document.getElementById('canvas').getBoundingClientRect().width") > 280
    small = "[...document.querySelectorAll('button')].filter(b => b.getBoundingClientRect().height < 40).length"
    assert page.run(small) == 0
    x, y = place(page, "report.map.view")
    start = page.run("report.map.view.scale")

    def touch(kind: str, apart: float) -> None:
        points = [] if kind == "touchEnd" else [{"x": x - apart, "y": y, "id": 1}, {"x": x + apart, "y": y, "id": 2}]
        page.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    touch("touchStart", 30)
    touch("touchMove", 60)
    touch("touchEnd", 0)
    page.settle()
    assert page.run("report.map.view.scale") == pytest.approx(2 * start, rel=0.05)
    assert page.complaints() == []


def test_hostile_names_run_nothing(browser: Any, hostile_run: Path) -> None:
    page = browser.open(write_report(hostile_run).as_uri())
    page.run("document.getElementById('layer-rejected').click(), 1")
    page.run("report.select(report.map.edges.find(e => e.layer === 'rejected')), 1")
    assert "window.hacked" in page.run("document.getElementById('details').textContent")
    assert page.run("window.hacked === undefined")
    assert page.run("document.querySelectorAll('img, script').length") == 2
    assert page.complaints() == []
