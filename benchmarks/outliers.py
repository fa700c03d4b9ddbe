"""Robustness of pose-graph solving to false loops: `robust auto` beside plain and Huber Levenberg-Marquardt.

    python benchmarks/outliers.py [--seeds 5] [--shares 0.1 0.5 1] [--graphs intel manhattan] [--workers 1]

Adds false loops of three kinds to the g2o files of PSG_DATA, starts from odometry, and compares with the optimum
without them: position RMSE, and precision and recall of the loops kept. Times are of the processor. Writes
benchmarks/results/outliers.json, case by case, and the table between the markers of docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from false_loops import Kind, add_false_loops
from posegraph_slam.pose_graph.files import read_graph
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.outliers import OutlierMethod, OutlierSettings, classify_loops
from posegraph_slam.pose_graph.robust import RobustLoss, RobustSettings
from posegraph_slam.pose_graph.solve import solve
from posegraph_slam.pose_graph.solver_settings import SolverSettings
from posegraph_slam.pose_graph.starts import Start, starting_poses

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "outliers.json"
PAGE = ROOT / "docs" / "benchmarks.md"
BEGIN, END = "<!-- outliers: begin -->", "<!-- outliers: end -->"
LIMIT_M = {"intel": 0.05, "manhattan": 0.5}
PEER_ITERATIONS = 30


def rmse(poses: np.ndarray, truth: np.ndarray) -> float:
    d = poses.shape[-1] - 1
    return float(np.sqrt(np.mean(np.sum((poses[:, :d, d] - truth[:, :d, d]) ** 2, axis=1))))


def measure(task: tuple[str, str, str, float, int, bool]) -> dict[str, Any]:
    """Run one case: folder, graph, kind, share, seed, whether plain LM and Huber run too."""
    folder, name, kind, share, seed, peers = task
    clean = read_graph(Path(folder) / f"{name}.g2o")
    clean = clean.with_poses(starting_poses(clean, Start.CHORDAL)[0])
    truth = solve(clean).poses
    graph = add_false_loops(clean, Kind(kind), share, np.random.default_rng(seed))
    graph = graph.with_poses(starting_poses(graph, Start.ODOMETRY)[0])
    began = time.process_time()
    found = classify_loops(graph, OutlierSettings(method=OutlierMethod.AUTO))
    kept = graph.with_constraints(graph.constraints.select(found.kept)).with_poses(found.poses)
    poses = solve(kept).poses
    seconds = time.process_time() - began
    is_loop = graph.constraints.is_loop
    true = is_loop & (np.arange(len(is_loop)) < len(clean.constraints))
    chosen = found.kept & is_loop
    row = {"graph": name, "kind": kind, "share": share, "seed": seed, "winner": found.winner, "seconds": seconds,
           "rmse_m": rmse(poses, truth), "precision": float((chosen & true).sum() / max(chosen.sum(), 1)),
           "recall": float((chosen & true).sum() / true.sum())}  # fmt: skip
    return row | ({f"{loss}_m": peer(graph, truth, loss) for loss in ("none", "huber")} if peers else {})


def peer(graph: PoseGraph, truth: np.ndarray, loss: str) -> float:
    settings = SolverSettings(robust=RobustSettings(loss=RobustLoss(loss)), max_iterations=PEER_ITERATIONS, retry=False)
    return rmse(solve(graph, settings).poses, truth)


def passed(row: dict[str, Any]) -> bool:
    return bool(row["rmse_m"] <= LIMIT_M[row["graph"]] and row["precision"] >= 0.99 and row["recall"] >= 0.9)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line a graph, kind and share: the worst of the seeds for ours, the medians of the others."""
    header = ["graph", "false loops", "share", "RMSE, median [m]", "worst [m]", "precision, least", "recall, least",
              "passed", "CPU [s]", "plain LM [m]", "Huber [m]"]  # fmt: skip
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for key in dict.fromkeys((r["graph"], r["kind"], r["share"]) for r in rows):
        cases = [r for r in rows if (r["graph"], r["kind"], r["share"]) == key]
        errors = [r["rmse_m"] for r in cases]
        peers = [median([r[p] for r in cases if p in r]) for p in ("none_m", "huber_m")]
        lines.append(
            f"| {key[0]} | {key[1]} | {100 * key[2]:.0f} % | {np.median(errors):.3f} | {max(errors):.3f} "
            f"| {min(r['precision'] for r in cases):.4f} | {min(r['recall'] for r in cases):.3f} "
            f"| {sum(map(passed, cases))} of {len(cases)} | {np.median([r['seconds'] for r in cases]):.1f} "
            f"| {peers[0]} | {peers[1]} |"
        )
    total = sum(map(passed, rows))
    lines.append(f"\n{total} of {len(rows)} runs ({100 * total / len(rows):.0f} %) meet the limits "
                 "(0.05 m on intel, 0.5 m on manhattan; precision 0.99, recall 0.9).")  # fmt: skip
    return "\n".join(lines)


def median(values: Sequence[float]) -> str:
    return f"{np.median(values):.1f}" if values else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--shares", type=float, nargs="+", default=[0.1, 0.5, 1.0])
    parser.add_argument("--graphs", nargs="+", default=list(LIMIT_M))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--peer-seeds", type=int, default=1, help="seeds on which plain LM and Huber run too")
    arguments = parser.parse_args()
    data = os.environ.get("PSG_DATA")
    if not data:
        print("PSG_DATA is not set: nothing to measure")
        return
    tasks = [(str(Path(data) / "g2o"), graph, kind.value, share, seed, seed < arguments.peer_seeds)
             for graph in arguments.graphs for share in arguments.shares for kind in Kind
             for seed in range(arguments.seeds)]  # fmt: skip
    complete = vars(arguments) | {"workers": 1} == vars(parser.parse_args([]))
    rows = []
    with ProcessPoolExecutor(arguments.workers) as pool:
        for row in pool.map(measure, tasks):
            rows.append(row)
            print(json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}), flush=True)
            if complete:
                RESULTS.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    print(table(rows))
    if complete:
        text = PAGE.read_text(encoding="utf-8")
        head, tail = text.split(BEGIN)[0], text.split(END)[1]
        PAGE.write_text(f"{head}{BEGIN}\n{table(rows)}\n{END}{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
