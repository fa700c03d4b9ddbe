"""CPU time of one factorisation of the normal equations: ours beside CHOLMOD's supernodal one.

    pip install --target FOLDER cvxopt
    PYTHONPATH=FOLDER python benchmarks/cholmod.py [--repeat 5]

cvxopt carries CHOLMOD and its OpenBLAS; it is GPL and no dependency of this project. Run with OPENBLAS_NUM_THREADS=1.
Prints nothing but a message where cvxopt is not installed. Writes benchmarks/results/cholmod.json and the table between
the markers of docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array

sys.path.insert(0, str(Path(__file__).resolve().parent))

from posegraph_slam.pose_graph.block_cholesky import factorize
from posegraph_slam.pose_graph.files import read_graph
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.linearization import NormalEquations, normal_equations
from posegraph_slam.pose_graph.sparse_solver import free_pattern
from simulated_graphs import cube, sphere, streets, torus

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "cholmod.json"
PAGE = ROOT / "docs" / "benchmarks.md"
BEGIN, END = "<!-- cholmod: begin -->", "<!-- cholmod: end -->"
REAL = ("intel", "manhattan", "smallGrid3D", "parking-garage", "sphere2500")
SIMULATED: dict[str, Callable[[], PoseGraph]] = {
    "streets 10000": lambda: streets(10000, 0.05, 0.03, 1),
    "torus 5000": lambda: torus(100, 50, 0.1, 0.15, 1),
    "sphere 15000": lambda: sphere(150, 100, 0.2, 0.05, 9),
    "cube 8000": lambda: cube(20, 0.1, 0.1, 1),
}
DAMPING = 1e-5


def lower_triangle(graph: PoseGraph, linear: NormalEquations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return values, rows and columns of the lower triangle of the free nodes' system, in scalars."""
    c, p = graph.constraints, graph.group.dof
    place = np.cumsum(~graph.fixed) - 1
    inner = ~(graph.fixed[c.i] | graph.fixed[c.j])
    i, j, off = place[c.i[inner]], place[c.j[inner]], linear.off_diagonal[inner]
    off = np.where((i > j)[:, None, None], off, np.swapaxes(off, 1, 2))
    own = np.arange(int((~graph.fixed).sum()))
    blocks = np.concatenate([linear.diagonal[~graph.fixed] + DAMPING * np.eye(p), off])
    rows, columns = np.concatenate([own, np.maximum(i, j)]), np.concatenate([own, np.minimum(i, j)])
    size = np.arange(p)
    entries = np.broadcast_to(rows[:, None, None] * p + size[:, None], blocks.shape).ravel()
    across = np.broadcast_to(columns[:, None, None] * p + size, blocks.shape).ravel()
    matrix = coo_array((blocks.ravel(), (entries, across)), shape=(len(own) * p,) * 2).tocsc().tocoo()
    below = matrix.row >= matrix.col
    return matrix.data[below], matrix.row[below], matrix.col[below]


def compare(name: str, graph: PoseGraph, cvxopt: Any, cholmod: Any, repeat: int) -> dict[str, Any]:
    """Factor the normal equations at the poses given, in turn."""
    linear = normal_equations(np.array(graph.poses), graph.constraints, np.ones(len(graph.constraints)))
    pattern = free_pattern(graph)
    values, rows, columns = lower_triangle(graph, linear)
    size = int(rows.max()) + 1
    matrix = cvxopt.spmatrix(values, rows.tolist(), columns.tolist(), (size, size))
    cholmod.options["supernodal"] = 2
    analysis = cholmod.symbolic(matrix)
    ours, theirs = [], []
    for _ in range(repeat):
        began = time.process_time()
        factor = factorize(pattern, linear.diagonal, linear.off_diagonal, DAMPING)
        middle = time.process_time()
        cholmod.numeric(matrix, analysis)
        ours.append(middle - began)
        theirs.append(time.process_time() - middle)
        assert factor is not None
    row = {"graph": name, "unknowns": size, "ours_s": min(ours), "cholmod_s": min(theirs)}
    print(json.dumps(row), flush=True)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5)
    arguments = parser.parse_args()
    try:
        cvxopt, cholmod = importlib.import_module("cvxopt"), importlib.import_module("cvxopt.cholmod")
    except ImportError:
        print("cvxopt is not installed: nothing to compare with")
        return
    data, graphs = os.environ.get("PSG_DATA"), {}
    if data:
        graphs = {name: (lambda name=name: read_graph(Path(data) / "g2o" / f"{name}.g2o")) for name in REAL}
    rows = [compare(name, make(), cvxopt, cholmod, arguments.repeat) for name, make in (graphs | SIMULATED).items()]
    lines = ["| graph | unknowns | ours [ms] | CHOLMOD, supernodal [ms] | ratio |", "|---|---|---|---|---|"]
    lines += [f"| {r['graph']} | {r['unknowns']} | {1e3 * r['ours_s']:.2f} | {1e3 * r['cholmod_s']:.2f} "
              f"| {r['ours_s'] / r['cholmod_s']:.2f} |" for r in rows]  # fmt: skip
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8")
    head, tail = page.split(BEGIN)[0], page.split(END)[1]
    PAGE.write_text(f"{head}{BEGIN}\n" + "\n".join(lines) + f"\n{END}{tail}", encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
