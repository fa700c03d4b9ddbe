"""Whether the returned information tells the truth, and what a corridor leaves open."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import subspace_angles
from scipy.stats import chi2

from posegraph_slam.datasets.clouds import read_cloud
from posegraph_slam.geometry import SE2, SE3, pose_from_xyt, transform_points
from posegraph_slam.registration import IcpSettings, RegistrationStatus, icp

TRIALS = 200


LINE, POINT, GENERALISED = IcpSettings.point_to_line(), IcpSettings.point_to_point(), IcpSettings.generalised()


@pytest.mark.parametrize(("settings", "beams", "sigma_m"), [
    (LINE, 181, 0.01), (LINE, 361, 0.02), (LINE, 1081, 0.01), (LINE, 1081, 0.03),
    (POINT, 181, 0.01), (POINT, 361, 0.03), (GENERALISED, 361, 0.02),
], ids=["line-181", "line-361", "line-1081", "line-noisy", "point-181", "point-361", "generalised"])  # fmt: skip
def test_information_is_calibrated_in_rooms(
    settings: IcpSettings, beams: int, sigma_m: float, simulated: SimpleNamespace
) -> None:
    rng, nees = np.random.default_rng(1), []
    for _ in range(TRIALS):
        at = pose_from_xyt(np.r_[rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3)])
        truth = pose_from_xyt(np.r_[rng.uniform(-0.15, 0.15, 2), rng.uniform(-0.1, 0.1)])
        target = simulated.scan(at, simulated.room, beams, sigma_m, rng)
        source = simulated.scan(at @ truth, simulated.room, beams, sigma_m, rng)
        result = icp(source, target, truth @ SE2.exp(rng.normal(0, [0.05, 0.05, 0.03])), settings)
        assert result.usable
        error = SE2.local(result.T_target_source, truth)
        nees.append(float(error @ result.information @ error))
    low, high = chi2.ppf([0.025, 0.975], 3 * TRIALS) / TRIALS
    assert low < np.mean(nees) < high


@pytest.mark.parametrize(("beams", "sigma_m"), [(361, 0.02), (1081, 0.02)])
def test_information_is_calibrated_where_only_short_ends_hold_a_corridor(
    beams: int, sigma_m: float, simulated: SimpleNamespace
) -> None:
    walls = np.array([[[-8, -1], [8, -1]], [[8, -1], [8, 1]], [[8, 1], [-8, 1]], [[-8, 1], [-8, -1]]], dtype=np.float64)
    rng, nees = np.random.default_rng(1), []
    for _ in range(TRIALS):
        at = pose_from_xyt(np.r_[rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3)])
        truth = pose_from_xyt(np.r_[rng.uniform(-0.15, 0.15, 2), rng.uniform(-0.1, 0.1)])
        target = simulated.scan(at, walls, beams, sigma_m, rng)
        source = simulated.scan(at @ truth, walls, beams, sigma_m, rng)
        result = icp(source, target, truth @ SE2.exp(rng.normal(0, [0.05, 0.05, 0.03])))
        error = SE2.local(result.T_target_source, truth)
        nees.append(float(error @ result.information @ error))
    low, high = chi2.ppf([0.025, 0.975], 3 * TRIALS) / TRIALS
    assert low < np.mean(nees) < high  # without the noise of the lines' directions 4.2 and 7.0


@pytest.mark.parametrize(("beams", "sigma_m"), [(361, 0.02), (1081, 0.01)])
def test_noise_of_lines_does_not_hold_a_corridor(beams: int, sigma_m: float, simulated: SimpleNamespace) -> None:
    rng, free = np.random.default_rng(3), []
    for _ in range(40):
        at = pose_from_xyt(np.r_[rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3)])
        truth = pose_from_xyt(np.r_[rng.uniform(-0.15, 0.15, 2), rng.uniform(-0.1, 0.1)])
        target = simulated.scan(at, simulated.corridor, beams, sigma_m, rng)
        source = simulated.scan(at @ truth, simulated.corridor, beams, sigma_m, rng)
        free.append(icp(source, target, truth).degenerate)
    assert np.mean(free) > 0.9  # 0.75 and 0.47 by J^T W J alone


@pytest.mark.parametrize("settings", [IcpSettings.point_to_line(), IcpSettings.point_to_point()], ids=["line", "point"])
def test_a_corridor_is_free_along_itself(settings: IcpSettings, simulated: SimpleNamespace) -> None:
    rng = np.random.default_rng(2)
    turned = pose_from_xyt(np.array([0, 0, 0.4]))
    target = simulated.scan(turned, simulated.corridor, 361, 0.005, rng, 8.0)
    source = simulated.scan(
        turned @ pose_from_xyt(np.array([0.03, 0.02, 0.01])), simulated.corridor, 361, 0.005, rng, 8
    )
    result = icp(source, target, np.eye(3), settings)
    assert result.usable
    assert result.degenerate
    assert result.degenerate_directions.shape == (1, 3)
    along = np.array([np.cos(-0.4), np.sin(-0.4), 0])
    assert abs(result.degenerate_directions[0] @ along) > 0.99
    covariance = np.linalg.inv(result.information)
    assert np.sqrt(along @ covariance @ along) > 0.9
    across = np.array([-along[1], along[0], 0])
    assert np.sqrt(across @ covariance @ across) < 0.02  # the walls' own direction is known to half a degree
    if settings.residual.value == "point_to_plane":  # what the walls do not tell stays as it was guessed
        assert abs(along @ SE2.log(result.T_target_source)) < 0.005  # of 0.02 m travelled along it


def test_a_floor_leaves_three_directions_free() -> None:
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-2, 2, (600, 2)), rng.normal(0, 0.002, 600)])
    guess = SE3.exp(np.array([0.02, -0.01, 0.1, 0.05, 0.03, 0.04]))
    result = icp(floor, floor, guess)
    assert result.usable
    assert len(result.degenerate_directions) == 3
    free = np.zeros((3, 6))
    free[0, 2] = free[1, 3] = free[2, 4] = 1.0  # yaw, x, y
    assert subspace_angles(result.degenerate_directions.T, free.T).max() < 0.1


def test_information_is_never_without_limit_or_the_identity(simulated: SimpleNamespace) -> None:
    exact = simulated.scan(np.eye(3), simulated.room, 361, 0.0, np.random.default_rng(0))
    result = icp(exact, exact, np.eye(3))
    values = np.linalg.eigvalsh(result.information)
    assert result.status is RegistrationStatus.CONVERGED
    assert 1.0 < values[0] < values[-1] < 361 * 30.0**2 / IcpSettings().sigma_floor_m ** 2
    np.testing.assert_array_equal(result.information, result.information.T)


def test_more_noise_means_less_information(simulated: SimpleNamespace) -> None:
    sizes = []
    for sigma in (0.005, 0.01, 0.02):
        rng = np.random.default_rng(5)
        clouds = [simulated.scan(np.eye(3), simulated.room, 361, sigma, rng) for _ in range(2)]
        sizes.append(np.linalg.det(icp(*clouds, np.eye(3)).information))
    # three directions, each with the inverse square of the noise: 4^3 a doubling
    ratios = np.array(sizes[:-1]) / sizes[1:]
    assert (ratios > 4.0**3 / 3).all()
    assert (ratios < 4.0**3 * 3).all()


@pytest.mark.data
@pytest.mark.parametrize(("settings", "joined", "sigma_m"), [
    (GENERALISED, False, 0.01), (IcpSettings(max_distance_m=1.0), True, 0.02),
], ids=["generalised", "plane"])  # fmt: skip
def test_information_is_calibrated_on_real_scans(
    settings: IcpSettings, joined: bool, sigma_m: float, psg_data: Path
) -> None:
    folder = psg_data / "clouds" / "lidar_pair"
    points = read_cloud(folder / "target.ply").points
    if joined:  # two scans as one scene: where they do not meet it is rough
        other = read_cloud(folder / "source.ply").points
        points = np.vstack([points, transform_points(np.loadtxt(folder / "T_target_source.txt"), other)])
    rng, nees = np.random.default_rng(1), []
    for _ in range(TRIALS):
        first, second = np.split(points[rng.permutation(len(points))[:5000]], 2)
        truth = SE3.exp(rng.normal(0, [0.05] * 3 + [0.2] * 3))
        moved = transform_points(SE3.inverse(truth), second)
        target, source = (p + rng.normal(0, sigma_m, p.shape) for p in (first, moved))
        result = icp(source, target, truth @ SE3.exp(rng.normal(0, [0.02] * 3 + [0.1] * 3)), settings)
        error = SE3.local(result.T_target_source, truth)
        nees.append(float(error @ result.information @ error))
    low, high = chi2.ppf([0.025, 0.975], 6 * TRIALS) / TRIALS
    assert low < np.mean(nees) < high
