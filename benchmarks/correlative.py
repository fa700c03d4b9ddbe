"""Speed and accuracy of correlative matching against a map of hit counts, on the ECE276A run.

    PSG_DATA=folder python benchmarks/correlative.py [--repeats 5]

Every scan of the run, all 1081 beams, is matched in two stages (175 and 225 poses) to the map that grew from the scans
before it, and counted into it. Time is CPU time of one core with kernels loaded, the least of the repeats. Writes
benchmarks/results/correlative.json and the table between the markers in docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.datasets import read
from posegraph_slam.evaluation.ape import absolute_pose_error
from posegraph_slam.geometry import Trajectory
from posegraph_slam.odometry import OdometryEstimate, odometry_at_scans
from posegraph_slam.odometry.hit_map_tracking import track_on_hits
from posegraph_slam.registration.beam_scans import BeamScans, BeamScanSettings, prepare_beam_scans
from posegraph_slam.registration.hit_map_matching import HitMapSettings

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PAGE = ROOT / "benchmarks" / "results" / "correlative.json", ROOT / "docs" / "benchmarks.md"
BEGIN, END = "<!-- correlative: begin -->", "<!-- correlative: end -->"
SIZE_M = 60.0
REPORTED_HZ = 40.0
VARIANTS = {
    "as reported": HitMapSettings(),
    "without the prior": HitMapSettings(prior_weight=0.0),
    "cells of 0.1 m": HitMapSettings(resolution_m=0.1),
}


def measure(
    scans: BeamScans, odometry: OdometryEstimate, truth: Trajectory, settings: HitMapSettings, repeats: int
) -> dict[str, Any]:
    """Match all scans some times and compare the path with the truth."""
    seconds = []
    for _ in range(repeats):
        started = time.process_time()
        poses, share = track_on_hits(scans, odometry, settings, SIZE_M)
        seconds.append(time.process_time() - started)
    error = absolute_pose_error(odometry.trajectory.with_poses(poses), truth)
    return {
        "scans": len(scans),
        "points_mean": float((scans.kind > 0).sum(axis=1).mean()),
        "cpu_s": min(seconds),
        "matches_per_cpu_s": len(scans) / min(seconds),
        "rmse_m": error.translation_m.rmse,
        "rmse_deg": error.rotation_deg.rmse,
        "share_on_hits": float(share.mean()),
    }


def table(rows: dict[str, dict[str, Any]], odometry_m: float) -> str:
    """Write one line a variant."""
    lines = [
        "| map | matches a CPU second | times the report's 40 | ms a match | RMSE [m] | RMSE [deg] |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        rate = row["matches_per_cpu_s"]
        lines.append(
            f"| {name} | {rate:.0f} | {rate / REPORTED_HZ:.0f} | {1000 / rate:.2f} | {row['rmse_m']:.3f} "
            f"| {row['rmse_deg']:.2f} |"
        )
    lines.append(f"\nOdometry alone: {odometry_m:.3f} m.")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    folder = os.environ.get("PSG_DATA")
    if not folder:
        print("set PSG_DATA to the folder of real logs", file=sys.stderr)
        return 2
    log = read(Path(folder) / "ece276a" / "20")
    assert log.scans is not None
    assert log.truth is not None
    scans, odometry = prepare_beam_scans(log.scans, BeamScanSettings(range_max_m=40.0)), odometry_at_scans(log)
    track_on_hits(prepare_beam_scans(log.scans.select(np.arange(5)), BeamScanSettings()), odometry.part(slice(0, 5)),
                  HitMapSettings(), SIZE_M)  # fmt: skip
    rows = {name: measure(scans, odometry, log.truth, each, arguments.repeats) for name, each in VARIANTS.items()}
    alone = absolute_pose_error(odometry.trajectory, log.truth).translation_m.rmse
    text = table(rows, alone)
    print(text)
    RESULTS.write_text(json.dumps({"variants": rows, "odometry_rmse_m": alone}, indent=1) + "\n", encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8")
    head, tail = page.split(BEGIN)[0], page.split(END)[1]
    PAGE.write_text(f"{head}{BEGIN}\n{text}\n{END}{tail}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
