"""Run `optimize` on simulated logs, each with a fault of public ones, and compare with their truth.

    python benchmarks/stress.py [NAME ...] [--size 1] [--seed 1] [--set a.b=value] [--out FILE.json]

Each log runs in a process of its own. Columns: errors of position (m, RMSE after rigid alignment) of odometry, scan
matching and the optimised trajectory; mean error of far relations; scans at which scan matching slips; closures
proposed, accepted, false among them (off by more than 0.3 m or 3 degrees, and by five of its own
sigmas: along a corridor a closure need not know where it is); revisited places that have a closure.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.datasets import read
from posegraph_slam.geometry import SE2, Trajectory
from posegraph_slam.pipeline.configuration import load_configuration
from posegraph_slam.pipeline.optimize import OptimizationResult, optimize
from posegraph_slam.pipeline.run_record import peak_memory_mib
from posegraph_slam.pose_graph.graph import ConstraintKind

from logs import RECIPES, build

FALSE_M, FALSE_RAD, FALSE_SIGMAS = 0.3, np.deg2rad(3.0), 5.0
"""A closure is false when it is off by more than one of the first two, and claims to be five times better than that."""
SLIP_M, SLIP_RAD = 0.15, np.deg2rad(4.0)
"""A step of scan matching that is off by more than this is a slip."""


def false_closures(result: OptimizationResult, true_poses: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the constraints (rows) of the graph that are false closures, and the error (C, 3) of every closure.

    `true_poses` (N, 3, 3) of all scans. Scan matching between neighbours does not count as closure.
    """
    constraints = result.graph.constraints
    rows = np.flatnonzero(constraints.kind != int(ConstraintKind.SCAN_MATCHING))
    error = closure_errors(result, true_poses, rows)
    far = (np.hypot(error[:, 0], error[:, 1]) > FALSE_M) | (np.abs(error[:, 2]) > FALSE_RAD)
    return rows[far & (own_sigmas(result, rows, error) > FALSE_SIGMAS)], error


def own_sigmas(result: OptimizationResult, rows: IntArray, error: FloatArray) -> FloatArray:
    """Return the length (M,) of errors (M, 3) of the constraints `rows`, in these constraints' own sigmas."""
    return np.asarray(np.sqrt(np.einsum("mi,mij,mj->m", error, result.graph.constraints.information[rows], error)))


def closure_errors(result: OptimizationResult, true_poses: FloatArray, rows: IntArray) -> FloatArray:
    """Return how far the constraints `rows` are from the truth: (M, 3) in the tangent at the true motion."""
    constraints, scan = result.graph.constraints, result.graph.index
    true = SE2.between(true_poses[scan[constraints.i[rows]]], true_poses[scan[constraints.j[rows]]])
    return SE2.local(true, constraints.T_i_j[rows])


def slips(trajectory: Trajectory, true_poses: FloatArray) -> IntArray:
    """Return the scans (S,) whose step from the scan before is far from the true step."""
    step = SE2.between(trajectory.poses[:-1], trajectory.poses[1:])
    error = SE2.local(SE2.between(true_poses[:-1], true_poses[1:]), step)
    return np.flatnonzero((np.hypot(error[:, 0], error[:, 1]) > SLIP_M) | (np.abs(error[:, 2]) > SLIP_RAD)) + 1


def revisits(result: OptimizationResult, true_poses: FloatArray) -> tuple[int, int]:
    """Count the stretches of 2 m that lie within 1 m of an older one, and those of them that a closure touches.

    A closure counts when its newer end is on the stretch and its older end is at least 10 m of travel before.
    """
    xy, scan = true_poses[:, :2, 2], result.graph.index
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    at = np.flatnonzero(np.diff(np.floor(path_m / 0.5), prepend=-1.0) > 0)
    pairs = np.sort(at[cKDTree(xy[at]).query_pairs(1.0, output_type="ndarray")], axis=1)
    pairs = pairs[path_m[pairs[:, 1]] - path_m[pairs[:, 0]] > 10.0]
    again = set(np.floor(path_m[pairs[:, 1]] / 2.0).astype(int).tolist())
    c = result.graph.constraints
    rows = np.flatnonzero(c.kind != int(ConstraintKind.SCAN_MATCHING))
    older, newer = path_m[scan[c.i[rows]]], path_m[scan[c.j[rows]]]
    closed = set(np.floor(newer[newer - older > 10.0] / 2.0).astype(int).tolist())
    return len(again), len(again & closed)


