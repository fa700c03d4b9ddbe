"""Poses in space: a drive over ramps end to end, the lifted graph, and levels that no loop may join."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from posegraph_slam.datasets import read
from posegraph_slam.datasets.simulation import LidarSettings, RampSettings, WorldSettings, ramp_settings
from posegraph_slam.datasets.simulation.run import drive, simulate_run
from posegraph_slam.errors import InputError
from posegraph_slam.evaluation.ape import absolute_pose_error
from posegraph_slam.geometry import SE2, SE3, align_points, pose_from_xyt, transform_points
from posegraph_slam.odometry import OdometrySettings
from posegraph_slam.odometry.spatial import SpatialOdometrySettings, spatial_odometry_at_scans
from posegraph_slam.pipeline.configuration import load_configuration
from posegraph_slam.pipeline.matching_file import read_matching, write_matching
from posegraph_slam.pipeline.optimize import optimize
from posegraph_slam.pipeline.spatial import Heights, SpatialSettings, lift_graph
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.residuals import chi2, constraint_residuals
from posegraph_slam.pose_graph.solve import solve

LIDAR = LidarSettings(beams=361, rate_hz=6.0, antennae=True)
CASES = {
    "one ramp up, one down": ramp_settings(seed=3, lidar=LIDAR),
    "higher than the scanner": ramp_settings(
        seed=4,
        world=WorldSettings(kind="ramps", room_depth_m=3.2, ramps=RampSettings(rise_min_m=1.2, rise_max_m=1.5)),
        lidar=LIDAR,
    ),
}


@pytest.fixture(scope="module", params=CASES)
def case(request):
    """Simulated run with the results of the planar and the spatial pipeline."""
    run = simulate_run(CASES[request.param])
    log = run.log()
    found = {group: optimize(log, load_configuration([], [f"pose_graph.group={group}"])) for group in ("se2", "se3")}
    return run, log, found


def false_cells(result, run, log, margin_m=0.15):
    """Occupied cells further than `margin_m` from every obstacle of the world, with the map laid onto the truth."""
    path, true = result.trajectory.spatial().poses[:, :2, 3], log.truth.poses[:, :2, 3]
    T_ref_map, _, _ = align_points(path, true)
    cells = np.argwhere(result.occupancy.occupied)
    points = transform_points(T_ref_map, result.occupancy.geometry.cell_to_world(cells))
    nearest = np.full(len(points), np.inf)
    for segment in run.world.segments:
        along = segment[2:] - segment[:2]
        u = np.clip((points - segment[:2]) @ along / (along @ along), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(points - segment[:2] - u[:, None] * along, axis=1))
    for x, y, radius in run.world.circles:
        nearest = np.minimum(nearest, np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius))
    return int((nearest > margin_m).sum())


def test_levelled_map_has_no_false_walls_where_the_flat_one_has_them(case):
    run, log, found = case
    assert false_cells(found["se2"], run, log) >= 20
    assert false_cells(found["se3"], run, log) == 0


def test_six_degrees_of_freedom_are_right(case):
    _, log, found = case
    error = absolute_pose_error(found["se3"].trajectory, log.truth)
    assert error.alignment == "se3"
    assert error.translation_m.rmse < 0.02
    assert error.translation_m.max < 0.04
    assert error.rotation_deg.rmse < 0.3
    assert found["se3"].trajectory.poses.shape == (len(log.scans), 4, 4)


def test_graph_in_space_holds_all_kinds_and_fits_them(case):
    graph = case[2]["se3"].graph
    kinds = set(graph.constraints.kind.tolist())
    assert {
        int(kind) for kind in (ConstraintKind.SCAN_MATCHING, ConstraintKind.ATTITUDE, ConstraintKind.SAME_GROUND)
    } <= kinds
    assert graph.group is SE3
    assert np.median(chi2(graph)) < 6.0
    ground = graph.constraints.select(graph.constraints.kind == int(ConstraintKind.SAME_GROUND))
    residual = constraint_residuals(graph.with_constraints(ground))
    assert np.abs(residual[:, 5]).max() < 0.1


def test_wheels_are_calibrated_and_the_stored_matching_says_so(case, tmp_path):
    _, log, found = case
    result = found["se3"]
    wheels = result.matched.wheels
    assert wheels.known
    assert abs(np.log(wheels.scale)) < 0.05
    assert any("wheels' way times" in remark for remark in result.remarks)
    assert not found["se2"].matched.wheels.known
    write_matching(result.matched, tmp_path / "scan_matching.npz")
    stored = read_matching(tmp_path / "scan_matching.npz", len(log.scans))
    assert stored.wheels == wheels
    again = optimize(log, load_configuration([], ["pose_graph.group=se3", "maps=false"]), matched=stored)
    np.testing.assert_array_equal(again.trajectory.poses, result.trajectory.poses)


def test_a_log_without_imu_is_refused_in_one_line(case):
    log = dataclasses.replace(case[1], imu=None)
    with pytest.raises(InputError, match="has no IMU") as refused:
        optimize(log, load_configuration([], ["pose_graph.group=se3"]))
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def short():
    log = drive(ramp_settings(seed=3, lidar=LidarSettings(beams=61)))
    return log, spatial_odometry_at_scans(log, OdometrySettings(), SpatialOdometrySettings())


def planar_chain(odometry, keyframes):
    poses = odometry.planar.trajectory.poses[keyframes]
    count = len(keyframes)
    rows = np.arange(count - 1)
    return PoseGraph(
        poses=poses,
        session=np.zeros(count, dtype=np.int64),
        index=keyframes,
        fixed=np.arange(count) == 0,
        constraints=Constraints(
            i=rows,
            j=rows + 1,
            T_i_j=SE2.between(poses[:-1], poses[1:]),
            information=np.tile(np.diag([1e4, 1e4, 1e5]), (count - 1, 1, 1)),
            kind=np.full(count - 1, int(ConstraintKind.SCAN_MATCHING)),
        ),
    )


def test_lifted_chain_is_the_odometry(short):
    _, odometry = short
    keyframes = np.arange(0, len(odometry.travel_m), 5)
    graph = lift_graph(planar_chain(odometry, keyframes), odometry, SpatialSettings(same_ground_m=0))
    np.testing.assert_allclose(graph.poses, odometry.trajectory.poses[keyframes], atol=1e-9)
    np.testing.assert_allclose(constraint_residuals(graph), 0.0, atol=1e-7)


def test_attitude_leaves_heading_and_place_free_and_holds_the_tilt(short):
    _, odometry = short
    keyframes = np.arange(0, len(odometry.travel_m), 5)
    graph = lift_graph(planar_chain(odometry, keyframes), odometry, SpatialSettings(same_ground_m=0))
    attitude = graph.constraints.select(graph.constraints.kind == int(ConstraintKind.ATTITUDE))
    moved = pose_from_heading(0.3, [4.0, -2.0, 1.0])
    turned = graph.with_constraints(attitude).with_poses(np.concatenate([graph.poses[:1], moved @ graph.poses[1:]]))
    assert chi2(turned).max() < 1e-4 * (4.0**2 + 2.0**2 + 1.0 + 3.0 * 0.3**2) * 30
    tilted = graph.poses.copy()
    tilted[1:] = graph.poses[1:] @ SE3.exp(np.array([0.0, 0.1, 0, 0, 0, 0]))
    assert chi2(graph.with_constraints(attitude).with_poses(tilted)).min() > 20.0


def pose_from_heading(heading, place):
    T = np.eye(4)
    T[:2, :2] = pose_from_xyt(np.array([0.0, 0.0, heading]))[:2, :2]
    T[:3, 3] = place
    return T


def test_one_ground_takes_a_drift_of_height_away(short):
    log, odometry = short
    drift = np.zeros((len(odometry.travel_m), 4, 4))
    drift[:, 2, 3] = 0.01 * odometry.travel_m
    bent = dataclasses.replace(odometry, trajectory=odometry.trajectory.with_poses(odometry.trajectory.poses + drift))
    keyframes = np.arange(0, len(odometry.travel_m), 3)
    spread = {}
    for same in (0.0, 0.4):
        settings = SpatialSettings(same_ground_m=same)
        # the plan is right, as after closing its loops; the heights are not
        truth = odometry.plan_view(log.truth).poses[keyframes]
        graph = lift_graph(planar_chain(bent, keyframes).with_poses(truth), bent, settings)
        error = solve(graph).poses[:, 2, 3] - log.truth.poses[keyframes, 2, 3]
        spread[same] = np.abs(error).max()
    assert spread[0.0] > 0.5
    assert spread[0.4] < 0.5 * spread[0.0]


def test_levels_above_each_other_are_apart_and_ramps_are_not():
    heights = Heights(
        height_m=np.array([0.0, 0.05, 1.0, 3.0]), travel_m=np.array([0.0, 30.0, 33.0, 60.0]), settings=SpatialSettings()
    )
    i, j = np.array([0, 0, 0, 1]), np.array([1, 2, 3, 3])
    near, far = np.full(4, 0.3), np.full(4, 4.0)
    np.testing.assert_array_equal(heights.apart(i, j, near), [False, False, True, True])
    np.testing.assert_array_equal(heights.apart(i, j, far)[:2], [False, False])
    sure = dataclasses.replace(heights, travel_m=np.array([0.0, 3.0, 6.0, 9.0]))
    assert sure.apart(i, j, near).tolist() == [False, True, True, True]


@pytest.mark.data
def test_flat_ground_is_no_worse_in_space(psg_data):
    log = read(psg_data / "ece276a" / "20")
    log = dataclasses.replace(log, scans=log.scans.select(slice(0, None, 4)))
    result = optimize(log, load_configuration([], ["pose_graph.group=se3", "maps=false"]))
    assert absolute_pose_error(result.trajectory, log.truth, alignment="se2").translation_m.rmse < 0.02
    assert absolute_pose_error(result.trajectory, log.truth).translation_m.rmse < 0.022
