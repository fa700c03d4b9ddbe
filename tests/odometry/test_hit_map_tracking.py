"""Chaining scans on one growing map of hit counts."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from posegraph_slam.datasets import read
from posegraph_slam.datasets.simulation import LidarSettings, demo_settings, drive
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.ape import absolute_pose_error
from posegraph_slam.odometry import odometry_at_scans
from posegraph_slam.odometry.hit_map_tracking import track_on_hits
from posegraph_slam.odometry.scan_matching import ScanMatchingSettings, match_scans
from posegraph_slam.registration.beam_scans import BeamScanSettings, prepare_beam_scans
from posegraph_slam.registration.hit_map_matching import HitMapSettings

CORRELATIVE = ScanMatchingSettings(matcher="correlative")


@pytest.fixture(scope="module")
def simulated():
    log = drive(demo_settings(seed=5, lidar=LidarSettings(beams=361)))
    return log, prepare_beam_scans(log.scans, BeamScanSettings()), odometry_at_scans(log)


def test_matching_beats_odometry(simulated):
    log, scans, odometry = simulated
    matched = match_scans(scans, odometry, CORRELATIVE)
    error, alone = (
        absolute_pose_error(each, log.truth).translation_m.rmse for each in (matched.trajectory, odometry.trajectory)
    )
    assert error < 0.08
    assert error < 0.5 * alone
    assert matched.matched_fraction.mean() > 0.8
    assert (np.linalg.eigvalsh(matched.keyframe_information) > 0).all()
    np.testing.assert_allclose(matched.trajectory.poses[0], odometry.trajectory.poses[0], atol=1e-12)


def test_a_fixed_map_is_as_good_as_one_that_fits(simulated):
    log, scans, odometry = simulated
    for size_m in (0.0, 60.0):
        poses, share = track_on_hits(scans, odometry, HitMapSettings(), size_m)
        error = absolute_pose_error(odometry.trajectory.with_poses(poses), log.truth).translation_m.rmse
        assert error < 0.1
        assert share.mean() > 0.8


def test_a_map_too_large_is_refused(simulated):
    _, scans, odometry = simulated
    with pytest.raises(InputError, match="take larger cells"):
        track_on_hits(scans, odometry, HitMapSettings(), 5000.0)


@pytest.mark.data
def test_real_run(psg_data):
    log = read(psg_data / "ece276a" / "20")
    log = dataclasses.replace(log, scans=log.scans.select(slice(0, None, 2)))
    matched = match_scans(prepare_beam_scans(log.scans, BeamScanSettings()), odometry_at_scans(log), CORRELATIVE)
    assert absolute_pose_error(matched.trajectory, log.truth).translation_m.rmse < 0.06
