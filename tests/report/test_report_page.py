"""The report as a file: whole, escaped, the same bytes again, of bounded size, and right in what it says."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from posegraph_slam.errors import InputError
from posegraph_slam.pipeline.run_directory import read_run_directory
from posegraph_slam.pipeline.stored_graph import attitudes, read_stored_graph
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints
from posegraph_slam.report.charts import BINS, decade_axis, histogram, linear_axis
from posegraph_slam.report.findings import clock, warnings
from posegraph_slam.report.map_layers import PATH_POINTS, map_layers, millimetres, thinned
from posegraph_slam.report.markup import Markup, asset, content_hash, element, fill, json_block
from posegraph_slam.report.page import report_page, write_report
from posegraph_slam.report.run_content import read_run_content
from posegraph_slam.report.sections import general_reason


class Parsed(HTMLParser):
    """Tags, attributes and visible text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.said: list[str] = []
        self.data: dict[str, str] = {}
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))
        if tag not in {"meta", "link", "input", "br"}:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.data[self.tags[-1][1].get("id") or "code"] = data
        elif not self.open or self.open[-1] != "style":
            self.said.append(data)


@pytest.fixture(scope="module")
def page(small_run: Path) -> Parsed:
    return Parsed((small_run / "report.html").read_text(encoding="utf-8"))


def test_page_is_well_formed_and_holds_every_section(page: Parsed) -> None:
    assert page.open == []
    identities = [attributes["id"] for _, attributes in page.tags if attributes.get("id")]
    assert len(identities) == len(set(identities))
    wanted = {"warnings", "map", "comparison", "closures", "residuals", "time", "configuration", "provenance"}
    assert wanted <= set(identities)
    said = " ".join(page.said)
    for words in ("APE position RMSE", "odometry", "scan matching", "optimised", "loop_closure.enabled", "maps"):
        assert words in said


def test_page_refers_to_nothing_outside_itself(page: Parsed, small_run: Path) -> None:
    named = {"src", "href", "action", "data", "poster", "srcset", "style", "background"}
    outside = [(tag, a) for tag, attributes in page.tags for a in attributes.items() if a[0] in named]
    assert outside == [("link", ("href", "data:,")), ("a", ("href", "#comparison"))]
    assert not [a for _, attributes in page.tags for a in attributes if a.startswith("on")]
    text = (small_run / "report.html").read_text(encoding="utf-8")
    assert "url(" not in text
    assert "@import" not in text


