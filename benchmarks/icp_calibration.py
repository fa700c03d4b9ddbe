"""Whether the information of a registration tells the truth: mean normalised error squared over noisy trials.

    python benchmarks/icp_calibration.py [--data FOLDER] [--trials 200] [--seed 1] [--rooms-only]
                                         [--out benchmarks/results/icp_calibration.json]

Rooms are simulated scans of 181 to 1081 beams with a random place, motion and guess a trial; every case has its own
random numbers. The second room is an L with a slanted wall, a pillar and a turned box. On the LiDAR pair the truth is
known because both clouds of a trial are drawn from the same points: two random parts of 2500 points each, of the target
scan or of both scans joined by the pose that comes with them, one moved, both with noise added.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402  the number of threads is read when it is imported
from scipy.stats import chi2  # noqa: E402

from posegraph_slam.datasets.clouds import read_cloud  # noqa: E402
from posegraph_slam.geometry import SE2, SE3, Group, pose_from_xyt, transform_points  # noqa: E402
from posegraph_slam.registration import IcpSettings, icp  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "registration"))
from conftest import ROOM, scan  # noqa: E402

MATCHERS = {"point_to_point": IcpSettings.point_to_point(), "point_to_plane": IcpSettings.point_to_line(),
            "generalised": IcpSettings.generalised()}  # fmt: skip
NOISES_M = (0.005, 0.01, 0.02, 0.03)
BEAMS = (181, 361, 1081)
PART = 2500


def closed(corners: list[tuple[float, float]]) -> np.ndarray:
    """Walls (k, 2, 2) from corner to corner and back to the first."""
    return np.stack([np.array(corners), np.roll(np.array(corners), -1, axis=0)], axis=1)


PILLAR = [(3.5 + 0.3 * np.cos(a), -1.5 + 0.3 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)]
OTHER_ROOM = np.concatenate([
    closed([(-4.0, -3.0), (6.0, -3.5), (6.0, 1.0), (1.5, 1.6), (1.0, 5.0), (-4.0, 5.0)]), closed(PILLAR),
    closed([(-2.6, 2.4), (-1.8, 2.7), (-2.2, 3.8), (-3.0, 3.5)]),
])  # fmt: skip
ROOMS = {"room": ROOM, "L room": OTHER_ROOM}

Trial = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
"""Makes source, target, true pose and guess."""


def room_trial(walls: np.ndarray, beams: int, sigma_m: float) -> Trial:
    """Scans of a room up to 0.15 m and 0.1 rad apart; the guess is off by 5 cm and 0.03 rad a deviation."""

    def make(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        at = pose_from_xyt(np.r_[rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3)])
        truth = pose_from_xyt(np.r_[rng.uniform(-0.15, 0.15, 2), rng.uniform(-0.1, 0.1)])
        target, source = (scan(pose, walls, beams, sigma_m, rng) for pose in (at, at @ truth))
        return source, target, truth, truth @ SE2.exp(rng.normal(0, [0.05, 0.05, 0.03]))

    return make


def scan_trial(points: np.ndarray, sigma_m: float) -> Trial:
    """Two random parts of real points; the guess is off by 0.1 m and 0.02 rad a deviation."""

    def make(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        first, second = np.split(points[rng.permutation(len(points))[: 2 * PART]], 2)
        truth = SE3.exp(rng.normal(0, [0.05] * 3 + [0.2] * 3))
        moved = transform_points(SE3.inverse(truth), second)
        target, source = (part + rng.normal(0, 1, part.shape) * sigma_m for part in (first, moved))
        return source, target, truth, truth @ SE3.exp(rng.normal(0, [0.02] * 3 + [0.1] * 3))

    return make


def measure(trial: Trial, settings: IcpSettings, group: Group, trials: int, seed: list[int]) -> dict[str, Any]:
    """Mean and share within the 95 % ellipsoid of the normalised error squared, and the error's root mean squares."""
    rng, errors, nees = np.random.default_rng(seed), [], []
    for _ in range(trials):
        source, target, truth, guess = trial(rng)
        result = icp(source, target, guess, settings)
        error = group.local(result.T_target_source, truth)
        errors.append(error)
        nees.append(float(error @ result.information @ error))
    low, high = chi2.ppf([0.025, 0.975], group.dof * trials) / trials
    turn = slice(2, 3) if group.dimension == 2 else slice(0, 3)
    squares = np.mean(np.square(errors), axis=0)
    return {"nees": float(np.mean(nees)), "band": [float(low), float(high)], "inside": bool(low < np.mean(nees) < high),
            "share_in_95": float(np.mean(np.array(nees) < chi2.ppf(0.95, group.dof))),
            "rms_mm": 1e3 * float(np.sqrt(squares.sum() - squares[turn].sum())),
            "rms_mrad": 1e3 * float(np.sqrt(squares[turn].sum()))}  # fmt: skip


def main() -> None:
    """Run all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("PSG_DATA"))
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rooms-only", action="store_true", help="leave out the real points")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/icp_calibration.json"))
    options = parser.parse_args()
    cases = [(f"{name}, {beams} beams", SE2, partial_room(walls, beams), NOISES_M)
             for name, walls in ROOMS.items() for beams in BEAMS]  # fmt: skip
    if options.data and not options.rooms_only:
        folder = Path(options.data) / "clouds" / "lidar_pair"
        source, target = (read_cloud(folder / f"{name}.ply").points for name in ("source", "target"))
        both = np.vstack([target, transform_points(np.loadtxt(folder / "T_target_source.txt"), source)])
        for name, points in (("LiDAR target scan", target), ("LiDAR pair joined", both)):
            cases.append((name, SE3, partial_scan(points), (0.0, *NOISES_M[1:])))
    rows = []
    for matcher, settings in MATCHERS.items():
        for number, (name, group, make, noises) in enumerate(cases):
            for step, sigma_m in enumerate(noises):
                used = settings if group is SE2 else IcpSettings(**{**settings.model_dump(), "max_distance_m": 1.0})
                found = measure(make(sigma_m), used, group, options.trials, [options.seed, number, step])
                rows.append({"matcher": matcher, "case": name, "sigma_m": sigma_m, **found})
                print(f"{matcher:15s} {name:18s} {sigma_m:5.3f} m  NEES {found['nees']:5.2f} in "
                      f"{found['band'][0]:.2f}-{found['band'][1]:.2f} {'yes' if found['inside'] else 'NO '} "
                      f"share {found['share_in_95']:.3f}  rms {found['rms_mm']:.2f} mm {found['rms_mrad']:.2f} mrad",
                      flush=True)  # fmt: skip
    print(f"{sum(row['inside'] for row in rows)} of {len(rows)} cases inside")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"trials": options.trials, "seed": options.seed, "rows": rows}, indent=1) + "\n")


def partial_room(walls: np.ndarray, beams: int) -> Callable[[float], Trial]:
    """Trials in a room by their noise."""
    return lambda sigma_m: room_trial(walls, beams, sigma_m)


def partial_scan(points: np.ndarray) -> Callable[[float], Trial]:
    """Trials on real points by their noise."""
    return lambda sigma_m: scan_trial(points, sigma_m)


if __name__ == "__main__":
    main()
