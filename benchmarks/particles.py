"""Speed of the particle filters, and accuracy of particle-filter SLAM.

    PSG_DATA=folder python benchmarks/particles.py [--parts speed,slam]

Writes benchmarks/results/particles.json; `localization.py` measures localisation in a known map.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.datasets import read
from posegraph_slam.evaluation.summary import evaluate_trajectory
from posegraph_slam.files import replacing
from posegraph_slam.geometry import Trajectory, planar_from_spatial
from posegraph_slam.localization.beam_model import add_log_likelihoods
from posegraph_slam.localization.free_space import draw_scan_by_polygon
from posegraph_slam.localization.particle_slam import particle_slam
from posegraph_slam.localization.slam_map import draw_scan, empty_map
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.odometry.scan_odometry import odometry_at_scans
from posegraph_slam.sensors import RobotLog

RESULT = Path(__file__).parent / "results" / "particles.json"


def milliseconds(function: Callable[[int], Any], count: int) -> dict[str, float]:
    """Return median and 95th percentile of the CPU time of `function(k)`, k in range(count), the first call apart."""
    function(0)
    times = []
    for k in range(count):
        started = time.process_time()
        function(k)
        times.append(1e3 * (time.process_time() - started))
    return {"median_ms": round(float(np.median(times)), 4), "p95_ms": round(float(np.percentile(times, 95)), 4)}


def speed(data: Path) -> dict[str, Any]:
    """Time the parts of one step on scans of 1081 beams and a map of 1001 x 1001 cells."""
    log = read(data / "ece276a" / "20")
    assert log.scans is not None
    scans, settings = log.scans, ParticleSlamSettings()
    mounting = planar_from_spatial(scans.T_base_lidar)
    sensor = mounting[:2, 2].copy()
    points = [scans.points(k) @ mounting[:2, :2].T + sensor for k in range(200)]
    geometry = GridGeometry.square(1001 * 0.05, resolution_m=0.05)
    results: dict[str, Any] = {"beams_with_return": round(float(np.mean([len(p) for p in points])))}
    for name, draw in (("rays", draw_scan), ("polygon", draw_scan_by_polygon)):
        slam_map = empty_map(geometry, settings)
        results[f"map_a_scan_{name}"] = milliseconds(
            lambda k, draw=draw, slam_map=slam_map: draw(slam_map, points[k], np.zeros(3), sensor), 200
        )
    odometry = odometry_at_scans(log)
    first = np.arange(1500)
    for weighting in ("likelihood_field", "window_correlation", "cell_counts"):
        every = settings.model_copy(update={"weighting": weighting, "update_distance_m": 0.0, "update_turn_rad": 0.0})
        particle_slam(scans.select(first[:20]), odometry.trajectory.select(first[:20]), every, rng=generator(0))
        times = []
        for _ in range(3):
            started = time.process_time()
            particle_slam(scans.select(first), odometry.trajectory.select(first), every, rng=generator(0))
            times.append(1e3 * (time.process_time() - started) / len(first))
        results[f"slam_a_scan_{weighting}_ms"] = round(min(times), 3)
    table = np.zeros(geometry.shape, dtype=np.float32)
    particles, weights = np.zeros((100, 3)) + 25.0, np.zeros(100)
    results["likelihood_100_particles_100_points"] = milliseconds(
        lambda k: add_log_likelihoods(particles, points[k][::11].copy(), table, 0.0, 0.05, 0.1, weights), 200
    )
    for count, maps in ((100, "best"), (10000, "best"), (100, "per_particle")):
        many = settings.model_copy(update={"particles": count, "maps": maps})
        run = particle_slam(scans.select(first[:200]), odometry.trajectory.select(first[:200]), many, rng=generator(0))
        results[f"map_memory_{count}_particles_{maps}_mib"] = round(run.map_bytes / 2**20, 1)
    return results


def generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def slam(data: Path) -> dict[str, Any]:
    """Particle-filter SLAM on ece276a/20 with five seeds for each variant: position RMSE after alignment."""
    log = read(data / "ece276a" / "20")
    assert log.scans is not None
    odometry = odometry_at_scans(log)
    variants: dict[str, dict[str, Any]] = {
        "likelihood_field, rays": {},
        "likelihood_field, polygon": {"free_cells": "polygon"},
        "window_correlation, rays": {"weighting": "window_correlation"},
        "cell_counts, rays": {"weighting": "cell_counts"},
        "cell_counts, polygon": {"weighting": "cell_counts", "free_cells": "polygon"},
        "30 particles, one map": {"particles": 30},
        "30 particles, a map each": {"particles": 30, "maps": "per_particle"},
    }
    results: dict[str, Any] = {}
    for name, changes in variants.items():
        settings = ParticleSlamSettings(**changes)
        errors, seconds, memory = [], [], []
        for seed in range(5):
            started = time.process_time()
            result = particle_slam(log.scans, odometry.trajectory, settings, rng=generator(seed))
            seconds.append(time.process_time() - started)
            errors.append(rmse(result.trajectory, log))
            memory.append(result.map_bytes / 2**20)
        results[name] = {
            "rmse_m": [round(e, 4) for e in errors],
            "mean_m": round(float(np.mean(errors)), 4),
            "std_m": round(float(np.std(errors)), 4),
            "cpu_s": round(min(seconds), 2),
            "map_mib": round(float(np.max(memory)), 1),
        }
        print(name, results[name], flush=True)
    results["odometry_rmse_m"] = round(rmse(odometry.trajectory, log), 4)
    return results


def rmse(trajectory: Trajectory, log: RobotLog) -> float:
    ape = evaluate_trajectory(trajectory, truth=log.truth).ape
    assert ape is not None
    return float(ape.translation_m.rmse)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--parts", default="speed,slam")
    arguments = parser.parse_args()
    data = Path(os.environ.get("PSG_DATA", "") or sys.exit("set PSG_DATA to the folder of logs"))
    results = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    for part in arguments.parts.split(","):
        results[part] = {"speed": speed, "slam": slam}[part](data)
        print(part, json.dumps(results[part], indent=1), flush=True)
        with replacing(RESULT) as temporary:
            temporary.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
