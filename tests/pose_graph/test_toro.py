from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest

from posegraph_slam.errors import InputError
from posegraph_slam.pose_graph.files import read_graph, write_graph
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.gtsam_solver import from_values
from posegraph_slam.pose_graph.solve import graph_cost
from posegraph_slam.pose_graph.toro import read_toro

PLANAR = """\
VERTEX2 0 0 0 0
VERTEX2 1 1 0 0.5
EDGE2 0 1 1.1 0.2 0.4 11 12 22 33 13 23
"""


def test_the_order_of_edge2_is_known(tmp_path: Path) -> None:
    path = tmp_path / "a.graph"
    path.write_text(PLANAR)
    graph = read_graph(path)
    np.testing.assert_array_equal(graph.constraints.information[0], [[11, 12, 13], [12, 22, 23], [13, 23, 33]])
    factors, values = gtsam.load2D(str(path), None, 0, False, False, gtsam.NoiseFormat.NoiseFormatTORO,
                                   gtsam.KernelFunctionType.KernelFunctionTypeNONE)  # fmt: skip
    assert graph_cost(graph) == pytest.approx(factors.error(values))


def test_roll_pitch_and_yaw_are_gtsams(tmp_path: Path) -> None:
    path = tmp_path / "a.graph"
    upper = " ".join(str(float(k + 1)) for k in range(21))
    path.write_text(f"VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 1 2 3 0.1 -0.7 2.5\nEDGE3 0 1 1 2 3 0.1 -0.7 2.5 {upper}\n")
    graph = read_graph(path)
    _, values = gtsam.load3D(str(path))
    np.testing.assert_allclose(graph.poses, from_values(values, 4), atol=1e-12)
    np.testing.assert_allclose(graph.constraints.T_i_j[0], graph.poses[1], atol=1e-15)
    information = graph.constraints.information[0]
    assert (information[3, 3], information[3, 4], information[3, 0], information[0, 0]) == (1, 2, 4, 16)


def test_round_trip_and_conversion(graph: PoseGraph, tmp_path: Path) -> None:
    for name in ("a.graph", "b.toro", "c.g2o"):
        write_graph(graph, tmp_path / name)
        again = read_graph(tmp_path / name)
        np.testing.assert_array_equal(again.constraints.information, graph.constraints.information)
        np.testing.assert_array_equal(again.constraints.i, graph.constraints.i)
        np.testing.assert_array_equal(again.fixed, graph.fixed)
        np.testing.assert_allclose(again.poses, graph.poses, atol=1e-13)
        np.testing.assert_allclose(again.constraints.T_i_j, graph.constraints.T_i_j, atol=1e-13)


def test_what_cannot_be_written_is_refused(graph: PoseGraph, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown kind of pose-graph file"):
        write_graph(graph, tmp_path / "graph.txt")
    other = PoseGraph(
        poses=graph.poses,
        session=graph.session,
        index=graph.index,
        fixed=np.arange(len(graph)) == 3,
        constraints=graph.constraints,
    )
    with pytest.raises(InputError, match="cannot say which nodes are fixed"):
        write_graph(other, tmp_path / "graph.toro")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PLANAR + "EDGE2 0 1 1 2\n", r"a.graph:4: EDGE2 has 4 values; expected 2 ids and 9 numbers"),
        (PLANAR + "VERTEX3 7 0 0 0 0 0 0\n", "mixes planar and spatial"),
        (PLANAR + "VERTEX_SE2 7 0 0 0\n", r"a.graph:4: unknown record 'VERTEX_SE2'; known: VERTEX2"),
        ("", "no pose and no edge"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.graph"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_toro(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_graph(tmp_path / "absent.graph")