def test_policy_allows_exactly_the_page_s_own_style_and_script(page: Parsed, small_run: Path) -> None:
    policy = next(a["content"] for tag, a in page.tags if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    assert policy.startswith("default-src 'none';")
    assert f"script-src {content_hash(page.data['code'])}" in policy
    assert f"style-src {content_hash(asset('report.css'))}" in policy
    assert "connect-src" not in policy
    assert "unsafe" not in policy


def test_report_of_a_run_has_the_bytes_that_the_run_wrote(small_run: Path, tmp_path: Path) -> None:
    again = write_report(small_run, tmp_path / "report.html")
    assert again.read_bytes() == (small_run / "report.html").read_bytes()
    assert again.stat().st_size < 400_000


def test_names_that_are_no_text_do_not_keep_a_report_from_being_written(small_run: Path, tmp_path: Path) -> None:
    out = write_report(small_run, tmp_path / "report.html", name=os.fsdecode(b"log\xff"))
    assert "log?" in out.read_text(encoding="utf-8")


def test_texts_from_files_and_names_cannot_become_markup(hostile_run: Path) -> None:
    text = report_page(read_run_content(hostile_run))
    page = Parsed(text)
    scripts = [attributes for tag, attributes in page.tags if tag == "script"]
    assert scripts == [{"type": "application/json", "id": "data-layers"}, {}]
    assert not [tag for tag, _ in page.tags if tag in {"img", "b"} and tag == "img"]
    assert not [a for _, attributes in page.tags for a in attributes if a.startswith("on")]
    assert "</script><script>window.hacked=1" in "".join(page.said)
    layers = json.loads(page.data["data-layers"])
    assert any("window.hacked" in reason for reason in layers["loops"]["reasons"])
    assert "window.hacked" in layers["paths"][0]["name"]


@settings(max_examples=40)
@given(st.text())
def test_any_text_survives_escaping(text: str) -> None:
    clean = text.replace("\r", "\n").replace("\0", "")
    written = element("p", clean, title=clean)
    page = Parsed(written)
    assert [tag for tag, _ in page.tags] == ["p"]
    assert "".join(page.said) == clean
    block = json_block("x", {"text": text})
    assert not set("<>&") & set(block.removeprefix('<script type="application/json" id="x">').removesuffix("</script>"))
    assert json.loads(Parsed(block).data["x"])["text"] == text


def test_template_places_are_filled_once() -> None:
    assert fill("{{a}}-{{b}}", {"a": Markup("{{b}}"), "b": Markup("2")}) == "{{b}}-2"
    with pytest.raises(KeyError):
        fill("{{unknown}}", {})


def test_map_shows_every_candidate_with_its_reason(small_run: Path) -> None:
    content = read_run_content(small_run)
    layers = map_layers(content)
    with (small_run / "loops.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    loops = layers["loops"]
    shown = [
        (i, j, loops["kinds"][kind], bool(accepted), loops["reasons"][reason])
        for i, j, kind, accepted, reason in zip(
            loops["i"], loops["j"], loops["kind"], loops["accepted"], loops["reason"], strict=True
        )
    ]
    wanted = [
        (int(row["target"]), int(row["source"]), row["kind"], row["accepted"] == "true", row["reason"]) for row in rows
    ]
    assert shown == wanted
    assert {accepted for *_, accepted, _ in wanted} == {True, False}
    assert all((sigma is not None) == accepted for sigma, (*_, accepted, _) in zip(loops["sigma"], shown, strict=True))
    last = np.cumsum(np.array(layers["paths"][-1]["mm"]).reshape(-1, 2), axis=0)[-1] / 1000
    np.testing.assert_allclose(last, content.trajectories["optimised"].positions[-1, :2], atol=1e-3)
    assert [path["name"] for path in layers["paths"]] == ["odometry", "scan matching", "optimised"]


def test_stored_graph_knows_the_kind_of_every_constraint(small_run: Path) -> None:
    run = read_run_directory(small_run)
    stored = read_stored_graph(run)
    assert len(stored.chain) == len(stored.graph) - 1 == run.metrics["keyframes"] - 1
    assert len(stored.closures) == run.metrics["loops_accepted"]
    kinds = {kind.name.lower(): int((stored.closures.kind == kind).sum()) for kind in ConstraintKind}
    assert {kind: n for kind, n in kinds.items() if n} == {
        kind: each["accepted"] for kind, each in run.metrics["loops_by_kind"].items() if each["accepted"]
    }
    assert all(record.accepted for record in (stored.records[row] for row in stored.record_of))


def test_stored_graph_of_another_run_is_refused(small_run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(small_run, folder)
    lines = (folder / "loops.csv").read_text().splitlines()
    accepted = next(k for k, line in enumerate(lines) if line.endswith(",true,"))
    (folder / "loops.csv").write_text("\n".join(lines[:accepted] + lines[accepted + 1 :]) + "\n")
    with pytest.raises(InputError, match=r"graph\.g2o: does not belong to loops\.csv"):
        read_stored_graph(read_run_directory(folder))
    (folder / "loops.csv").write_text("\n".join([*lines[:2], lines[2].replace("proximity", "guess") + ",,x"]) + "\n")
    broken = (folder / "loops.csv").read_text().replace("fixed_interval", "guessed")
    (folder / "loops.csv").write_text(broken)
    with pytest.raises(InputError, match=r"loops\.csv:2: is not a loop candidate"):
        read_stored_graph(read_run_directory(folder))


def test_parts_that_a_run_does_not_have_are_left_out(small_run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "bare"
    folder.mkdir()
    for name in ("run.json", "config.toml", "trajectory.tum"):
        shutil.copy(small_run / name, folder)
    text = write_report(folder).read_text(encoding="utf-8")
    assert 'id="comparison"' not in text.replace('href="#comparison"', "")
    assert 'id="residuals"' not in text
    assert json.loads(Parsed(text).data["data-layers"])["paths"][0]["name"] == "estimate"
    with pytest.raises(InputError, match="is not a run directory"):
        write_report(tmp_path)


def test_findings_are_said_in_plain_words(small_run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(small_run, folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["remarks"] = ["the imu stream ends 1.40 s before the scans stream", "the median was 1.0 g"]
    metrics["warnings"] = ["3 closures disagreed with the rest and were taken out; loops.csv says which"]
    metrics["scans_searched"] = metrics["scans"]
    for row in metrics["table"]["rows"]:
        if row["metric"] == "APE position RMSE":
            row["values"]["optimised"] = row["values"]["odometry"] + 1
    (folder / "metrics.json").write_text(json.dumps(metrics))
    said = warnings(read_run_content(folder))
    assert said[0].startswith("3 closures disagreed")
    assert said[1].startswith("optimised is worse than odometry: APE position RMSE 1.")
    assert said[2] == "the imu stream ends 1.40 s before the scans stream"
    assert "did not match at first" in said[3]
    assert not any("median" in sentence for sentence in said)


@settings(max_examples=30)
@given(count=st.integers(0, 30_000), seed=st.integers(0, 9))
def test_thinned_paths_keep_their_ends_and_their_shape(count: int, seed: int) -> None:
    steps = np.random.default_rng(seed).normal(size=(count, 2))
    steps[: count // 2] *= 0.001
    xy = np.cumsum(steps, axis=0)
    kept = thinned(xy)
    assert len(kept) <= max(PATH_POINTS, 2)
    assert np.all(np.diff(kept) > 0)
    if count:
        assert (kept[0], kept[-1]) == (0, count - 1)
        path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps[1:], axis=1))])
        longest = np.linalg.norm(steps[1:], axis=1).max(initial=0.0)
        assert np.diff(path[kept]).max(initial=0.0) <= path[-1] / (PATH_POINTS - 2) + 2 * longest + 1e-9
    whole = np.cumsum(np.array(millimetres(xy[kept]), dtype=np.int64).reshape(-1, 2), axis=0)
    np.testing.assert_allclose(whole / 1000, xy[kept], atol=5.001e-4)


def test_histograms_hold_every_value() -> None:
    values = {"few": np.array([0.0, 0.1, 0.2, 90.0])}
    drawn = histogram("Errors", "m", values, linear_axis(values, "m"))
    assert "few: median 0.15 m" in drawn
    outline = re.findall(r'd="M([^"]+)Z"', drawn)[0]
    corners = np.array([[float(v) for v in point.split()] for point in outline.split("L")])
    heights = (158.0 - corners[1:-1:2, 1]) / (158.0 - 12.0)
    assert len(heights) == BINS
    # three of the four values are in the first bin, which is full height; the one beyond the axis is in the last
    np.testing.assert_allclose(heights, [1.0, *[0.0] * (BINS - 2), 1 / 3], atol=0.01)
    axis = decade_axis()
    assert axis.edges[0] == pytest.approx(1e-3)
    assert [text for _, text in axis.ticks] == ["0.001", "0.01", "0.1", "1", "10", "100"]


def luminance(colour: str) -> float:
    """Relative luminance of #rrggbb (WCAG 2.2)."""
    parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
def test_colours_have_enough_contrast(theme: int) -> None:
    blocks = re.findall(r":root \{(.*?)\}", asset("report.css"), re.DOTALL)
    colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", blocks[theme]))

    def contrast(a: str, b: str) -> float:
        high, low = sorted((luminance(colours[a]), luminance(colours[b])), reverse=True)
        return (high + 0.05) / (low + 0.05)

    texts = [("ink", "page"), ("ink", "surface"), ("muted", "page"), ("muted", "surface"), ("accent", "page")]
    texts += [("accent", "surface"), ("warn", "warn-page"), ("ink", "warn-page"), ("best-ink", "best")]
    assert {pair: contrast(*pair) for pair in texts if contrast(*pair) < 4.5} == {}
    lines = [
        "path-0",
        "path-1",
        "path-2",
        "proximity",
        "start_end",
        "global",
        "manual",
        "overlap",
        "rejected",
        "sigma-3",
    ]
    assert {name: contrast(name, "free") for name in lines if contrast(name, "free") < 2.5} == {}


def test_durations_and_reasons_read_well() -> None:
    assert [clock(s) for s in (7.62, 59.94, 124, 2691, 7325)] == [
        "7.6 s", "59.9 s", "2 min 04 s", "44 min 51 s", "2 h 02 min"
    ]  # fmt: skip
    assert general_reason("too few points match: 0.40") == "too few points match"
    assert general_reason("would move the graph by 4.1 sigma") == "would move the graph by … sigma"


def test_attitudes_of_a_graph_in_space_are_told_from_its_overlaps() -> None:
    nodes = 5
    pairs = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 3), (0, 1), (1, 2), *((0, k) for k in range(1, nodes)), (0, 4)]
    i, j = np.array(pairs).T
    shared = {"i": i, "j": j, "kind": np.zeros(len(i), dtype=np.int64)}
    spatial = Constraints(
        T_i_j=np.tile(np.eye(4), (len(i), 1, 1)), information=np.tile(np.eye(6), (len(i), 1, 1)), **shared
    )
    assert attitudes(spatial, nodes) == slice(7, 11)
    plane = Constraints(
        T_i_j=np.tile(np.eye(3), (len(i), 1, 1)), information=np.tile(np.eye(3), (len(i), 1, 1)), **shared
    )
    assert attitudes(plane, nodes) == slice(12, 12)
