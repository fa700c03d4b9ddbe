"""Localisation in a known map: tracking, random starts and kidnappings, on two real logs and on logs held out.

    PSG_DATA=folder python benchmarks/localization.py [NAME ...] [--runs FOLDER]

Writes benchmarks/results/localization.json. The map is drawn from the first half of a log's scans, and the second half
is localised in it. For intel and fr079 map and errors are those of the optimised trajectory, taken from FOLDER/intel
and FOLDER/fr079 (run directories of `psg optimize`) or computed; for the others, ece276a/20 and simulated ones of
`logs.py`, those of the truth. The settings were chosen on intel and fr079 alone.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.datasets import read
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.files import replacing
from posegraph_slam.geometry import SE2, Trajectory, planar_from_spatial, wrap_angle, xyt_from_pose
from posegraph_slam.localization.health import Health
from posegraph_slam.localization.known_map import LocalizationResult, localize, prepare_map
from posegraph_slam.mapping.occupancy import build_occupancy
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.scan_matching import match_scans
from posegraph_slam.odometry.scan_odometry import odometry_at_scans
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.optimize import optimize
from posegraph_slam.registration.beam_scans import BeamScans, prepare_beam_scans
from posegraph_slam.sensors import RobotLog

from logs import build

RESULT = Path(__file__).parent / "results" / "localization.json"
CONFIGURATION = Configuration()
START_WINDOW_S, PIECES, WRONG_M = 60.0, 4, 0.5
REAL = ("intel", "fr079")
HELD_OUT = {
    "ece276a/20": 0.0, "corridor_loop": 2.0, "corridor_narrow": 2.0, "hall": 2.0, "office_361": 2.0, "stalls": 2.0,
    "gaps": 2.0, "no_odometry": 2.0, "lag": 2.0, "offset": 2.0, "sweep": 3.0, "twins": 2.0,
}  # fmt: skip
"""Logs that no setting was chosen on, and their sizes: at these the second half drives where the first has been."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """How much is measured: seeds of tracking, random starts, and runs with three kidnappings each."""

    seeds: int
    starts: int
    runs: int


def reference(data: Path, name: str, runs: Path | None) -> tuple[RobotLog, FloatArray]:
    """Return a log and the poses (N, 3, 3) that its scans are held to, in recorded order."""
    if name in REAL:
        log = read(data / "carmen" / f"{name}.clf")
        return log, optimised(log, None if runs is None else runs / name)
    if name == "ece276a/20":
        log = read(data / name)
        assert log.truth is not None
        return log, planar_from_spatial(log.truth.poses)
    log = build(name, size=HELD_OUT[name]).robot_log()
    assert log.truth is not None
    return log, planar_from_spatial(log.truth.poses)


def optimised(log: RobotLog, run: Path | None) -> FloatArray:
    """Optimised poses (N, 3, 3) of all scans in recorded order."""
    if run is None:
        return np.asarray(optimize(log, CONFIGURATION).trajectory.poses)
    assert log.scans is not None
    stored = read_tum(run / "trajectory.tum", parent="map", child="base")
    poses = np.empty((len(stored), 3, 3))
    poses[np.argsort(log.scans.stamps_s, kind="stable")] = planar_from_spatial(stored.poses)
    return poses


def generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


class SecondHalf:
    """The second half of a log, the map of its first half, and the poses that it is held to."""

    def __init__(self, log: RobotLog, poses: FloatArray) -> None:
        assert log.scans is not None
        count = len(log.scans)
        first, second = np.arange(count // 2), np.arange(count // 2, count)
        path = Trajectory(stamps_s=log.scans.stamps_s[first], poses=poses[first], parent="map", child="base")
        self.grid = build_occupancy(log.scans.select(first), path, CONFIGURATION.mapping)
        self.truth = poses[second]
        self.stamps = log.scans.stamps_s[second]
        # Wheels and gyro are integrated over the whole log, and cut after.
        whole = odometry_at_scans(log, CONFIGURATION.odometry)
        self.odometry = replace(
            whole, trajectory=whole.trajectory.select(second), covariance=whole.covariance[second[0] :]
        )
        self.beams = prepare_beam_scans(log.scans.select(second), CONFIGURATION.scans)
        self.known = prepare_map(self.grid, CONFIGURATION.localization)

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


def tracking(half: SecondHalf, seeds: int) -> dict[str, Any]:
    """Track the whole second half from its first pose, with three seeds."""
    everything = np.arange(len(half.beams))
    index, beams, motion = half.spliced([everything])
    runs = []
    for seed in range(seeds):
        started = time.process_time()
        result = half.run(beams, motion, seed, xyt_from_pose(half.truth[0]))
        seconds = time.process_time() - started
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
                "ok_but_wrong_share": round(float(((result.health == Health.OK) & (error > WRONG_M)).mean()), 4),
                "mean_particles": round(float(result.particles.mean())),
                "ms_a_scan": round(1e3 * seconds / len(index), 3),
            }
        )
    return {"scans": len(everything), "runs": runs}


def random_starts(half: SecondHalf, starts: int) -> dict[str, Any]:
    """Search the map from random scans, each with the next 60 s of the log."""
    rng, rows = generator(7), []
    for seed in range(starts):
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
                "scans_ok_but_wrong": int((known & (error > WRONG_M)).sum()),
            }
        )
    found = [row["health_at_the_end"] == "ok" and row["error_at_the_end_m"] < 0.3 for row in rows]
    wrong = [row["health_at_the_end"] == "ok" and row["error_at_the_end_m"] >= 0.3 for row in rows]
    return {"found": sum(found), "wrong_but_ok": sum(wrong), "starts": rows}


def kidnappings(half: SecondHalf, runs: int) -> dict[str, Any]:
    """Cut the second half into four pieces, shuffle them, and splice: three kidnappings a run, three runs."""
    rows = []
    size = len(half.beams) // PIECES
    for seed in range(runs):
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


def measure(half: SecondHalf, plan: Plan) -> dict[str, Any]:
    """Measure one log."""
    return {
        "tracking": tracking(half, plan.seeds),
        "random_starts": random_starts(half, plan.starts),
        "kidnappings": kidnappings(half, plan.runs),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", default=[*REAL, *HELD_OUT])
    parser.add_argument("--runs", type=Path, default=None)
    arguments = parser.parse_args()
    data = Path(os.environ.get("PSG_DATA", "") or sys.exit("set PSG_DATA to the folder of logs"))
    for name in arguments.names:
        plan = Plan(seeds=3, starts=20, runs=3) if name in REAL else Plan(seeds=1, starts=10, runs=2)
        result = measure(SecondHalf(*reference(data, name, arguments.runs)), plan)
        results = json.loads(RESULT.read_text()) if RESULT.exists() else {}
        results[name] = result
        with replacing(RESULT) as temporary:
            temporary.write_text(json.dumps(results, indent=1) + "\n")
        print(name, summary(result), flush=True)


def summary(result: dict[str, Any]) -> str:
    """One line for people."""
    run, starts, taken = result["tracking"]["runs"][0], result["random_starts"], result["kidnappings"]
    return (
        f"tracking median {run['median_m']} m, 99 % {run['p99_m']} m, ok {run['ok_share']}, ok but wrong "
        f"{run['ok_but_wrong_share']}; found {starts['found']} of {len(starts['starts'])}, wrong but ok "
        f"{starts['wrong_but_ok']}; recovered {taken['recovered']} of {taken['of']}"
    )


if __name__ == "__main__":
    main()
