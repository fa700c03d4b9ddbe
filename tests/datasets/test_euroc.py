"""EuRoC recordings: units, the mounting of sensor.yaml, the truth, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from posegraph_slam import datasets
from posegraph_slam.errors import InputError

Builder = Callable[[str, Path], Path]


def test_measurements_mounting_and_truth(tmp_path: Path, log_builder: Builder) -> None:
    sequence = log_builder("euroc", tmp_path)
    for path in (sequence, sequence / "mav0", sequence / "mav0" / "imu0", sequence / "mav0" / "imu0" / "data.csv"):
        log = datasets.read(path)
        assert log.imu is not None
        assert log.truth is not None
        np.testing.assert_allclose(log.imu.angular_velocity[3], [0.03, -0.2, 0.3])
        np.testing.assert_allclose(log.imu.linear_acceleration[3], [0.5, 0.125, 9.81])
        np.testing.assert_allclose(np.diff(log.imu.stamps_s), 0.005, atol=5e-7)
        np.testing.assert_array_equal(log.imu.T_base_imu[:3, 3], [0.1, 0.2, 0.3])
        np.testing.assert_array_equal(log.imu.T_base_imu[:2, :2], [[0, -1], [1, 0]])
        np.testing.assert_allclose(log.truth.positions[:, 0], 0.1 * np.arange(50))


def test_a_recording_without_truth_or_mounting_is_read(tmp_path: Path, log_builder: Builder) -> None:
    folder = log_builder("euroc", tmp_path) / "mav0"
    (folder / "imu0" / "sensor.yaml").unlink()
    (folder / "state_groundtruth_estimate0" / "data.csv").unlink()
    log = datasets.read(folder)
    assert log.imu is not None
    assert log.truth is None
    np.testing.assert_array_equal(log.imu.T_base_imu, np.eye(4))
    for numbers in ("1, 2, 3", ", ".join(["nan"] * 16)):
        (folder / "imu0" / "sensor.yaml").write_text(f"T_BS:\n  data: [{numbers}]\n")
        with pytest.raises(InputError, match=r"sensor\.yaml: holds no pose T_BS"):
            datasets.read(folder)


def test_a_clock_that_runs_backwards_is_refused(tmp_path: Path, log_builder: Builder) -> None:
    file = log_builder("euroc", tmp_path) / "mav0" / "imu0" / "data.csv"
    lines = file.read_text().splitlines()
    lines[5], lines[6] = lines[6], lines[5]
    file.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"data\.csv:7: the clock runs backwards"):
        datasets.read(file)
