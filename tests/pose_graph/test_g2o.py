from __future__ import annotations

import time
from pathlib import Path

import gtsam
import numpy as np
import pytest

from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE2, SE3, Group
from posegraph_slam.pose_graph.checks import check_graph
from posegraph_slam.pose_graph.g2o import read_g2o, write_g2o
from posegraph_slam.pose_graph.graph import ConstraintKind, PoseGraph
from posegraph_slam.pose_graph.graph_file import node_ids
from posegraph_slam.pose_graph.gtsam_solver import from_values
from posegraph_slam.pose_graph.solve import graph_cost

SQUARE = """\
# a square with one loop, ids with gaps
VERTEX_SE2 10 0 0 0
VERTEX_SE2 20 1 0 1.5707963267948966

VERTEX_SE2 30 1 1 3.141592653589793
VERTEX_SE2 11 0 1 -1.5707963267948966
EDGE_SE2 10 20 1 0 1.5707963267948966 1 2e-1 0 3 0.5 7
EDGE_SE2 20 30 1 0 1.5707963267948966 1 0 0 1 0 1
EDGE_SE2 30 11\t1 0 1.5707963267948966 1 0 0 1 0 1
EDGE_SE2 11 10 1.1 0 1.5707963267948966 1 0 0 1 0 1
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "graph.g2o"
    path.write_text(text)
    return path


def test_a_small_file_is_read_as_written(tmp_path: Path) -> None:
    graph = read_g2o(written(tmp_path, SQUARE + "FIX 20 30\n"))
    c = graph.constraints
    check_graph(graph)
    assert graph.index.tolist() == [10, 20, 30, 11]
    assert graph.session.tolist() == [0] * 4
    assert graph.fixed.tolist() == [False, True, True, False]
    assert (c.i.tolist(), c.j.tolist()) == ([0, 1, 2, 3], [1, 2, 3, 0])
    np.testing.assert_array_equal(c.information[0], [[1, 0.2, 0], [0.2, 3, 0.5], [0, 0.5, 7]])
    np.testing.assert_allclose(c.T_i_j[3], [[0, -1, 1.1], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    external, odometry = int(ConstraintKind.EXTERNAL), int(ConstraintKind.ODOMETRY)
    assert c.kind.tolist() == [external, odometry, external, odometry]


def test_the_first_node_is_fixed_by_default_and_missing_vertices_come_from_edges(tmp_path: Path) -> None:
    edges = "\n".join(line for line in SQUARE.splitlines() if not line.startswith("VERTEX"))
    graph, full = read_g2o(written(tmp_path, edges)), read_g2o(written(tmp_path, SQUARE))
    assert graph.index.tolist() == [10, 11, 20, 30]
    assert graph.fixed.tolist() == [True, False, False, False]
    np.testing.assert_allclose(graph.poses[[0, 2, 3, 1]], full.poses, atol=1e-12)


def test_missing_vertices_are_reached_against_the_order_of_the_file(tmp_path: Path) -> None:
    lines = [f"EDGE_SE2 {k} {k - 1} 1 0 0.1 1 0 0 1 0 1" for k in range(30, 0, -1)]
    graph = read_g2o(
        written(tmp_path, "VERTEX_SE2 0 5 6 0.3\n" + "\n".join(reversed(lines)) + "\nEDGE_SE2 77 78 1 0 0 1 0 0 1 0 1")
    )
    assert graph_cost(graph) == pytest.approx(0, abs=1e-18)
    np.testing.assert_allclose(graph.poses[0, :2, 2], [5, 6])
    np.testing.assert_array_equal(graph.poses[31], np.eye(3))  # a part of its own starts at the identity


def test_round_trip_restores_every_digit(graph: PoseGraph, tmp_path: Path) -> None:
    motion = graph.group.exp(np.linspace(-1, 2, graph.group.dof))
    poses = motion @ graph.poses
    poses[:, :-1, -1] *= 1e5 / 3  # kilometres: six digits would lose millimetres
    graph = PoseGraph(
        poses=poses,
        session=np.arange(len(graph)) % 3,
        index=np.arange(len(graph)) * 7,
        fixed=np.isin(np.arange(len(graph)), [2, 5]),
        constraints=graph.constraints,
    )
    path = tmp_path / "graph.g2o"
    write_g2o(graph, path)
    again = read_g2o(path)
    for name in ("session", "index", "fixed"):
        np.testing.assert_array_equal(getattr(again, name), getattr(graph, name))
    a, b = again.constraints, graph.constraints
    for name in ("i", "j", "information"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(a.T_i_j[:, :-1, -1], b.T_i_j[:, :-1, -1])
    np.testing.assert_array_equal(again.poses[:, :-1, -1], graph.poses[:, :-1, -1])
    np.testing.assert_allclose(a.T_i_j, b.T_i_j, atol=1e-15)
    np.testing.assert_allclose(again.poses, graph.poses, atol=1e-15)
    assert [p.name for p in tmp_path.iterdir()] == ["graph.g2o"]


def test_large_ids_of_other_programs_survive(tmp_path: Path) -> None:
    text = SQUARE.replace("10", "8646911284551352330")  # GTSAM's symbol x10
    path = written(tmp_path, text.replace("# ", "#"))
    graph = read_g2o(path)
    assert node_ids(graph)[0] == 8646911284551352330
    write_g2o(graph, path)
    np.testing.assert_array_equal(node_ids(read_g2o(path)), node_ids(graph))


def test_gtsam_reads_our_files_alike(graph: PoseGraph, group: Group, tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    write_g2o(graph, path)
    factors, values = gtsam.readG2o(str(path), group is SE3)
    assert factors.size() == len(graph.constraints)
    np.testing.assert_allclose(from_values(values, group.matrix_size), graph.poses, atol=1e-14)
    assert factors.error(values) == pytest.approx(graph_cost(graph), rel=1e-9)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("LANDMARK_XY 5 1 2", r"graph.g2o:11: unknown record 'LANDMARK_XY'; known: VERTEX_SE2"),
        ("EDGE_SE2 10 20 1 0 0 1 0 0 1 0", r"graph.g2o:11: EDGE_SE2 has 10 values; expected 2 ids and 9 numbers"),
        ("EDGE_SE2 10 20 1 0 0 1 0 0 1 0 1 5", r"graph.g2o:11: EDGE_SE2 has 12 values"),
        ("EDGE_SE2 10 20 1 0 0 1 0 0 1 0 1 5\nEDGE_SE2 10 20 1 0 0 1 0 0 1 0", r"graph.g2o:11: EDGE_SE2 has 12 values"),
        ("EDGE_SE2 10 20 1 0 0 1 zero 0 1 0 1", r"graph.g2o:11: value 7 of EDGE_SE2 is 'zero'; expected a finite"),
        ("EDGE_SE2 10 20 1 0 0 1 nan 0 1 0 1", r"graph.g2o:11: value 7 of EDGE_SE2 is 'nan'; expected a finite"),
        ("EDGE_SE2 10 20 1 0 inf 1 0 0 1 0 1", r"graph.g2o:11: value 5 of EDGE_SE2 is 'inf'"),
        ("EDGE_SE2 1.5 20 1 0 0 1 0 0 1 0 1", r"graph.g2o:11: value 1 of EDGE_SE2 is '1.5'; expected a node id"),
        ("EDGE_SE2 -1 20 1 0 0 1 0 0 1 0 1", r"graph.g2o:11: value 1 of EDGE_SE2 is '-1'; expected a node id"),
        ("EDGE_SE2 20 20 1 0 0 1 0 0 1 0 1", r"graph.g2o:11: edge joins node 20 to itself"),
        ("EDGE_SE2", r"graph.g2o:11: EDGE_SE2 has 0 values"),
        ("VERTEX_SE2 20 0 0 0", r"graph.g2o:11: node 20 is given twice"),
        ("FIX 12", r"graph.g2o:11: FIX names node 12, which is not there"),
        ("FIX x", r"graph.g2o:11: value 1 of FIX is 'x'"),
        ("VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1", "mixes planar and spatial"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_g2o(written(tmp_path, SQUARE + line + "\n"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no pose and no edge"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1.1\n", r"graph.g2o:1: quaternion has length 1.1"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_g2o(written(tmp_path, text))
    with pytest.raises(InputError, match="cannot be read"):
        read_g2o(tmp_path / "absent.g2o")
    (tmp_path / "binary.g2o").write_bytes(bytes(range(128, 256)))
    with pytest.raises(InputError, match="cannot be read"):
        read_g2o(tmp_path / "binary.g2o")


def test_reading_is_fast(tmp_path: Path) -> None:
    count = 20_000  # a fifth of the edges that must take less than a second on an idle machine
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(count, 3))
    lines = [
        f"EDGE_SE2 {k} {k + 1} {x!r} {y!r} {t!r} 44.63 -7.96 0.1 376.5 0.2 9745.79"
        for k, (x, y, t) in enumerate(rows.tolist())
    ]
    path = written(tmp_path, "\n".join(lines))
    read_g2o(path)
    start = time.process_time()
    graph = read_g2o(path)
    assert time.process_time() - start < 0.6
    assert len(graph.constraints) == count
    assert graph.group is SE2
