"""Accuracy and speed of the attitude filters on runs with motion-capture truth.

    PSG_DATA=folder python benchmarks/attitude.py

Writes benchmarks/results/attitude.json. Speed is CPU time of one core, compiled kernels, over a stream of 200 000
samples; the time to compile is apart. "left out" runs get the gyro gains that the other runs give by gravity alone,
starting from the data sheet; "data sheet" runs get none.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets import read
from posegraph_slam.datasets.raw_imu import GYRO_GAIN
from posegraph_slam.evaluation.attitude import attitude_errors
from posegraph_slam.files import replacing
from posegraph_slam.jit import measure_compile_time
from posegraph_slam.odometry.attitude import AttitudeMethod, AttitudeSettings, estimate_attitude, predict, update
from posegraph_slam.odometry.attitude.calibration import estimate_gyro_gain
from posegraph_slam.odometry.attitude.start import find_start
from posegraph_slam.odometry.attitude.ukf import initial_state, run_ukf
from posegraph_slam.sensors import Imu, RobotLog

RESULT = Path(__file__).parent / "results" / "attitude.json"
METHODS: tuple[AttitudeMethod, ...] = ("ukf", "smoother", "complementary", "gyro")
SPEED_SAMPLES = 200_000
COLUMNS = ("roll_deg", "pitch_deg", "yaw_deg", "roll_away_deg", "yaw_away_deg", "tilt_deg", "heading_deg", "nees",
           "nees_median")  # fmt: skip


def with_gain(imu: Imu, gain: FloatArray) -> Imu:
    """Scale the rates of an IMU."""
    return replace(imu, angular_velocity=imu.angular_velocity * gain)


def accuracy(log: RobotLog, imu: Imu, method: AttitudeMethod) -> dict[str, Any]:
    """Compare one method with the truth of the run."""
    estimate = estimate_attitude(imu, method=method)
    assert log.truth is not None
    return attitude_errors(estimate.trajectory, log.truth, covariance=estimate.covariance).as_dict()


def per_second(function: Callable[[], Any], count: int, repeats: int = 5) -> float:
    """Return how many of `count` units a second the fastest of some calls does."""
    fastest = np.inf
    for _ in range(repeats):
        started = time.process_time()
        function()
        fastest = min(fastest, time.process_time() - started)
    return count / fastest


def speed(imu: Imu) -> dict[str, float]:
    """Measure updates a second: the stream in one kernel, and predict and update called one by one from Python."""
    settings = AttitudeSettings()
    start = find_start(imu.stamps_s, imu.angular_velocity, imu.linear_acceleration, settings)
    state = initial_state(start, settings)
    index = np.arange(SPEED_SAMPLES) % len(imu)
    dt, omega, accel = np.full(SPEED_SAMPLES, 0.01), imu.angular_velocity[index], imu.linear_acceleration[index]
    with measure_compile_time() as compiled:
        started = time.perf_counter()
        run_ukf(state, dt[:2], omega[:2], accel[:2], settings=settings)
        update(predict(state, omega[0], 0.01, settings), accel[0], settings)
        first = time.perf_counter() - started

    def one_by_one() -> None:
        current = state
        for k in range(2000):
            current = update(predict(current, omega[k], 0.01, settings), accel[k], settings)

    return {
        "stream_updates_per_s": per_second(lambda: run_ukf(state, dt, omega, accel, settings=settings), SPEED_SAMPLES),
        "single_updates_per_s": per_second(one_by_one, 2000),
        "jit_compile_s": compiled.seconds,
        "first_call_s": first,
    }


def main() -> int:
    """Measure, print and write."""
    folder = os.environ.get("PSG_DATA")
    if not folder:
        print("set PSG_DATA to the folder of real logs", file=sys.stderr)
        return 2
    logs = {path.stem: read(path) for path in sorted((Path(folder) / "orientation").glob("*.npz"))}
    imus = {name: log.imu for name, log in logs.items() if log.imu is not None}
    fast = speed(next(iter(imus.values())))
    plain = {name: with_gain(imu, GYRO_GAIN) for name, imu in imus.items()}
    runs: dict[str, Any] = {}
    for name, log in logs.items():
        gain, sigma = estimate_gyro_gain([imu for other, imu in plain.items() if other != name])
        runs[name] = {
            **{method: accuracy(log, imus[name], method) for method in METHODS},
            "ukf, left out": accuracy(log, with_gain(plain[name], gain), "ukf"),
            "ukf, data sheet": accuracy(log, plain[name], "ukf"),
        }
        print(f"\n{name}: gains of the other runs {np.round(gain, 3)} +- {np.round(sigma, 3)}")
        print(f"{'':<16}" + "".join(f"{column.removesuffix('_deg'):>12}" for column in COLUMNS))
        for method, errors in runs[name].items():
            values = (errors[column] for column in COLUMNS)
            print(f"{method:<16}" + "".join(f"{'–' if v is None else format(v, '.2f'):>12}" for v in values))
    gain, sigma = estimate_gyro_gain(list(plain.values()))
    print(f"\ngains of all runs {np.round(gain, 3)} +- {np.round(sigma, 3)}")
    print("\n" + "\n".join(f"{name:<22}{value:12.2f}" for name, value in fast.items()))
    record = {"runs": runs, "speed": fast, "gyro_gain": {"found": gain.tolist(), "sigma": sigma.tolist()}}
    with replacing(RESULT) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
