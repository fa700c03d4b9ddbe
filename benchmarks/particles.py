"""Speed and accuracy of the particle filters.

    PSG_DATA=folder python benchmarks/particles.py [--runs FOLDER] [--parts speed,slam,localization]

Writes benchmarks/results/particles.json. Localisation needs the optimised trajectories of carmen/intel and
carmen/fr079: they are taken from FOLDER/intel and FOLDER/fr079 (run directories of `psg optimize`) or computed. The
map is drawn from the first half of the scans, and the second half is localised in it; errors are distances to the
optimised trajectory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.datasets import read
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.evaluation.summary import evaluate_trajectory
from posegraph_slam.files import replacing
from posegraph_slam.geometry import SE2, Trajectory, planar_from_spatial, wrap_angle, xyt_from_pose
from posegraph_slam.localization.beam_model import add_log_likelihoods
from posegraph_slam.localization.free_space import draw_scan_by_polygon
from posegraph_slam.localization.health import Health
from posegraph_slam.localization.known_map import LocalizationResult, PreparedMap, localize, prepare_map
from posegraph_slam.localization.particle_slam import particle_slam
from posegraph_slam.localization.slam_map import draw_scan, empty_map
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid, build_occupancy
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.scan_matching import match_scans
from posegraph_slam.odometry.scan_odometry import odometry_at_scans
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.optimize import optimize
from posegraph_slam.registration.beam_scans import BeamScans, prepare_beam_scans
from posegraph_slam.sensors import RobotLog

RESULT = Path(__file__).parent / "results" / "particles.json"
CONFIGURATION = Configuration()
START_WINDOW_S, STARTS, PIECES = 60.0, 20, 4


def milliseconds(function: Callable[[int], Any], count: int) -> dict[str, float]:
    """Return median and 95th percentile of the time of `function(k)` over k in range(count), the first call apart."""
    function(0)
    times = []
    for k in range(count):
        started = time.perf_counter()
        function(k)
        times.append(1e3 * (time.perf_counter() - started))
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
        started = time.perf_counter()
        particle_slam(scans.select(first[:20]), odometry.trajectory.select(first[:20]), every, rng=generator(0))
        started = time.perf_counter()
        particle_slam(scans.select(first), odometry.trajectory.select(first), every, rng=generator(0))
        results[f"slam_a_scan_{weighting}_ms"] = round(1e3 * (time.perf_counter() - started) / len(first), 3)
    table = np.zeros(geometry.shape, dtype=np.float32)
    particles, weights = np.zeros((100, 3)) + 25.0, np.zeros(100)
    results["likelihood_100_particles_100_points"] = milliseconds(
        lambda k: add_log_likelihoods(particles, points[k][::11].copy(), table, 0.0, 0.05, 0.1, weights), 200
    )
    for count in (100, 10000):
        many = settings.model_copy(update={"particles": count})
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        particle_slam(scans.select(first[:200]), odometry.trajectory.select(first[:200]), many, rng=generator(0))
        after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        results[f"memory_added_by_{count}_particles_mib"] = round((after - before) / 1024, 1)
    return results


def generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def slam(data: Path) -> dict[str, Any]:
    """Particle-filter SLAM on ece276a/20 with five seeds for each weighting: position RMSE after alignment."""
    log = read(data / "ece276a" / "20")
    assert log.scans is not None
    odometry = odometry_at_scans(log)
    results: dict[str, Any] = {}
    for weighting in ("likelihood_field", "window_correlation", "cell_counts"):
        for free_cells in ("rays", "polygon") if weighting == "likelihood_field" else ("rays",):
            settings = ParticleSlamSettings(weighting=weighting, free_cells=free_cells)
            errors = []
            for seed in range(5):
                result = particle_slam(log.scans, odometry.trajectory, settings, rng=generator(seed))
                errors.append(rmse(result.trajectory, log))
            results[f"{weighting}, {free_cells}"] = {
                "rmse_m": [round(e, 4) for e in errors],
                "mean_m": round(float(np.mean(errors)), 4),
                "std_m": round(float(np.std(errors)), 4),
            }
    results["odometry_rmse_m"] = round(rmse(odometry.trajectory, log), 4)
    return results


def rmse(trajectory: Trajectory, log: RobotLog) -> float:
    ape = evaluate_trajectory(trajectory, truth=log.truth).ape
    assert ape is not None
    return float(ape.translation_m.rmse)


class SecondHalf:
    """The second half of a log, the map of its first half, and the optimised poses."""

    def __init__(self, data: Path, name: str, runs: Path | None) -> None:
        log = read(data / "carmen" / f"{name}.clf")
        assert log.scans is not None
        assert log.scan_odometry is not None
        poses = optimised(log, None if runs is None else runs / name)
        count = len(log.scans)
        first, second = np.arange(count // 2), np.arange(count // 2, count)
        self.grid = drawn(log, poses, first)
        self.log = replace(log, scans=log.scans.select(second), scan_odometry=log.scan_odometry.select(second))
        assert self.log.scans is not None
        self.truth = poses[second]
        self.stamps = self.log.scans.stamps_s
        self.odometry = odometry_at_scans(self.log, CONFIGURATION.odometry)
        self.beams = prepare_beam_scans(self.log.scans, CONFIGURATION.scans)
        self.known: PreparedMap = prepare_map(self.grid, CONFIGURATION.localization)

    def spliced(self, parts: list[IntArray]) -> tuple[IntArray, BeamScans, Trajectory]:
        """Return the scans of the parts, one after the other, with odometry that does not know of the jumps."""
        index, poses, here = np.concatenate(parts), [], np.eye(3)
        for part in parts:
            logged = self.odometry.trajectory.poses[part]
            poses.append(here @ SE2.between(np.broadcast_to(logged[0], logged.shape), logged))
            here = poses[-1][-1]
        path = Trajectory(stamps_s=self.stamps[index], poses=np.concatenate(poses), parent="odom", child="base")
        steps = np.minimum(index[:-1], len(self.odometry.covariance) - 1)
        estimate = OdometryEstimate(trajectory=path, covariance=self.odometry.covariance[steps], source="logged")
        beams = self.beams.select(index)
        return index, beams, match_scans(beams, estimate, CONFIGURATION.scan_matching).trajectory

    def run(self, beams: BeamScans, motion: Trajectory, seed: int, start: FloatArray | None) -> LocalizationResult:
        return localize(self.known, beams, motion, CONFIGURATION.localization, rng=generator(seed), start=start)

    def errors(self, result: LocalizationResult, index: IntArray) -> FloatArray:
        return np.linalg.norm(result.trajectory.positions - self.truth[index, :2, 2], axis=1)


def optimised(log: RobotLog, run: Path | None) -> FloatArray:
    """Optimised poses (N, 3, 3) of all scans in recorded order."""
    if run is None:
        return np.asarray(optimize(log, CONFIGURATION).trajectory.poses)
    assert log.scans is not None
    stored = read_tum(run / "trajectory.tum", parent="map", child="base")
    poses = np.empty((len(stored), 3, 3))
    poses[np.argsort(log.scans.stamps_s, kind="stable")] = planar_from_spatial(stored.poses)
    return poses


def drawn(log: RobotLog, poses: FloatArray, index: IntArray) -> OccupancyGrid:
    """The map of the scans at `index`."""
    assert log.scans is not None
    path = Trajectory(stamps_s=log.scans.stamps_s[index], poses=poses[index], parent="map", child="base")
    return build_occupancy(log.scans.select(index), path, CONFIGURATION.mapping)


def tracking(half: SecondHalf) -> dict[str, Any]:
    """Track the whole second half from its first pose, with three seeds."""
    everything = np.arange(len(half.beams))
    index, beams, motion = half.spliced([everything])
    runs = []
    for seed in range(3):
        started = time.perf_counter()
        result = half.run(beams, motion, seed, xyt_from_pose(half.truth[0]))
        seconds = time.perf_counter() - started
        error = half.errors(result, index)
        turn = np.abs(wrap_angle(xyt_from_pose(result.trajectory.poses)[:, 2] - xyt_from_pose(half.truth)[:, 2]))
        tangent = SE2.log(SE2.between(result.trajectory.poses, half.truth))
        nees = np.einsum("ni,nij,nj->n", tangent, np.linalg.inv(result.covariance), tangent)
        runs.append(
            {
                "median_m": round(float(np.median(error)), 4),
                "p99_m": round(float(np.percentile(error, 99)), 4),
                "max_m": round(float(error.max()), 4),
                "share_within_0.2_m": round(float((error <= 0.2).mean()), 4),
                "median_deg": round(float(np.rad2deg(np.median(turn))), 3),
                "p99_deg": round(float(np.rad2deg(np.percentile(turn, 99))), 3),
                "nees_median": round(float(np.median(nees)), 2),
                "nees_mean": round(float(nees.mean()), 2),
                "ok_share": round(float((result.health == Health.OK).mean()), 4),
                "mean_particles": round(float(result.particles.mean())),
                "ms_a_scan": round(1e3 * seconds / len(index), 3),
            }
        )
    return {"scans": len(everything), "runs": runs}


def random_starts(half: SecondHalf) -> dict[str, Any]:
    """Search the map from random scans, each with the next 60 s of the log."""
    rng, rows = generator(7), []
    for seed in range(STARTS):
        first = int(rng.integers(0, len(half.beams) - 100))
        after = np.cumsum(half.stamps[first:] - half.stamps[first] > START_WINDOW_S) == 0
        index, beams, motion = half.spliced([first + np.flatnonzero(after)])
        result = half.run(beams, motion, seed, None)
        error, known = half.errors(result, index), result.health == Health.OK
        rows.append(
            {
                "first_scan": first,
                "found_after_s": round(float(half.stamps[index[known.argmax()]] - half.stamps[first]), 1)
                if known.any()
                else None,
                "health_at_the_end": Health(int(result.health[-1])).name.lower(),
                "error_at_the_end_m": round(float(error[-1]), 3),
                "scans_ok_but_wrong": int((known & (error > 0.5)).sum()),
            }
        )
    found = [row["health_at_the_end"] == "ok" and row["error_at_the_end_m"] < 0.3 for row in rows]
    wrong = [row["health_at_the_end"] == "ok" and row["error_at_the_end_m"] >= 0.3 for row in rows]
    return {"found": sum(found), "wrong_but_ok": sum(wrong), "starts": rows}


def kidnappings(half: SecondHalf) -> dict[str, Any]:
    """Cut the second half into four pieces, shuffle them, and splice: three kidnappings a run, three runs."""
    rows = []
    size = len(half.beams) // PIECES
    for seed in range(3):
        rng = generator(100 + seed)
        order = rng.permutation(PIECES)
        parts = [np.arange(k * size + int(rng.integers(0, size // 3)), (k + 1) * size) for k in order]
        index, beams, motion = half.spliced(parts)
        result = half.run(beams, motion, seed, xyt_from_pose(half.truth[index[0]]))
        error, known = half.errors(result, index), result.health == Health.OK
        starts = np.cumsum([0, *map(len, parts)])
        for piece in range(1, PIECES):
            at = slice(starts[piece], starts[piece + 1])
            right = np.flatnonzero(known[at] & (error[at] < 0.3))
            unknown = np.flatnonzero(~known[at])
            stamps = half.stamps[index[at]]
            rows.append(
                {
                    "carried_m": round(float(np.linalg.norm(
                        half.truth[index[starts[piece]], :2, 2] - half.truth[index[starts[piece] - 1], :2, 2])), 1),
                    "noticed_after_s": round(float(stamps[unknown[0]] - stamps[0]), 1) if len(unknown) else None,
                    "recovered_after_s": round(float(stamps[right[0]] - stamps[0]), 1) if len(right) else None,
                    "error_at_the_end_m": round(float(error[at][-1]), 3),
                }
            )  # fmt: skip
    recovered = sum(row["recovered_after_s"] is not None and row["error_at_the_end_m"] < 0.3 for row in rows)
    return {"recovered": recovered, "of": len(rows), "kidnappings": rows}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=Path, default=None)
    parser.add_argument("--parts", default="speed,slam,localization")
    arguments = parser.parse_args()
    data = Path(os.environ.get("PSG_DATA", "") or sys.exit("set PSG_DATA to the folder of logs"))
    results = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    for part in arguments.parts.split(","):
        if part == "localization":
            for name in ("intel", "fr079"):
                half = SecondHalf(data, name, arguments.runs)
                for label, measure in (
                    ("tracking", tracking),
                    ("random_starts", random_starts),
                    ("kidnappings", kidnappings),
                ):
                    results.setdefault("localization", {}).setdefault(name, {})[label] = measure(half)
                    print(name, label, json.dumps(results["localization"][name][label])[:400], flush=True)
        else:
            results[part] = {"speed": speed, "slam": slam}[part](data)
            print(part, json.dumps(results[part], indent=1), flush=True)
        with replacing(RESULT) as temporary:
            temporary.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
