"""Accuracy and speed of the attitude filters on runs with motion-capture truth.

    PSG_DATA=folder python benchmarks/attitude.py

Writes benchmarks/results/attitude.json. Speed is CPU time of one core, compiled kernels, over a stream of 200 000
samples; the time to compile is apart. "left out" runs are calibrated by the other runs alone; "data sheet" runs have
nominal gains, axes and a start that is taken as level; "shifted" gives truth the clock that agrees with the IMU's.
The row "truth, late" is what a perfect estimate gets from a truth whose clock is off by as much.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.datasets import read
from posegraph_slam.datasets.npz import Archive
from posegraph_slam.datasets.raw_imu import imu_from_counts
from posegraph_slam.evaluation.attitude import attitude_errors
from posegraph_slam.files import replacing
from posegraph_slam.geometry import Trajectory
from posegraph_slam.jit import measure_compile_time
from posegraph_slam.odometry.attitude import (
    AttitudeMethod,
    AttitudeSettings,
    calibrate_against_reference,
    clock_offset,
    estimate_attitude,
    predict,
    update,
)
from posegraph_slam.odometry.attitude.start import find_start
from posegraph_slam.odometry.attitude.ukf import initial_state, run_ukf
from posegraph_slam.sensors import Imu

RESULT = Path(__file__).parent / "results" / "attitude.json"
METHODS: tuple[AttitudeMethod, ...] = ("ukf", "smoother", "complementary", "gyro")
SPEED_SAMPLES = 200_000
COLUMNS = ("roll_deg", "pitch_deg", "yaw_deg", "roll_away_deg", "yaw_away_deg", "tilt_deg", "heading_deg", "nees",
           "nees_median")  # fmt: skip


def accuracy(imu: Imu, truth: Trajectory, method: AttitudeMethod = "ukf") -> dict[str, Any]:
    """Compare one method with the truth of the run."""
    estimate = estimate_attitude(imu, method=method)
    return attitude_errors(estimate.trajectory, truth, covariance=estimate.covariance).as_dict()


def by_data_sheet(path: Path) -> Imu:
    """Read a run as one of an unknown board."""
    archive = Archive(path)
    return imu_from_counts(archive.numbers("imu_raw"), archive.stamps("imu_stamps_s"), where=str(path), board=None)[0]


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
    paths = sorted((Path(folder) / "orientation").glob("*.npz"))
    known: dict[str, tuple[Imu, Trajectory]] = {}
    for path in paths:
        log = read(path)
        assert log.imu is not None
        assert log.truth is not None
        known[path.stem] = log.imu, log.truth
    fast = speed(next(iter(known.values()))[0])
    runs: dict[str, Any] = {}
    for path in paths:
        imu, truth = known[path.stem]
        late = clock_offset(imu, truth)
        shifted = truth.restamped(truth.stamps_s - late)
        others = [run for name, run in known.items() if name != path.stem]
        runs[path.stem] = {
            **{method: accuracy(imu, truth, method) for method in METHODS},
            "ukf, left out": accuracy(calibrate_against_reference(others).apply(imu), truth),
            "ukf, data sheet": accuracy(by_data_sheet(path), truth),
            "ukf, shifted": accuracy(imu, shifted),
            "truth, late": attitude_errors(shifted, truth).as_dict(),
        }
        print(f"\n{path.stem}: truth is {1e3 * late:.0f} ms late")
        print(f"{'':<16}" + "".join(f"{column.removesuffix('_deg'):>12}" for column in COLUMNS))
        for method, errors in runs[path.stem].items():
            values = (errors[column] for column in COLUMNS)
            print(f"{method:<16}" + "".join(f"{'–' if v is None else format(v, '.2f'):>12}" for v in values))
    board = calibrate_against_reference(list(known.values()))
    residual = {
        "accelerometer_offset": board.accelerometer_offset.tolist(),
        "accelerometer_matrix": board.accelerometer_matrix.tolist(),
        "gyro_matrix": board.gyro_matrix.tolist(),
    }
    print("\nall runs, what the reader's calibration leaves:", json.dumps(residual))
    print("\n" + "\n".join(f"{name:<22}{value:12.2f}" for name, value in fast.items()))
    record = {"runs": runs, "speed": fast, "left_by_the_calibration": residual}
    with replacing(RESULT) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
