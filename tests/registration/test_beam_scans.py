"""Lines fitted to scans, and the choice of the points that stand for a scan."""

from __future__ import annotations

import math

import numpy as np
import pytest

from posegraph_slam.errors import InputError
from posegraph_slam.pipeline.executors import ThreadExecutor
from posegraph_slam.registration.beam_scans import BeamScanSettings, prepare_beam_scans
from posegraph_slam.sensors import LaserScans


def wall_scan(distance: float, heading: float, *, sigma: float = 0.0, count: int = 1, seed: int = 0) -> LaserScans:
    """Scans (count) of one endless wall at `distance`, whose normal points along `heading`."""
    angles = np.radians(np.arange(-90.0, 90.0, 1.0))
    cosine = np.cos(angles - heading)
    ranges = np.where(cosine > 0.05, distance / np.maximum(cosine, 0.05), 100.0)
    noise = np.random.default_rng(seed).normal(0.0, sigma, (count, len(angles)))
    return LaserScans(
        stamps_s=np.arange(count, dtype=np.float64),
        ranges_m=(ranges + noise).astype(np.float32),
        angle_min_rad=float(angles[0]),
        angle_increment_rad=math.radians(1.0),
        range_min_m=0.05,
        range_max_m=80.0,
        T_base_lidar=np.eye(4),
    )


@pytest.mark.parametrize("heading", [-1.0, 0.0, 0.4])
def test_lines_of_a_wall_are_exact_and_face_the_sensor(heading: float) -> None:
    scans = prepare_beam_scans(wall_scan(3.0, heading), BeamScanSettings())
    lines = scans.lines[0][scans.kind[0] == 2]
    assert len(lines) > 80
    np.testing.assert_allclose(lines[:, :2], np.tile([-np.cos(heading), -np.sin(heading)], (len(lines), 1)), atol=1e-5)
    np.testing.assert_allclose(lines[:, 2], -3.0, atol=1e-5)


def test_untrusted_ranges_are_no_points() -> None:
    log = wall_scan(3.0, 0.0)
    ranges = np.array(log.ranges_m)
    ranges[0, 80:84] = [np.nan, 0.001, 60.0, np.inf]
    scans = prepare_beam_scans(
        LaserScans(
            stamps_s=log.stamps_s,
            ranges_m=ranges,
            angle_min_rad=log.angle_min_rad,
            angle_increment_rad=log.angle_increment_rad,
            range_min_m=0.05,
            range_max_m=50.0,
            T_base_lidar=np.eye(4),
        ),
        BeamScanSettings(),
    )
    assert not scans.kind[0, 80:84].any()
    assert not scans.thinned[0, 80:84].any()
    assert np.isfinite(scans.points).all()


def test_scattered_points_have_no_line() -> None:
    log = wall_scan(3.0, 0.0, sigma=0.5, count=20)
    scans = prepare_beam_scans(log, BeamScanSettings())
    # three points in a row may lie on a line by chance
    assert (
        np.mean(scans.kind == 2) < 0.15 < np.mean(prepare_beam_scans(wall_scan(3.0, 0.0), BeamScanSettings()).kind == 2)
    )


def test_thinned_points_are_spaced_and_do_not_prefer_a_sign_of_the_noise() -> None:
    """A choice that favours returns erring along the sweep turns every match, and so the whole trajectory."""
    sigma = 0.02
    log = wall_scan(1.5, 0.0, sigma=sigma, count=400)
    scans = prepare_beam_scans(log, BeamScanSettings(source_spacing_m=0.08))
    error = scans.points[..., 0] - 1.5
    chosen = scans.thinned & (np.abs(scans.points[..., 1]) < 3.0)
    beams = np.arange(180)[None, :] < 90
    for half in (beams, ~beams):
        mean = float(error[chosen & half].mean())
        assert abs(mean) < 4 * sigma / np.sqrt(np.sum(chosen & half))
    spacing = np.diff(np.sort(scans.points[0, scans.thinned[0], 1]))
    assert 0.05 < np.median(spacing) < 0.13


def test_workers_do_not_change_the_result() -> None:
    log = wall_scan(2.0, 0.3, sigma=0.01, count=1500)
    serial = prepare_beam_scans(log, BeamScanSettings())
    with ThreadExecutor(2) as executor:
        parallel = prepare_beam_scans(log, BeamScanSettings(), executor)
    for name in ("points", "lines", "kind", "thinned"):
        assert getattr(serial, name).tobytes() == getattr(parallel, name).tobytes()


def test_a_sweep_that_runs_backwards_is_refused() -> None:
    log = wall_scan(2.0, 0.0)
    with pytest.raises(InputError, match="increment"):
        prepare_beam_scans(
            LaserScans(
                stamps_s=log.stamps_s,
                ranges_m=log.ranges_m,
                angle_min_rad=1.5,
                angle_increment_rad=-0.01,
                range_min_m=0.1,
                range_max_m=10.0,
                T_base_lidar=np.eye(4),
            ),
            BeamScanSettings(),
        )
