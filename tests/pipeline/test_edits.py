"""Edits of a person: their file, how they are applied, and that a replay gives the same bytes again."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.errors import ConfigurationError, InputError
from posegraph_slam.execution import SerialExecutor
from posegraph_slam.loop_closure.manual import propose
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.editing import SWITCHED_OFF, close_with_edits, pair_of, resolve
from posegraph_slam.pipeline.edits import (
    Edit,
    Edits,
    MeasuredClosure,
    added,
    information_matrix,
    pose_matrix,
    read_edits,
    to_text,
    write_edits,
)
from posegraph_slam.pipeline.matching_file import MATCHING, read_matching
from posegraph_slam.pipeline.optimize import MatchedLog, match
from posegraph_slam.pipeline.rerun import plan_run
from posegraph_slam.pipeline.run import run
from posegraph_slam.pipeline.run_directory import read_run_directory
from posegraph_slam.pipeline.stored_graph import StoredGraph, read_stored_graph
from posegraph_slam.pose_graph.graph import ConstraintKind


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("edits")
    log = simulate(tiny_settings(duration_s=30.0), folder / "log")
    run(log, Configuration(workers=1), out=folder / "run")
    return folder / "run"


@pytest.fixture(scope="module")
def stored(finished: Path) -> StoredGraph:
    return read_stored_graph(read_run_directory(finished))


@pytest.fixture(scope="module")
def basis(finished: Path) -> MatchedLog:
    from posegraph_slam.datasets import read

    plan = plan_run(finished, [], [], start="graph")
    log = read(plan.log)
    assert log.scans is not None
    matched = read_matching(finished / MATCHING, len(log.scans))
    return match(log, plan.configuration, matched=matched, executor=SerialExecutor())


def closure_pairs(stored: StoredGraph) -> list[tuple[int, int]]:
    return [pair_of(stored, stored.records[row]) for row in stored.record_of.tolist()]


def edit(action: str, pair: tuple[int, int]) -> Edit:
    return Edit.model_validate({"action": action, "target_scan": pair[0], "source_scan": pair[1]})


numbers = st.floats(allow_nan=False, allow_infinity=False, width=64)
counts = st.integers(0, 10**9)
positive = st.floats(0, 1e300)


@st.composite
def measured(draw: st.DrawFn) -> MeasuredClosure:
    root = np.array(draw(st.lists(st.floats(-1e3, 1e3), min_size=9, max_size=9))).reshape(3, 3)
    information = root @ root.T + 0.1 * np.eye(3) * max(np.trace(root @ root.T), 1.0)
    evidence = {
        name: draw(positive) for name in MeasuredClosure.model_fields if name not in ("T_target_source", "information")
    }
    return MeasuredClosure(
        T_target_source=draw(st.tuples(numbers, numbers, numbers)),
        information=tuple(information[np.triu_indices(3)].tolist()),
        **evidence,
    )


@given(pairs=st.lists(st.tuples(st.sampled_from(["off", "on"]), counts, counts), max_size=4), closure=measured())
def test_edits_read_back_to_the_last_bit(
    tmp_path_factory: pytest.TempPathFactory, pairs: list[tuple[str, int, int]], closure: MeasuredClosure
) -> None:
    path = tmp_path_factory.mktemp("file") / "edits.toml"
    new = Edit(action="add", target_scan=3, source_scan=9, closure=closure)
    edits = Edits(log_sha256="ab" * 32, edit=(*(edit(action, (a, b)) for action, a, b in pairs), new))
    write_edits(edits, path)
    assert read_edits(path) == edits
    assert to_text(read_edits(path)) == path.read_text()
    matrix = information_matrix(closure)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert matrix[0, 1] == closure.information[1]
    write_edits(Edits(), path)
    assert not path.exists()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("format_version = 2", "format_version: "),
        ("[[edit]]\naction = 'of'\ntarget_scan = 1\nsource_scan = 2", "edit 1 action: "),
        ("[[edit]]\naction = 'off'\ntarget_scan = -1\nsource_scan = 2", "edit 1 target_scan: "),
        ("[[edit]]\naction = 'off'\ntarget_scan = 1", "edit 1 source_scan: Field required"),
        ("[[edit]]\naction = 'add'\ntarget_scan = 1\nsource_scan = 2", "edit 1: Value error, an edit 'add'"),
        ("[[edit]]\naction = 'off'\ntarget_scan = 1\nsource_scan = 2\nforce = true", "edit 1 force: Extra inputs"),
        ("edit = 3", "edit: "),
        ("edit = [", "is not valid TOML"),
    ],
)
def test_what_is_wrong_in_a_file_of_edits_is_named(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "edits.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(problem)) as error:
        read_edits(path)
    assert str(error.value).count("\n") == 0
    with pytest.raises(InputError, match="absent"):
        read_edits(tmp_path / "absent")


def test_an_information_that_is_not_positive_is_refused(tmp_path: Path, stored: StoredGraph) -> None:
    values = dict.fromkeys(MeasuredClosure.model_fields, 0.0)
    values |= {"T_target_source": (0.0, 0.0, 0.0), "information": (1.0, 2.0, 0.0, 1.0, 0.0, 1.0)}
    with pytest.raises(ValueError, match="not positive definite"):
        MeasuredClosure.model_validate(values)


def test_a_closure_that_is_switched_off_and_on_again_changes_nothing(stored: StoredGraph) -> None:
    pair = closure_pairs(stored)[0]
    both = Edits(edit=(edit("off", pair), edit("on", pair)))
    assert resolve(stored, both) == (set(), {})
    solver = Configuration().pose_graph
    plain, again = (close_with_edits(stored, edits, solver) for edits in (Edits(), both))
    np.testing.assert_array_equal(plain.graph.poses, again.graph.poses)
    # the run's own solution, but for the overlaps that refined it by millimetres
    np.testing.assert_allclose(plain.graph.poses, stored.graph.poses, atol=0.02)
    assert [r.accepted for r in plain.records] == [r.accepted for r in stored.records]


def test_a_closure_that_is_off_no_longer_counts(stored: StoredGraph) -> None:
    pairs = closure_pairs(stored)
    closed = close_with_edits(stored, Edits(edit=(edit("off", pairs[-1]),)), Configuration().pose_graph)
    assert len(closed.graph.constraints) == len(stored.chain) + len(pairs) - 1
    off = [record for record in closed.records if record.reason == SWITCHED_OFF]
    assert [pair_of(stored, record) for record in off] == [pairs[-1]]
    assert not off[0].accepted


def test_a_proposal_finds_the_closure_again_and_joins_the_graph(stored: StoredGraph, basis: MatchedLog) -> None:
    configuration = Configuration()
    every = Edits(edit=tuple(edit("off", pair) for pair in closure_pairs(stored)))
    bare = close_with_edits(stored, every, configuration.pose_graph)
    assert not any(record.accepted for record in bare.records)
    row = int(stored.record_of[-1])
    record = stored.records[row]
    found = propose(bare.graph, basis.beams, record.source, record.target, configuration.loop_closure)
    assert found.reason == found.surprise == ""
    known = stored.closures.T_i_j[-1]
    np.testing.assert_allclose(found.T_target_source, known, atol=0.01)
    new = added(found, *pair_of(stored, record))
    np.testing.assert_allclose(pose_matrix(new.closure), found.T_target_source, atol=1e-15)  # type: ignore[arg-type]
    closed = close_with_edits(stored, every.model_copy(update={"edit": (*every.edit, new)}), configuration.pose_graph)
    assert closed.graph.constraints.kind[-1] == ConstraintKind.MANUAL
    assert [(r.kind, r.target, r.source) for r in closed.records if r.accepted] == [
        ("manual", record.target, record.source)
    ]
    assert closed.records[-1].sigmas_after < 3
    gone = every.model_copy(update={"edit": (*every.edit, new, edit("off", pair_of(stored, record)))})
    assert not any(r.accepted for r in close_with_edits(stored, gone, configuration.pose_graph).records)


def test_a_pair_that_sees_nothing_in_common_is_refused_with_its_reason(stored: StoredGraph, basis: MatchedLog) -> None:
    settings = Configuration().loop_closure
    xy = stored.graph.poses[:, :2, 2]
    far = int(np.argmax(np.linalg.norm(xy - xy[0], axis=1)))
    assert propose(stored.graph, basis.beams, 0, far, settings).reason
    for pair in ((3, 3), (3, 4)):
        with pytest.raises(InputError, match="neighbours"):
            propose(stored.graph, basis.beams, *pair, settings)
    with pytest.raises(InputError, match="there is no keyframe"):
        propose(stored.graph, basis.beams, 0, len(stored.graph), settings)


def test_edits_that_do_not_fit_the_run_are_named(stored: StoredGraph) -> None:
    pair = closure_pairs(stored)[0]
    with pytest.raises(InputError, match="edit 2: no closure joins scans"):
        resolve(stored, Edits(edit=(edit("off", pair), edit("off", (0, int(stored.graph.index[2]))))))
    with pytest.raises(InputError, match="edit 1: scans 0 and 987654 are not"):
        resolve(stored, Edits(edit=(edit("off", (0, 987654)),)))
    with pytest.raises(InputError, match="are not an older and a newer keyframe"):
        resolve(stored, Edits(edit=(edit("off", pair[::-1]),)))


def test_a_replay_gives_the_same_bytes_and_tells_of_its_edits(
    finished: Path, stored: StoredGraph, tmp_path: Path
) -> None:
    path = tmp_path / "edits.toml"
    write_edits(Edits(edit=(edit("off", closure_pairs(stored)[0]),)), path)
    folders = []
    for workers in (1, 2):
        plan = plan_run(finished, [], [], start="graph", edits=path, workers=workers)
        out = tmp_path / f"again{workers}"
        run(plan.log, plan.configuration, out=out, matching_of=plan.matching_of, edits=plan.edits)
        folders.append(out)
    for name in ("trajectory.tum", "graph.g2o", "loops.csv", "maps/map.npz", "metrics.json", "applied_edits.toml"):
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes(), name
    with (folders[0] / "loops.csv").open(newline="") as file:
        assert [row["accepted"] for row in csv.DictReader(file) if row["reason"] == SWITCHED_OFF] == ["false"]
    assert json.loads((folders[0] / "run.json").read_text())["edits"]["run"] == str(finished)
    assert not (folders[0] / "edits.toml").exists()
    assert (folders[0] / "applied_edits.toml").read_text() == path.read_text()
    again = read_stored_graph(read_run_directory(folders[0]))
    assert len(again.record_of) == len(stored.record_of) - 1


def test_edits_of_another_log_or_without_its_graph_are_refused(finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "edits.toml"
    path.write_text(f'log_sha256 = "{"0" * 64}"\n')
    plan = plan_run(finished, [], [], start="graph", edits=path)
    with pytest.raises(InputError, match="made for another log"):
        run(plan.log, plan.configuration, out=tmp_path / "x", matching_of=plan.matching_of, edits=plan.edits)
    assert not (tmp_path / "x").exists()
    for wrong in ({"start": None}, {"start": "matching"}, {"start": "graph", "no_loops": True}):
        with pytest.raises(ConfigurationError, match="--from graph"):
            plan_run(finished, [], [], edits=path, **wrong)


def test_a_run_that_was_edited_is_not_overwritten(finished: Path, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    (tmp_path / "edits.toml").write_text("")
    plan = plan_run(finished, [], [], start="graph")
    with pytest.raises(InputError, match="made by hand and would be lost"):
        run(plan.log, plan.configuration, out=tmp_path, overwrite=True)
