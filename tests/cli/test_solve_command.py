"""`psg solve`: its files, its JSON, its errors."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from posegraph_slam.cli.application import app
from posegraph_slam.geometry import SE3, pose_from_xyt
from posegraph_slam.pose_graph.files import read_graph, write_graph
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.noise import information_from_sigmas
from posegraph_slam.pose_graph.optimum import find_optimum

KEYS = {"file", "poses", "edges", "init", "error_initial", "error", "iterations", "stop_reason", "certified",
        "chordal_cost", "lower_bound", "seconds"}  # fmt: skip


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(app, ["solve", *map(str, words)])


@pytest.fixture
def square() -> PoseGraph:
    """Twice around a square of 16 nodes, with noise, closed at every node of the second round."""
    rng, n = np.random.default_rng(0), 32
    corner = np.array([[0, 0], [4, 0], [4, 4], [0, 4]])
    side, along = (np.arange(n) // 4) % 4, np.arange(n) % 4
    heading = side * np.pi / 2
    step = np.column_stack([np.cos(heading), np.sin(heading)])
    poses = pose_from_xyt(np.column_stack([corner[side] + along[:, None] * step, heading]))
    i = np.concatenate([np.arange(n - 1), np.arange(16)])
    j = np.concatenate([np.arange(1, n), np.arange(16, 32)])
    exact = np.linalg.inv(poses[i]) @ poses[j]
    noise = pose_from_xyt(rng.normal(size=(len(i), 3)) * [0.02, 0.02, 0.01])
    kind = np.where(np.arange(len(i)) < n - 1, int(ConstraintKind.ODOMETRY), int(ConstraintKind.EXTERNAL))
    information = np.tile(information_from_sigmas([0.02, 0.02, 0.01]), (len(i), 1, 1))
    constraints = Constraints(i=i, j=j, T_i_j=exact @ noise, kind=kind, information=information)
    return PoseGraph(poses=poses, session=np.zeros(n, np.int64), index=np.arange(n), fixed=np.arange(n) == 0,
                     constraints=constraints)  # fmt: skip


@pytest.fixture
def file(square: PoseGraph, tmp_path: Path) -> Path:
    write_graph(square, tmp_path / "square.g2o")
    return tmp_path / "square.g2o"


def test_json_is_one_object_and_the_file_holds_the_solution(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "solved.g2o"
    result = run(file, "--json", "--out", out)
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert set(report) >= KEYS
    assert set(report["seconds"]) == {"read", "init", "solve", "certify", "write"}
    assert report["certified"] is True
    assert report["lower_bound"] <= report["chordal_cost"] <= report["lower_bound"] * (1 + 1e-6)
    assert (report["poses"], report["edges"]) == (32, 47)
    expected = find_optimum(read_graph(file))
    assert report["error"] == expected.error < report["error_initial"]
    np.testing.assert_allclose(read_graph(out).poses, expected.graph.poses, atol=1e-12)
    again = json.loads(run(out, "--json", "--no-certify").stdout)
    assert again["error"] == pytest.approx(report["error"], rel=1e-9)
    assert again["certified"] is False
    assert again["lower_bound"] is None


def test_a_false_loop_is_rejected_and_listed(file: Path, tmp_path: Path) -> None:
    rows, picture, out = tmp_path / "edges.csv", tmp_path / "graph.png", tmp_path / "out.g2o"
    edge = "2,10,0,0,0,0.02,0.02,0.01"
    result = run(file, "--add-edge", edge, "--robust", "auto", "--edges", rows, "--plot", picture, "--out", out)
    assert result.exit_code == 0, result.output
    with rows.open() as table:
        entries = list(csv.DictReader(table))
    assert list(entries[0]) == ["edge", "i", "j", "kind", "chi2", "weight", "kept"]
    assert (entries[-1]["i"], entries[-1]["j"], entries[-1]["kept"]) == ("2", "10", "0")
    assert float(entries[-1]["chi2"]) > 1000
    assert sum(int(e["kept"]) for e in entries) >= 45
    assert len(read_graph(out).constraints) == sum(int(e["kept"]) for e in entries)
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_covariances_and_edits(file: Path) -> None:
    report = json.loads(run(file, "--json", "--marginal", "5", "--relative", "3,9", "--drop-edge", "40",
                            "--drop-edge", "0,16").stdout)  # fmt: skip
    assert report["edges"] == 45
    covariance = np.array(report["marginals"][0]["covariance"])
    assert covariance.shape == (3, 3)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)
    assert np.all(np.linalg.eigvalsh(report["relative"][0]["covariance"]) > 0)
    assert json.loads(run(file, "--json", "--drop-kind", "external").stdout)["error"] < 1e-12


def test_parts_and_indefinite_information_are_named_and_repaired(file: Path) -> None:
    lines = file.read_text().splitlines()
    loose = [
        line for line in lines if not line.startswith("EDGE_SE2 30 31 ") and not line.startswith("EDGE_SE2 15 31 ")
    ]
    file.write_text("\n".join(loose) + "\n")
    result = run(file)
    assert result.exit_code == 2
    assert "node 31" in result.stderr
    assert "2 disconnected parts" in result.stderr
    assert json.loads(run(file, "--json", "--component", "largest").stdout)["poses"] == 31
    assert json.loads(run(file, "--json", "--component", "all").stdout)["poses"] == 32
    bad = [line.replace(" 2500.0 0.0 0.0", " -2500.0 0.0 0.0") if line.startswith("EDGE_SE2 4 5 ") else line
           for line in lines]  # fmt: skip
    assert bad != lines
    file.write_text("\n".join(bad) + "\n")
    result = run(file)
    assert result.exit_code == 2
    assert "edge 4 (node 4 to node 5)" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    repaired = json.loads(run(file, "--json", "--clamp").stdout)
    assert "edge 4" in repaired["notes"][0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--robust", "magic"], "magic"),
        (["--component", "some"], "largest or all"),
        (["--drop-edge", "900"], "no edge 900"),
        (["--drop-edge", "a,b"], "no list of numbers"),
        (["--drop-kind", "x"], "odometry"),
        (["--add-edge", "1,2,3"], "2 ids, 3 of the pose, 3 deviations"),
        (["--marginal", "77"], "no node 77"),
        (["--init", "luck"], "luck"),
        (["--out", "x.txt"], "x.txt"),
    ],
)
def test_errors_are_one_line(file: Path, words: list[str], message: str) -> None:
    result = run(file, *words)
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_a_bad_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.g2o"
    path.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0\n")
    result = run(path)
    assert result.exit_code == 2
    assert "bad.g2o:3" in result.stderr
    assert "expected" in result.stderr


def test_an_edge_in_space_takes_a_quaternion(tmp_path: Path) -> None:
    n, path = 4, tmp_path / "space.g2o"
    i = np.arange(n - 1)
    T, information = SE3.exp(np.tile([0.0, 0, 0.1, 1, 0, 0], (n - 1, 1))), np.tile(np.eye(6), (n - 1, 1, 1))
    constraints = Constraints(i=i, j=i + 1, T_i_j=T, information=information, kind=np.zeros(n - 1, np.int64))
    write_graph(PoseGraph(poses=SE3.identity(n), session=np.zeros(n, np.int64), index=np.arange(n),
                          fixed=np.arange(n) == 0, constraints=constraints), path)  # fmt: skip
    result = run(path, "--json", "--add-edge", "0,3,3,0,0,0,0,0,1,1,1,1,0.1,0.1,0.1")
    report = json.loads(result.stdout)
    assert report["edges"] == 4
    assert report["certified"]


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("--add-edge", "nan,1,0,0,0,1,1,1"), "--add-edge: .* holds a number that is not finite"),
        (("--add-edge", "0,1,inf,0,0,1,1,1"), "--add-edge: .* holds a number that is not finite"),
        (("--add-edge", "0,1.5,0,0,0,1,1,1"), "--add-edge: .* does not begin with the ids of two nodes"),
        (("--marginal", "99"), "it has no node 99"),
        (("--relative", f"0,{10**30}"), "it has no node 10{30}"),
    ],
)
def test_requests_that_cannot_be_met_leave_no_file(
    file: Path, tmp_path: Path, words: tuple[str, ...], problem: str
) -> None:
    result = run(file, "--no-certify", "--init", "given", "--out", tmp_path / "out.g2o", *words)
    assert result.exit_code == 2
    assert re.search(problem, result.stderr)
    assert not (tmp_path / "out.g2o").exists()
