"""Known optima of standard graphs: GTSAM's error, half of chi-square, with the first pose held."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest

from posegraph_slam.pose_graph.g2o import read_g2o, write_g2o
from posegraph_slam.pose_graph.gtsam_solver import from_values
from posegraph_slam.pose_graph.solve import graph_cost, solve

OPTIMA = {
    "manhattan": 1774.5205,
    "intel": 22.5021,
    "sphere2500": 675.70096,
    "parking-garage": 0.6341924,
    "smallGrid3D": 517.92533,
}


@pytest.mark.data
@pytest.mark.parametrize("name", OPTIMA)
def test_reference_optimum(psg_data: Path, name: str) -> None:
    graph = read_g2o(psg_data / "g2o" / f"{name}.g2o")
    result = solve(graph)
    digits = len(str(OPTIMA[name]).split(".")[1])
    assert result.converged
    assert not result.notes
    assert result.cost == pytest.approx(OPTIMA[name], rel=1e-7, abs=0.6 * 10**-digits)


@pytest.mark.data
@pytest.mark.parametrize("name", ["manhattan", "intel", "smallGrid3D"])
def test_files_read_like_gtsam(psg_data: Path, tmp_path: Path, name: str) -> None:
    path = psg_data / "g2o" / f"{name}.g2o"
    graph = read_g2o(path)
    factors, values = gtsam.readG2o(str(path), graph.group.dimension == 3)
    np.testing.assert_allclose(from_values(values, graph.group.matrix_size), graph.poses, atol=1e-12)
    assert graph_cost(graph) == pytest.approx(factors.error(values), rel=1e-12)
    write_g2o(graph, tmp_path / "again.g2o")
    again = read_g2o(tmp_path / "again.g2o")
    np.testing.assert_array_equal(again.constraints.information, graph.constraints.information)
    assert graph_cost(again) == pytest.approx(graph_cost(graph), rel=1e-9)
