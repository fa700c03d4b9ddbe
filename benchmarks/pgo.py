"""CPU time from a graph file to its solution: ours beside GTSAM's own reader and LM, on the same start.

    python benchmarks/pgo.py [--quick] [--repeat 3]

Both run in one process on one file, in turn, and the least of the repeats counts; kernels are loaded before. GTSAM
runs in C++ (readG2o, optimize) with its default parameters and with our tolerance. Then growth, on drives through
streets to 100 000 poses, the speed of reading, and graphs that are hard for their start. Times are those of the
processor, which other processes disturb less. Writes benchmarks/results/pgo.json and the tables between the markers of
docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import gtsam

from posegraph_slam.pose_graph.files import read_graph, write_graph
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.optimum import find_optimum
from posegraph_slam.pose_graph.solve import graph_cost, solve
from posegraph_slam.pose_graph.solver_settings import SolverKind, SolverSettings
from posegraph_slam.pose_graph.starts import Start, starting_poses
from simulated_graphs import cube, sphere, streets, torus

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "pgo.json"
PAGE = ROOT / "docs" / "benchmarks.md"
BEGIN, END = "<!-- pgo: begin -->", "<!-- pgo: end -->"
REAL = ("intel", "manhattan", "smallGrid3D", "parking-garage", "sphere2500")
SIMULATED: dict[str, Callable[[], PoseGraph]] = {
    "streets 3500": lambda: streets(3500, 0.05, 0.03, 1),
    "streets 10000": lambda: streets(10000, 0.05, 0.03, 1),
    "sphere 2200, noisy": lambda: sphere(50, 44, 0.3, 0.1, 1),
    "torus 5000": lambda: torus(100, 50, 0.1, 0.15, 1),
    "cube 1728": lambda: cube(12, 0.1, 0.1, 1),
}
HARD: dict[str, Callable[[], PoseGraph]] = {
    "corridors 808, noisy turns": lambda: streets(808, 0.1, 0.15, 4, side=40, loop_share=0.05),
    "corridors 2000, noisy turns": lambda: streets(2000, 0.1, 0.1, 5, side=40, loop_share=0.05),
    "streets 15000": lambda: streets(15000, 0.05, 0.05, 11),
    "sphere 2200, very noisy": lambda: sphere(50, 44, 0.3, 0.2, 1),
    "torus 5000": lambda: torus(100, 50, 0.1, 0.05, 2),
    "cube 8000": lambda: cube(20, 0.1, 0.1, 1),
    "sphere 15000": lambda: sphere(150, 100, 0.2, 0.05, 9),
}
READ_POSES = 55_000
PLAIN_ITERATIONS = 30
"""Steps from odometry of a graph that is hard for it, to compare with."""
GROWTH = (12500, 25000, 50000, 100000)


def gtsam_run(path: Path, spatial: bool, tolerance: float | None) -> tuple[float, float, float]:
    """Read and solve in C++; return seconds to read, to solve, and the cost."""
    began = time.process_time()
    graph, initial = gtsam.readG2o(str(path), spatial)
    read = time.process_time()
    first = min(initial.keys())
    if spatial:
        graph.add(gtsam.PriorFactorPose3(first, initial.atPose3(first), gtsam.noiseModel.Isotropic.Variance(6, 1e-6)))
    else:
        graph.add(gtsam.PriorFactorPose2(first, initial.atPose2(first), gtsam.noiseModel.Isotropic.Variance(3, 1e-6)))
    parameters = gtsam.LevenbergMarquardtParams()
    if tolerance is not None:
        parameters.setRelativeErrorTol(tolerance)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial, parameters)
    optimizer.optimize()
    return read - began, time.process_time() - read, optimizer.error()


def our_run(path: Path) -> tuple[float, float, float]:
    """Read, check and solve with our own solver; the same three numbers."""
    began = time.process_time()
    graph = read_graph(path)
    read = time.process_time()
    result = solve(graph, SolverSettings(kind=SolverKind.SPARSE))
    return read - began, time.process_time() - read, result.cost


def compare(name: str, path: Path, repeat: int) -> dict[str, Any]:
    """Measure one file."""
    graph = read_graph(path)
    spatial = graph.group.dimension == 3
    our_run(path)
    runs: dict[str, list[tuple[float, float, float]]] = {"ours": [], "gtsam": [], "gtsam_same": []}
    for _ in range(repeat):
        runs["ours"].append(our_run(path))
        runs["gtsam"].append(gtsam_run(path, spatial, None))
        runs["gtsam_same"].append(gtsam_run(path, spatial, 1e-9))
    best = {key: min(values, key=lambda v: v[0] + v[1]) for key, values in runs.items()}
    total = {key: value[0] + value[1] for key, value in best.items()}
    began = time.process_time()
    optimum = find_optimum(graph)
    certified = optimum.certificate is not None and optimum.certificate.holds
    row = {"graph": name, "dimension": graph.group.dimension, "poses": len(graph), "edges": len(graph.constraints),
           "cost_start": graph_cost(graph), "cost": best["ours"][2], "cost_gtsam": best["gtsam"][2],
           "read_s": best["ours"][0], "solve_s": best["ours"][1], "gtsam_read_s": best["gtsam"][0],
           "gtsam_solve_s": best["gtsam"][1], "ratio": total["ours"] / total["gtsam"],
           "ratio_same": total["ours"] / total["gtsam_same"], "best_cost": optimum.error,
           "certified": certified, "default_s": time.process_time() - began}  # fmt: skip
    print(json.dumps(row), flush=True)
    return row


def peak_mib() -> float:
    """Return the most memory this process held; unlike ru_maxrss, without what its parent held when it was started."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def grow(count: int) -> dict[str, Any]:
    """Solve a drive of `count` poses; meant for a process of its own, whose peak memory counts."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "streets.g2o"
        graph = streets(count, 0.05, 0.01, 1)
        write_graph(graph.with_poses(starting_poses(graph, Start.CHORDAL)[0]), path)
        our_run(path)
        read_s, solve_s, cost = our_run(path)
        graph = read_graph(path)
        began = time.process_time()
        optimum = find_optimum(graph)
        default_s = time.process_time() - began
    assert optimum.certificate is not None
    return {"poses": count, "edges": len(graph.constraints), "read_s": read_s, "solve_s": solve_s, "cost": cost,
            "default_s": default_s, "certified": optimum.certificate.holds, "peak_mib": peak_mib()}  # fmt: skip


def hard(name: str) -> dict[str, Any]:
    """Solve a graph with default options, and by Levenberg-Marquardt from odometry; for a process of its own."""
    graph = HARD[name]()
    find_optimum(HARD["corridors 808, noisy turns"]() if graph.group.dimension == 2 else sphere(10, 10, 0.1, 0.1, 1))
    plain = solve(graph, SolverSettings(kind=SolverKind.SPARSE, max_iterations=PLAIN_ITERATIONS, retry=False))
    began = time.process_time()
    optimum = find_optimum(graph)
    seconds, certificate = time.process_time() - began, optimum.certificate
    assert certificate is not None
    return {"graph": name, "poses": len(graph), "edges": len(graph.constraints), "odometry_cost": plain.cost,
            "start": optimum.start.value, "cost": optimum.error, "status": certificate.status.value,
            "gap": certificate.gap, "default_s": seconds,
            "peak_mib": peak_mib()}  # fmt: skip


def read_speed(repeat: int) -> dict[str, Any]:
    """Read a large file in space, full information and 17 digits a number, with both readers."""
    graph = sphere(READ_POSES // 100, 100, 0.1, 0.1, 1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.g2o"
        write_graph(graph, path)
        read_graph(path)
        ours, theirs = [], []
        for _ in range(repeat):
            began = time.process_time()
            read_graph(path)
            middle = time.process_time()
            gtsam.readG2o(str(path), True)
            ours.append(middle - began)
            theirs.append(time.process_time() - middle)
        size = path.stat().st_size / 2**20
    return {"edges": len(graph.constraints), "mib": size, "read_s": min(ours), "gtsam_read_s": min(theirs)}


def alone(option: str, value: str) -> dict[str, Any]:
    """Run this script with one option in a process of its own and return what it prints."""
    done = subprocess.run([sys.executable, __file__, option, value], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    print(done.stdout.strip(), flush=True)
    return dict(json.loads(done.stdout))


def other_tables(large: dict[str, Any], hard_rows: Sequence[dict[str, Any]]) -> str:
    """Return what reading takes, and the table of graphs that are hard for their start."""
    lines = [
        f"A file of {large['edges']} edges in space ({large['mib']:.0f} MiB) is read in {large['read_s']:.2f} s, "
        f"by GTSAM in {large['gtsam_read_s']:.2f} s.",
        "",
        "Graphs whose odometry leads elsewhere, or that are large; default options, everything included:",
        "",
    ]
    header = ["graph", "poses, edges", "LM from odometry", "default options", "start", "status", "gap", "CPU [s]",
              "peak memory [MiB]"]  # fmt: skip
    lines += ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += [
        f"| {r['graph']} | {r['poses']}, {r['edges']} | {r['odometry_cost']:.6g} | {r['cost']:.9g} "
        f"| {r['start']} | {r['status']} | {r['gap']:.0e} | {r['default_s']:.1f} | {r['peak_mib']:.0f} |"
        for r in hard_rows
    ]
    return "\n".join(lines)


def tables(rows: Sequence[dict[str, Any]], growth: Sequence[dict[str, Any]]) -> str:
    """Return both tables as Markdown."""
    header = ["graph", "poses, edges", "cost at the start", "cost", "ours: read + solve [s]",
              "GTSAM: read + solve [s]", "ratio", "ratio, same tolerance", "default options", "certified"]  # fmt: skip
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += [f"| {r['graph']} | {r['poses']}, {r['edges']} | {r['cost_start']:.6g} | {r['cost']:.9g} "
              f"| {r['read_s']:.3f} + {r['solve_s']:.3f} | {r['gtsam_read_s']:.3f} + {r['gtsam_solve_s']:.3f} "
              f"| {r['ratio']:.2f} | {r['ratio_same']:.2f} | {r['best_cost']:.9g} in {r['default_s']:.2f} s "
              f"| {'yes' if r['certified'] else 'no'} |" for r in rows]  # fmt: skip
    if growth:
        header = ["poses", "edges", "read [s]", "solve [s]", "default options [s]", "certified", "peak memory [MiB]"]
        lines += ["", "| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
        lines += [f"| {r['poses']} | {r['edges']} | {r['read_s']:.2f} | {r['solve_s']:.2f} | {r['default_s']:.2f} "
                  f"| {'yes' if r['certified'] else 'no'} | {r['peak_mib']:.0f} |" for r in growth]  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="the real graphs only, nothing is written")
    parser.add_argument("--grow", type=int, help="one drive of so many poses, as JSON (used by itself)")
    parser.add_argument("--hard", choices=list(HARD), help="one graph that is hard, as JSON (used by itself)")
    arguments = parser.parse_args()
    if arguments.grow or arguments.hard:
        print(json.dumps(grow(arguments.grow) if arguments.grow else hard(arguments.hard)))
        return
    rows, data = [], os.environ.get("PSG_DATA")
    if data:
        rows = [compare(name, Path(data) / "g2o" / f"{name}.g2o", arguments.repeat) for name in REAL]
    if arguments.quick:
        print(tables(rows, []))
        return
    with tempfile.TemporaryDirectory() as folder:
        for name, make in SIMULATED.items():
            path, graph = Path(folder) / f"{name.replace(' ', '_')}.g2o", make()
            write_graph(graph.with_poses(starting_poses(graph, Start.CHORDAL)[0]), path)
            rows.append(compare(name, path, arguments.repeat))
    growth = [alone("--grow", str(count)) for count in GROWTH]
    large, hard_rows = read_speed(arguments.repeat), [alone("--hard", name) for name in HARD]
    text = tables(rows, growth) + "\n\n" + other_tables(large, hard_rows)
    report = {"files": rows, "growth": growth, "read": large, "hard": hard_rows}
    RESULTS.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8")
    head, tail = page.split(BEGIN)[0], page.split(END)[1]
    PAGE.write_text(f"{head}{BEGIN}\n{text}\n{END}{tail}", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
