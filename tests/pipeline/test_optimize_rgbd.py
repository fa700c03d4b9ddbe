"""RGB-D logs from end to end: the run directory, its determinism, and what goes wrong in one line."""

from __future__ import annotations

import csv
import filecmp
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from posegraph_slam.datasets import read
from posegraph_slam.datasets.ply import read_ply
from posegraph_slam.datasets.simulation.rgbd_room import (
    furnished_room,
    loop_through_room,
    small_camera,
    write_rgbd_log,
)
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE3
from posegraph_slam.pipeline.configuration import Configuration, load_configuration
from posegraph_slam.pipeline.optimize_rgbd import optimize_rgbd
from posegraph_slam.pipeline.plan import describe
from posegraph_slam.pipeline.run import run
from posegraph_slam.report.run_figures import draw_figures

FIVE_FRAMES = ["rgbd.camera.fx_px=518", "rgbd.camera.fy_px=519", "rgbd.camera.cx_px=325.5", "rgbd.camera.cy_px=253.5"]
"""Intrinsics of the camera that took them; the folder does not hold them."""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rgbd") / "room"
    return write_rgbd_log(folder, furnished_room(seed=3), small_camera(160, 120), loop_through_room(160)[:16])


@pytest.fixture(scope="module")
def finished(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    run(log, load_configuration(["default"], ["workers=1"]), out=out, draw=draw_figures)
    return out


def test_the_run_directory_holds_poses_graph_loops_and_cloud(finished: Path, log: Path) -> None:
    trajectory = read_tum(finished / "trajectory.tum", parent="map", child="camera")
    truth = read_tum(log / "groundtruth.txt", parent="ref", child="camera")
    assert len(trajectory) == 16
    off = SE3.local(SE3.between(truth.poses[:1], truth.poses), trajectory.poses)
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.015
    assert (finished / "graph.g2o").read_text().count("VERTEX_SE3:QUAT") >= 3
    with (finished / "loops.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows
    assert {"target_frame", "source_frame", "agreement", "correlation", "feature_inliers", "reason"} <= rows[0].keys()
    assert all((row["accepted"] == "true") == (row["reason"] == "") for row in rows)
    points = read_ply(finished / "maps/cloud.ply")
    assert len(points) > 10_000
    # every point lies in the room, within noise, and most on a face of it or of its furniture
    world = points @ truth.poses[0][:3, :3].T + truth.poses[0][:3, 3]
    boxes = furnished_room(seed=3).boxes
    assert (world > boxes[0, :3] - 0.1).all()
    assert (world < boxes[0, 3:] + 0.1).all()
    gap = np.min([np.abs(world[:, a % 3] - box[a]) for box in boxes for a in range(6)], axis=0)
    assert np.quantile(gap, 0.9) < 0.03
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["frames_tracked"] == 16
    rows_of_table = {row["metric"] for row in metrics["table"]["rows"]}
    assert {"APE position RMSE", "position from the first frame max", "thickness of surfaces, median"} <= rows_of_table
    for name in ("trajectories", "loops", "cloud_above", "cloud_side", "before_above", "after_above"):
        assert (finished / f"figures/{name}.png").stat().st_size > 1000


def test_frames_that_show_something_else_stay_out_of_the_cloud(tmp_path: Path) -> None:
    path = loop_through_room(160)
    room, camera = furnished_room(seed=3), small_camera(160, 120)
    folder = write_rgbd_log(tmp_path / "log", room, camera, np.concatenate([path[:5], path[[60, 100]], path[5:9]]))
    run(folder, load_configuration(["default"], ["workers=1"]), out=tmp_path / "run")
    with (tmp_path / "run/frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] == "interpolated" for row in rows] == [False] * 5 + [True] * 2 + [False] * 4
    assert [row["part"] for row in rows] == ["0"] * 5 + ["-1"] * 2 + ["0"] * 4
    assert rows[0]["status"] == rows[-1]["status"] == "keyframe"
    points = read_ply(tmp_path / "run/maps/cloud.ply")
    world = points @ path[0][:3, :3].T + path[0][:3, 3]
    assert (world > room.boxes[0, :3] - 0.1).all()
    assert (world < room.boxes[0, 3:] + 0.1).all()


def test_a_part_that_no_loop_ties_to_the_rest_is_left_out_and_named(tmp_path: Path) -> None:
    path = loop_through_room(160)
    poses = np.concatenate([path[:8], path[80:85]])
    folder = write_rgbd_log(tmp_path / "log", furnished_room(seed=3), small_camera(160, 120), poses)
    result = optimize_rgbd(read(folder), load_configuration(["default"], ["rgbd.odometry.lost_frames_max=2"]))
    np.testing.assert_array_equal(result.parts.part, [0] * 8 + [1] * 5)
    assert result.metrics["parts"] == 2
    assert any("5 frames from 8 on" in remark for remark in result.remarks)
    assert result.cloud is not None
    world = result.cloud.points @ path[0][:3, :3].T + path[0][:3, 3]
    assert (world < furnished_room(seed=3).boxes[0, 3:] + 0.1).all()


def test_parts_that_loops_tie_together_are_one(tmp_path: Path) -> None:
    path = loop_through_room(160)
    # away at once, where nothing is known, and slowly back to what was seen first
    poses = np.concatenate([path[:8], path[40:4:-2]])
    folder = write_rgbd_log(tmp_path / "log", furnished_room(seed=3), small_camera(240, 180), poses)
    result = optimize_rgbd(read(folder), load_configuration(["default"], ["rgbd.odometry.lost_frames_max=3"]))
    assert result.metrics["guessed_motions"] == 1
    assert not result.parts.part.any(), "one part of all frames"
    assert any("tie what was tracked" in remark for remark in result.remarks)
    off = SE3.local(SE3.between(poses[:1], poses), result.trajectory.poses)
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.03


def test_a_second_run_with_two_workers_gives_the_same_bytes(finished: Path, log: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    run(log, load_configuration(["default"], ["workers=2"]), out=out)
    for name in ("trajectory.tum", "odometry.tum", "graph.g2o", "loops.csv", "metrics.json", "maps/cloud.ply"):
        assert filecmp.cmp(finished / name, out / name, shallow=False), name


def test_without_loops_and_maps_the_odometry_stands(log: Path) -> None:
    configuration = load_configuration(["default"], ["loop_closure.enabled=false", "maps=false"])
    result = optimize_rgbd(read(log), configuration)
    assert result.cloud is None
    assert result.loops == ()
    np.testing.assert_allclose(result.trajectory.poses, result.stages["odometry"].poses, atol=1e-9)


def test_the_configuration_replaces_intrinsics_and_says_so(finished: Path, log: Path, tmp_path: Path) -> None:
    file = tmp_path / "wide.json"
    file.write_text('{"fx": 131.2, "fy": 131.2, "cx": 79.5, "cy": 59.5, "depth_units_per_m": 2500}')
    overrides = [f"rgbd.camera.file={json.dumps(str(file))}", "rgbd.camera.fy_px=131.3", "maps=false"]
    result = optimize_rgbd(read(log), load_configuration(["default"], overrides))
    assert any("fy 131.3" in remark and "depth / 2500" in remark for remark in result.remarks)
    # half the depth unit makes the room and its path twice as large
    usual = read_tum(finished / "odometry.tum", parent="map", child="camera")
    ratio = result.stages["odometry"].path_length_m / usual.path_length_m
    assert ratio == pytest.approx(2.0, rel=0.03)


def test_the_plan_names_images_and_cloud(log: Path) -> None:
    steps = describe(read(log), Configuration())
    assert any("16 pairs of colour and depth images (160 x 120)" in step for step in steps)
    assert any("16 true poses" in step for step in steps)


def test_an_image_that_breaks_after_reading_is_named(log: Path, tmp_path: Path) -> None:
    folder = write_rgbd_log(tmp_path / "log", furnished_room(), small_camera(80, 60), loop_through_room(160)[:3])
    robot_log = read(folder)
    broken = folder / "depth" / "00001.png"
    assert cv2.imwrite(str(broken), np.ones((60, 80), np.uint8))
    with pytest.raises(InputError, match="16-bit") as caught:
        optimize_rgbd(robot_log, Configuration())
    assert "00001.png" in str(caught.value)
    broken.unlink()
    with pytest.raises(InputError, match=r"00001.png: cannot be opened"):
        optimize_rgbd(robot_log, Configuration())


@pytest.mark.data
def test_five_frames_far_apart_are_placed(psg_data: Path) -> None:
    """Relative poses within 0.03 m and 1 degree of pose.txt, which itself misses the images by up to 9 pixels."""
    robot_log = read(psg_data / "rgbd/five_frames")
    result = optimize_rgbd(robot_log, load_configuration(["default"], [*FIVE_FRAMES, "maps=false"]))
    assert robot_log.truth is not None
    truth = robot_log.truth.poses
    assert result.odometry.tracked.all()
    for poses in (stage.poses for stage in result.stages.values()):
        steps = SE3.inverse(SE3.between(truth[:-1], truth[1:])) @ SE3.between(poses[:-1], poses[1:])
        assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 0.03
        assert np.rad2deg(Rotation.from_matrix(steps[:, :3, :3]).magnitude()).max() < 1.0
        from_first = SE3.inverse(SE3.between(truth[:1], truth)) @ SE3.between(poses[:1], poses)
        assert np.rad2deg(Rotation.from_matrix(from_first[:, :3, :3]).magnitude()).max() < 1.0
        assert np.linalg.norm(from_first[:, :3, 3], axis=1).max() < 0.05
    rows = {row.name: row.values for row in result.comparison.rows}
    assert rows["APE position RMSE"][-1] < 0.02
    assert rows["RPE position a frame max"][-1] < 0.03
    assert rows["RPE rotation a frame max"][-1] < 1.0
    assert any("rotation of the alignment" in remark for remark in result.remarks)  # the camera moved along a line


@pytest.mark.data
def test_wide_steps_are_found_in_half_of_the_depth(psg_data: Path) -> None:
    """The usual number of features finds the first of these steps only with depths beyond 7 m."""
    robot_log = read(psg_data / "rgbd/five_frames")
    overrides = [*FIVE_FRAMES, "maps=false", "rgbd.max_depth_m=5"]
    result = optimize_rgbd(robot_log, load_configuration(["default"], overrides))
    assert robot_log.truth is not None
    assert result.odometry.tracked.all()
    truth, poses = robot_log.truth.poses, result.stages["odometry"].poses
    steps = SE3.inverse(SE3.between(truth[:-1], truth[1:])) @ SE3.between(poses[:-1], poses[1:])
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 0.03
    assert np.rad2deg(Rotation.from_matrix(steps[:, :3, :3]).magnitude()).max() < 1.0


@pytest.mark.data
def test_part_of_the_living_room_is_consistent(psg_data: Path, tmp_path: Path) -> None:
    """Every sixth frame of the first half: out to one side and back over the start."""
    source, folder = psg_data / "rgbd/living_room", tmp_path / "living_room"
    for kind, suffix in (("image", "jpg"), ("depth", "png")):
        (folder / kind).mkdir(parents=True)
        for k in range(0, 106, 6):
            (folder / kind / f"{k:05d}.{suffix}").symlink_to(source / kind / f"{k:05d}.{suffix}")
    result = optimize_rgbd(read(folder), load_configuration(["default"], ["maps=false"]))
    assert result.odometry.tracked.all()
    images = result.metrics["images"]
    assert images["first to last frame, position off"]["optimised"] < 0.002
    assert images["thickness of surfaces, median"]["optimised"] < 0.001
    assert images["thickness of surfaces, median"]["optimised"] <= images["thickness of surfaces, median"]["odometry"]
    # the floor of the room is level to the camera of the first frame within a degree: both were made by one program
    assert abs(result.upward[0]) < 0.03
