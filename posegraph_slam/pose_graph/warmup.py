"""Loading the compiled kernels before a clock starts, as a compiled program's are before its first instruction."""

from __future__ import annotations

import tempfile
from pathlib import Path

from posegraph_slam.pose_graph.files import read_graph
from posegraph_slam.pose_graph.optimum import OptimumSettings, find_optimum

PLANAR = """VERTEX_SE2 {0} {0} 0 0
EDGE_SE2 {0} {1} 1 0 1.25 1 0 0 1 0 1
"""
SPATIAL = """VERTEX_SE3:QUAT {0} {0} 0 0 0 0 0 1
EDGE_SE3:QUAT {0} {1} 1 0 0 0 0 0.585 0.811 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1
"""
"""Steps around a pentagon that nearly closes."""


def load_kernels(path: Path | str) -> None:
    """Read, solve and certify a small graph of the kind that the file at `path` holds, if it can be told.

    Kernels are compiled once (a minute after an installation) and then loaded from disk, a second a process.
    """
    try:
        with Path(path).open("rb") as file:
            spatial = b"3" in file.read(4096).split(b" ", 1)[0]
    except OSError:
        return
    record = SPATIAL if spatial else PLANAR
    with tempfile.TemporaryDirectory() as folder:
        small = Path(folder) / "graph.g2o"
        small.write_text("".join(record.format(k, (k + 1) % 5) for k in range(5)), encoding="utf-8")
        find_optimum(read_graph(small), OptimumSettings())