def run_one(name: str, size: float, seed: int, overrides: Sequence[str], folder: Path | None) -> dict[str, Any]:
    """Simulate a log, optimise it, and return what came of it; with a folder the log goes through its files."""
    floor = peak_memory_mib()
    simulated = build(name, size=size, seed=seed)
    log = read(simulated.write(folder)) if folder else simulated.robot_log()
    true_poses = simulated.truth().poses
    configuration = load_configuration([], list(overrides))
    started, cpu = time.perf_counter(), time.process_time()
    result = optimize(log, configuration)
    wall, cpu = time.perf_counter() - started, time.process_time() - cpu
    false, error = false_closures(result, true_poses)
    slipped = slips(result.stages["scan matching"], true_poses)
    again, closed = revisits(result, true_poses)
    stages = result.metrics["stages"]
    return {
        "log": name,
        "size": size,
        "seed": seed,
        "scans": len(true_poses),
        "ape_m": {stage: round(stages[stage]["ape"]["translation_m"]["rmse"], 4) for stage in stages},
        "far_m": {stage: _mean(stages[stage]["relations"]["far"]["translation_m"]) for stage in stages},
        "near_m": {stage: _mean(stages[stage]["relations"]["near"]["translation_m"]) for stage in stages},
        "slips": len(slipped),
        "first_slips": slipped[:5].tolist(),
        "proposed": len(result.loops),
        "accepted": sum(record.accepted for record in result.loops),
        "false": len(false),
        "false_pairs": [_describe(result, row, true_poses) for row in false[:5]],
        "false_by_kind": dict(Counter(_kind(result, row) for row in false)),
        "closure_rmse_m": round(float(np.sqrt(np.mean(error[:, :2] ** 2 * 2))), 4) if len(error) else None,
        "revisits": again,
        "revisits_closed": closed,
        "wall_s": round(wall, 2),
        "cpu_s": round(cpu, 2),
        "stages_s": {stage: round(seconds, 2) for stage, seconds in result.stages_s.items()},
        "peak_mib": round(peak_memory_mib(), 1),
        "floor_mib": round(floor, 1),
        "log_mib": round(simulated.ranges_m.nbytes / 2**20, 1),
        "remarks": list(result.remarks),
    }


def _mean(statistics: dict[str, float] | None) -> float | None:
    return None if statistics is None else round(statistics["mean"], 4)


def _kind(result: OptimizationResult, row: int) -> str:
    return ConstraintKind(int(result.graph.constraints.kind[row])).name.lower()


def _describe(result: OptimizationResult, row: int, true_poses: FloatArray) -> str:
    c, scan = result.graph.constraints, result.graph.index
    off = closure_errors(result, true_poses, np.array([row]))[0]
    kind = _kind(result, row)
    i, j = int(c.i[row]), int(c.j[row])
    return (
        f"{kind} keyframes {i}-{j} (scans {scan[i]}-{scan[j]}) off by {np.hypot(off[0], off[1]):.2f} m, "
        f"{np.degrees(abs(off[2])):.1f} deg, {own_sigmas(result, np.array([row]), off[None])[0]:.0f} sigmas"
    )


def row(report: dict[str, Any]) -> str:
    """One line of the table."""
    if "error" in report:
        return f"{report['log']:16s} FAILED: {report['error']}"
    ape, far = report["ape_m"], report["far_m"]
    return (
        f"{report['log']:16s} {report['scans']:6d} ape {ape['odometry']:7.3f} {ape['scan matching']:7.3f} "
        f"{ape['optimised']:7.3f}  far {far['optimised'] or float('nan'):7.4f}  slips {report['slips']:4d}  loops "
        f"{report['proposed']:5d} {report['accepted']:4d} false {report['false']:3d}  revisits "
        f"{report['revisits_closed']:4d}/{report['revisits']:<4d} {report['wall_s']:6.1f} s "
        f"{report['scans'] / report['wall_s']:6.0f}/s {report['peak_mib']:6.0f} MiB"
    )


def main() -> None:
    """Run the named logs, or all, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(RECIPES)}")
    parser.add_argument("--size", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a configuration key")
    parser.add_argument("--files", type=Path, help="write the logs here and read them back")
    parser.add_argument("--out", type=Path, help="write all results as JSON")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(run_one(arguments.names[0], arguments.size, arguments.seed, arguments.set, arguments.files)))
        return
    reports = []
    shared = ["--size", str(arguments.size), "--seed", str(arguments.seed)]
    shared += [word for override in arguments.set for word in ("--set", override)]
    shared += ["--files", str(arguments.files)] if arguments.files else []
    for name in arguments.names or RECIPES:
        command = [sys.executable, __file__, name, "--one", *shared]
        done = subprocess.run(command, capture_output=True, text=True)
        lines = done.stderr.strip().splitlines() or ["no message"]
        report = json.loads(done.stdout) if done.returncode == 0 else {"log": name, "error": lines[-1]}
        reports.append(report)
        print(row(report), flush=True)
        if report.get("false"):
            print(f"{'':16s} false by kind: {report['false_by_kind']}", flush=True)
        for pair in report.get("false_pairs", []):
            print(f"{'':16s} false: {pair}", flush=True)
    if arguments.out:
        arguments.out.write_text(json.dumps(reports, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
