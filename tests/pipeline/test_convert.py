"""`psg convert`: logs keep what the target can hold, trajectories their poses, and errors name what does not fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from posegraph_slam import datasets
from posegraph_slam.cli.application import app
from posegraph_slam.datasets.ply import write_ply
from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.datasets.trajectory_files import read_trajectory, write_trajectory
from posegraph_slam.geometry import SE2, Trajectory, planar_from_spatial, pose_from_xyt
from posegraph_slam.odometry.scan_odometry import odometry_at_scans
from posegraph_slam.sensors import LaserScans, RobotLog


def psg(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["convert", *(str(argument) for argument in arguments)], catch_exceptions=False)


def refused(*arguments: str | Path) -> str:
    result = psg(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    return result.stderr


def scans_of(log: RobotLog) -> LaserScans:
    assert log.scans is not None
    return log.scans


def assert_same_scans(first: LaserScans, second: LaserScans, stamps: float = 1e-6) -> None:
    np.testing.assert_allclose(second.stamps_s, first.stamps_s, atol=stamps)
    np.testing.assert_allclose(second.angles_rad, first.angles_rad, atol=1e-9)
    hit = first.returns()
    np.testing.assert_array_equal(second.returns(), hit)
    np.testing.assert_allclose(second.ranges_m[hit], first.ranges_m[hit], atol=6e-5)
    np.testing.assert_allclose(
        planar_from_spatial(second.T_base_lidar), planar_from_spatial(first.T_base_lidar), atol=2e-6
    )


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tiny_settings(duration_s=12.0, images=True), tmp_path_factory.mktemp("convert") / "log")


def test_an_ece276a_folder_becomes_a_carmen_log(simulated: Path, tmp_path: Path) -> None:
    assert psg(simulated, tmp_path / "log.clf", "--quiet").output == ""
    before, after = datasets.read(simulated), datasets.read(tmp_path / "log.clf")
    assert_same_scans(scans_of(before), scans_of(after))
    assert after.scan_odometry is not None
    np.testing.assert_allclose(after.scan_odometry.poses, odometry_at_scans(before).trajectory.poses, atol=1e-9)
    assert after.truth is not None
    assert before.truth is not None
    np.testing.assert_allclose(after.truth.poses, before.truth.poses, atol=1e-12)


def test_an_ece276a_folder_survives_its_own_format(simulated: Path, tmp_path: Path) -> None:
    assert psg(simulated, tmp_path / "copy").exit_code == 0
    before, after = datasets.read(simulated), datasets.read(tmp_path / "copy")
    assert_same_scans(scans_of(before), scans_of(after), stamps=0)
    np.testing.assert_array_equal(scans_of(after).T_base_lidar, scans_of(before).T_base_lidar)
    assert before.encoders is not None
    assert after.encoders is not None
    np.testing.assert_array_equal(after.encoders.travel_m, before.encoders.travel_m)
    assert before.imu is not None
    assert after.imu is not None
    np.testing.assert_allclose(after.imu.linear_acceleration, before.imu.linear_acceleration, atol=1e-12)
    assert before.rgbd is not None
    assert after.rgbd is not None
    assert sum(map(bool, after.rgbd.disparity_files)) == sum(map(bool, before.rgbd.disparity_files)) > 0
    assert psg(simulated, tmp_path / "copy").exit_code == 2
    assert psg(simulated, tmp_path / "copy", "--overwrite").exit_code == 0


def xyt_at(k: int) -> tuple[float, float, float]:
    """An arc of 5 m radius, 0.1 m a step."""
    return 5 * np.sin(0.02 * k), 5 - 5 * np.cos(0.02 * k), 0.02 * k


def carmen_log(path: Path, beams: int = 180, scans: int = 40) -> Path:
    """A robot that drives an arc, its stamps twice out of order, ODOM lines between the scans."""
    rng = np.random.default_rng(4)
    lines = []
    for k in range(scans):
        ranges = np.round(rng.uniform(1, 20, beams), 2)
        ranges[::7] = 81.83
        x, y, yaw = xyt_at(k)
        stamp = 1000 + 0.1 * k - (0.15 if k in (10, 20) else 0)
        lines.append(f"ODOM {x} {y} {yaw} 0 0 0 {1000 + 0.1 * k:.6f} host 0")
        pose = f"{x} {y} {yaw}"
        lines.append(f"FLASER {beams} {' '.join(map(str, ranges))} {pose} {pose} {stamp:.6f} host 0")
    path.write_text("\n".join(lines) + "\n")
    (path.with_suffix(".relations")).write_text("1000.0 1001.0 1 0.1 0 0 0 0.2\n")
    return path


def test_a_carmen_log_survives_its_own_format(tmp_path: Path) -> None:
    source = carmen_log(tmp_path / "a.clf")
    assert psg(source, tmp_path / "b.log").exit_code == 0
    before, after = datasets.read(source), datasets.read(tmp_path / "b.log")
    assert (tmp_path / "b.log").read_text().count("\nFLASER 180 ") == 40
    assert_same_scans(scans_of(before), scans_of(after))
    assert after.odometry is not None
    assert before.odometry is not None
    np.testing.assert_allclose(after.odometry.poses, before.odometry.poses, atol=1e-12)
    assert after.relations is not None
    assert before.relations is not None
    np.testing.assert_allclose(after.relations.T_1_2, before.relations.T_1_2, atol=1e-15)


def test_a_log_without_encoders_gets_counts_that_integrate_to_its_odometry(tmp_path: Path) -> None:
    source = carmen_log(tmp_path / "a.clf")
    result = psg(source, tmp_path / "folder", "--json")
    record = json.loads(result.stdout)
    assert (record["format"], record["scans"]) == ("ece276a", 40)
    assert any("counts are made from the odometry" in remark for remark in record["remarks"])
    assert any("2 stamps of the scans run backwards" in remark for remark in record["remarks"])
    after = datasets.read(tmp_path / "folder")
    assert_same_scans(scans_of(datasets.read(source)), scans_of(after), stamps=0.16)
    poses = odometry_at_scans(after).trajectory.poses
    expected = pose_from_xyt(np.array([xyt_at(k) for k in range(40)]))
    difference = SE2.log(SE2.between(poses[:1], poses[-1:])) - SE2.log(SE2.between(expected[:1], expected[-1:]))
    # half a tick on either side over the track width, and what that heading does over 4 m
    assert np.abs(difference[0, 2]) < 0.0022 / 0.75 + 1e-9
    assert np.abs(difference[0, :2]).max() < 0.0022 + 4 * 0.0022 / 0.75


def test_trajectories_change_format_and_keep_their_poses(tmp_path: Path) -> None:
    poses = pose_from_xyt(np.array([[0.1 * k, np.sin(k), 0.3 * k] for k in range(9)]))
    trajectory = Trajectory(stamps_s=1e9 + np.arange(9.0), poses=poses, parent="map", child="base")
    write_trajectory(trajectory, tmp_path / "a.tum")
    for source, target, *options in (
        ("a.tum", "b.kitti"), ("b.kitti", "c.csv", "--to", "euroc"), ("c.csv", "d.csv"), ("d.csv", "e.tum"),
    ):  # fmt: skip
        assert psg(tmp_path / source, tmp_path / target, *options).exit_code == 0
    np.testing.assert_allclose(read_trajectory(tmp_path / "e.tum").poses, trajectory.spatial().poses, atol=1e-12)
    np.testing.assert_array_equal(read_trajectory(tmp_path / "e.tum").stamps_s, trajectory.stamps_s)


def test_a_log_gives_its_odometry_or_its_truth(simulated: Path, tmp_path: Path) -> None:
    assert psg(simulated, tmp_path / "odometry.tum").exit_code == 0
    assert psg(simulated, tmp_path / "truth.kitti", "--stream", "truth").exit_code == 0
    log = datasets.read(simulated)
    assert log.truth is not None
    np.testing.assert_allclose(read_trajectory(tmp_path / "truth.kitti").poses, log.truth.poses, atol=1e-12)
    assert len(read_trajectory(tmp_path / "odometry.tum")) == len(scans_of(log))
    assert "knows no true poses" in refused(carmen_log(tmp_path / "a.clf"), tmp_path / "t.tum", "--stream", "truth")


def test_clouds_become_ply(tmp_path: Path) -> None:
    points = np.random.default_rng(1).normal(size=(5, 3))
    np.save(tmp_path / "a.npy", points)
    assert "5 points as ply" in psg(tmp_path / "a.npy", tmp_path / "b.ply").stdout
    from posegraph_slam.datasets.clouds import read_cloud

    np.testing.assert_array_equal(read_cloud(tmp_path / "b.ply").points, points)


def test_refusals_say_what_to_do(tmp_path: Path) -> None:
    source = carmen_log(tmp_path / "a.clf")
    assert "no such file" in refused(tmp_path / "none.clf", tmp_path / "b.tum")
    assert "names no format; name one by --to" in refused(source, tmp_path / "b.xyz")
    assert "'toro' is no format that is written" in refused(source, tmp_path / "b", "--to", "toro")
    assert "exists; add --overwrite" in refused(source, source)
    assert "is no stream" in refused(source, tmp_path / "b.tum", "--stream", "imu")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine.txt").write_text("1")
    assert "folder of other things" in refused(source, tmp_path / "folder", "--overwrite")
    assert "neither a log nor a run directory" in refused(tmp_path / "folder", tmp_path / "b.tum")
    write_ply(np.zeros((1, 3)), tmp_path / "c.ply")
    assert "is a point cloud" in refused(tmp_path / "c.ply", tmp_path / "b.tum")
    assert "has no laser scans" in refused(euroc_like(tmp_path), tmp_path / "b.clf")


def euroc_like(folder: Path) -> Path:
    """An IMU alone."""
    file = folder / "data.csv"
    file.write_text("#timestamp [ns],w_RS_S_x [rad s^-1]\n" + "".join(f"{10**9 + k},0,0,0,0,0,9.8\n" for k in range(9)))
    return file


def test_a_bag_of_an_rgbd_camera_becomes_a_folder_that_is_read(tmp_path: Path) -> None:
    from ..datasets.bag_writing import Entry, Maker, stamp_at, store_as

    rng = np.random.default_rng(6)
    maker, image = Maker(ros2=True), "sensor_msgs/msg/Image"
    colour = rng.integers(0, 255, (5, 4, 6, 3), dtype=np.uint8)
    depth = rng.uniform(0.5, 4.0, (5, 4, 6)).astype(np.float32)
    depth[0, 0, :2] = np.nan, 90.0
    K = np.array([[500.0, 0, 3], [0, 510, 2], [0, 0, 1]])
    entries: list[Entry] = []
    for k in range(5):
        ns = stamp_at(k)
        entries += [
            ("/camera/color/image_raw", image, ns, maker.image(ns, colour[k], "rgb8")),
            ("/camera/depth/image_raw", image, ns, maker.image(ns, np.zeros((2, 2), np.uint16), "16UC1", "other")),
            ("/camera/aligned_depth_to_color/image_raw", image, ns, maker.image(ns, depth[k], "32FC1")),
            ("/camera/aligned_depth_to_color/camera_info", "sensor_msgs/msg/CameraInfo", ns, maker.camera(ns, K)),
        ]
    bag = store_as("mcap", tmp_path, entries)
    result = psg(bag, tmp_path / "room", "--to", "rgbd")
    assert "5 frames as rgbd" in result.stdout
    assert "distortion" in result.stderr
    sequence = datasets.read(tmp_path / "room").rgbd_sequence
    assert sequence is not None
    np.testing.assert_allclose(sequence.stamps_s, [stamp_at(k) * 1e-9 for k in range(5)], atol=1e-6)
    assert (sequence.camera.fx_px, sequence.camera.fy_px, sequence.camera.depth_units_per_m) == (500.0, 510.0, 1000.0)
    from posegraph_slam.mapping.images import read_image

    np.testing.assert_array_equal(read_image(sequence.colour_files[3]), colour[3])
    stored = read_image(sequence.depth_files[0])
    assert stored[0, :2].tolist() == [0, 0]
    np.testing.assert_allclose(stored[1:] / 1000, depth[0, 1:], atol=6e-4)
    assert psg(bag, tmp_path / "room", "--to", "rgbd", "--overwrite").exit_code == 0
    assert "no pair of colour and depth" in refused(carmen_log(tmp_path / "a.clf"), tmp_path / "b", "--to", "rgbd")
