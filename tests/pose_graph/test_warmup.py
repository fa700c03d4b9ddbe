from __future__ import annotations

from pathlib import Path

import pytest

from posegraph_slam.pose_graph import warmup


@pytest.mark.parametrize(("record", "spatial"), [("VERTEX_SE2", False), ("EDGE_SE3:QUAT", True), ("VERTEX3", True)])
def test_kernels_are_loaded_for_the_kind_of_graph(
    record: str, spatial: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    solve = warmup.find_optimum
    monkeypatch.setattr(warmup, "find_optimum", lambda graph, settings: seen.append(solve(graph, settings)))
    path = tmp_path / "some.graph"
    path.write_text(f"{record} 1 2 3\n")
    warmup.load_kernels(path)
    assert [optimum.graph.group.dimension == 3 for optimum in seen] == [spatial]
    assert all(optimum.certificate.holds for optimum in seen)


def test_a_file_that_is_not_there_loads_nothing(tmp_path: Path) -> None:
    warmup.load_kernels(tmp_path / "absent.g2o")
