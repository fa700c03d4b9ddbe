"""Odometry of the real logs, measured against what is known of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from posegraph_slam import datasets
from posegraph_slam.evaluation import absolute_pose_error, relation_errors
from posegraph_slam.geometry import SE2, planar_from_spatial
from posegraph_slam.odometry import OdometrySettings, odometry_at_scans
from posegraph_slam.odometry.estimate import covariance_between
from posegraph_slam.sensors import RobotLog

pytestmark = pytest.mark.data


@pytest.fixture(scope="module")
def indoor_run(psg_data: Path) -> RobotLog:
    return datasets.read(psg_data / "ece276a" / "20")


def test_wheels_and_gyro_stay_within_a_metre_of_the_truth(indoor_run: RobotLog) -> None:
    assert indoor_run.truth is not None
    assert indoor_run.scans is not None
    estimate = odometry_at_scans(indoor_run)
    assert estimate.source == "wheels_imu"
    np.testing.assert_array_equal(estimate.trajectory.stamps_s, indoor_run.scans.stamps_s)
    assert absolute_pose_error(estimate.trajectory, indoor_run.truth).translation_m.rmse <= 0.9
    assert any("gyro bias" in remark for remark in estimate.remarks)
    assert any("gyro is missing" in remark for remark in estimate.remarks)


def test_the_covariance_covers_the_error_of_the_indoor_run(indoor_run: RobotLog) -> None:
    assert indoor_run.truth is not None
    estimate = odometry_at_scans(indoor_run)
    true = planar_from_spatial(indoor_run.truth.spatial().poses)
    poses = estimate.trajectory.poses
    for apart in (200, 1000, 3000):
        start = np.arange(0, len(poses) - apart, 7)
        end = start + apart
        covariance = covariance_between(poses, estimate.covariance, start, end)
        error = SE2.local(SE2.between(true[start], true[end]), SE2.between(poses[start], poses[end]))
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
        assert 0.1 < nees.mean() < 9.0  # 3 for a perfect model


def test_the_gyro_is_worth_it(indoor_run: RobotLog) -> None:
    assert indoor_run.truth is not None
    errors = [
        absolute_pose_error(
            odometry_at_scans(indoor_run, OdometrySettings(source=source)).trajectory, indoor_run.truth
        ).translation_m.rmse
        for source in ("wheels_imu", "wheels")
    ]  # fmt: skip
    assert errors[0] < errors[1]


@pytest.mark.parametrize(
    ("name", "metres", "degrees"), [("intel", 7.37, 39.17), ("fr079", 6.504, 30.29)]
)  # fmt: skip
def test_logged_odometry_has_the_known_relation_errors(
    psg_data: Path, name: str, metres: float, degrees: float
) -> None:
    log = datasets.read(psg_data / "carmen" / f"{name}.clf")
    assert log.relations is not None
    errors = relation_errors(odometry_at_scans(log).trajectory, log.relations)
    assert errors.missing == 0
    assert errors.all.translation_m is not None
    assert errors.all.rotation_deg is not None
    assert errors.near.translation_m is not None
    np.testing.assert_allclose(errors.all.translation_m.mean, metres, atol=0.005)
    np.testing.assert_allclose(errors.all.rotation_deg.mean, degrees, atol=0.01)
    assert errors.near.translation_m.mean < 0.06
