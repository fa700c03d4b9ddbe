"""What each part of the 2D pipeline buys: every variant on every log, accuracy and time.

    python benchmarks/ablation.py [--logs NAME ...] [--variants NAME ...] [--out FILE.json]

Real logs are scored by their relations or their true trajectory, simulated ones also by their false closures. A
variant is the default configuration with the keys named in `VARIANTS`. Times are CPU seconds of `optimize` without
maps, after a run that compiles.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets import read
from posegraph_slam.evaluation.ape import absolute_pose_error
from posegraph_slam.evaluation.relations import relation_errors
from posegraph_slam.pipeline.configuration import load_configuration
from posegraph_slam.pipeline.executors import open_executor
from posegraph_slam.pipeline.optimize import OptimizationResult, optimize
from posegraph_slam.sensors import RobotLog

from logs import build
from slam2d import replace_text, write_between_markers
from stress import false_closures

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PAGE = ROOT / "benchmarks/results/ablation.json", ROOT / "docs/benchmarks.md"
BEGIN, END = "<!-- ablation: begin -->", "<!-- ablation: end -->"

REAL = {"intel": "carmen/intel.clf", "fr079": "carmen/fr079.clf", "ece276a/20": "ece276a/20"}
SIMULATED = {
    "corridors": ("corridor_loop", 1.0, 1),
    "twin wings": ("twins_drift", 1.0, 3),
    "hall": ("hall", 1.0, 1),
    "crowd": ("hall_30m", 1.0, 1),
    "slow sweep": ("sweep", 1.0, 1),
}

VARIANTS: dict[str, tuple[str, ...]] = {
    "default": (),
    "front end: scan to scan": ("scan_matching.matcher=scan_to_scan",),
    "front end: one reference": ("scan_matching.references=1",),
    "front end: references in a row": ("scan_matching.reference_stride=1",),
    "front end: no window search": ("scan_matching.matched_fraction_min=0",),
    "clocks not compared": ("timing.estimate=false",),
    "no odometry": ("odometry.source=none",),
    "no loop closure": ("loop_closure.enabled=false",),
    "loops: fixed interval only": ("loop_closure.proposals.proximity=false",),
    "loops: no gate in sigmas": ("loop_closure.verification.sigma_max=1000",),
    "loops: no shared drift": (
        "loop_closure.verification.drift.heading_sigma_rad_per_m=1e-9",
        "loop_closure.verification.drift.turn_scale_sigma=1e-9",
    ),
    "loops: no rival test": ("loop_closure.verification.search.rival_share=1.0",),
    "loops: no free-space test": ("loop_closure.verification.agreement_min=0",),
    "loops: no robust loss": ("pose_graph.robust.loss=none",),
    "no refinement": ("refinement.rounds=0",),
    "refinement: three rounds": ("refinement.rounds=3",),
    "refinement: passers-by kept": ("refinement.seen_through_min=0",),
    "no smoothing": ("smoothing=false",),
}


def load(name: str) -> tuple[RobotLog, FloatArray | None]:
    """Return a log by its name in the table, and the true planar poses of a simulated one."""
    if name in REAL:
        return read(Path(os.environ["PSG_DATA"]) / REAL[name]), None
    recipe, size, seed = SIMULATED[name]
    simulated = build(recipe, size=size, seed=seed)
    return simulated.robot_log(), simulated.truth().poses


def measure(log: RobotLog, truth: FloatArray | None, overrides: Sequence[str]) -> dict[str, Any]:
    """Run one variant on one log."""
    configuration = load_configuration(overrides=["maps=false", *overrides], workers=2)
    started = time.process_time()
    with open_executor(2) as executor:
        result = optimize(log, configuration, executor=executor)
    row: dict[str, Any] = {"cpu_s": round(time.process_time() - started, 2), **score(log, result)}
    if truth is not None:
        row["false_closures"] = len(false_closures(result, truth)[0])
    return row


def score(log: RobotLog, result: OptimizationResult) -> dict[str, float]:
    """Mean error of the relations where they are known, else the RMSE of the absolute position."""
    if log.truth is not None:
        error = absolute_pose_error(result.trajectory, log.truth)
        return {"position_m": round(error.translation_m.rmse, 4), "rotation_deg": round(error.rotation_deg.mean, 3)}
    assert log.relations is not None
    relations = relation_errors(result.trajectory, log.relations).all
    return {
        "position_m": round(relations.translation_m.mean, 4),
        "rotation_deg": round(relations.rotation_deg.mean, 3),
    }


def table(rows: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Return the Markdown table: a row a variant, a column a log."""
    logs = list(next(iter(rows.values())))
    lines = [
        "Error in m and degrees (mean over the relations of intel and fr079, RMSE and mean of the absolute error "
        "elsewhere), CPU seconds, and false closures (F) of the simulated logs.",
        "",
        "| variant | " + " | ".join(logs) + " |",
        "|" + "---|" * (len(logs) + 1),
    ]
    for variant, cells in rows.items():
        texts = []
        for cell in cells.values():
            wrong = f", F {cell['false_closures']}" if "false_closures" in cell else ""
            texts.append(f"{cell['position_m']:.4f} / {cell['rotation_deg']:.2f}, {cell['cpu_s']:.1f} s{wrong}")
        lines.append(f"| {variant} | " + " | ".join(texts) + " |")
    return "\n".join(lines)


def main() -> None:
    """Measure the chosen variants on the chosen logs, print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", nargs="+", choices=[*REAL, *SIMULATED], help="all by default")
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), help="all by default")
    parser.add_argument("--out", type=Path, help="JSON file; default: the committed one, for the whole table")
    arguments = parser.parse_args()
    if "PSG_DATA" not in os.environ:
        raise SystemExit("ablation.py needs the real logs: set PSG_DATA to their folder")
    rows: dict[str, dict[str, dict[str, Any]]] = {variant: {} for variant in arguments.variants or VARIANTS}
    for name in arguments.logs or [*REAL, *SIMULATED]:
        log, truth = load(name)
        measure(log, truth, ())
        for variant, cells in rows.items():
            cells[name] = measure(log, truth, VARIANTS[variant])
            print(f"{name}: {variant}: {cells[name]}", file=sys.stderr, flush=True)
    text = table(rows)
    print(text)
    official = not (arguments.logs or arguments.variants)
    if arguments.out or official:
        replace_text(arguments.out or RESULTS, json.dumps(rows, indent=1) + "\n")
    if official:
        write_between_markers(PAGE, BEGIN, END, text)


if __name__ == "__main__":
    main()
