"""Bags of all storages: the streams that were written come back, mounted as the frame tree says."""

from __future__ import annotations

import contextlib
import sqlite3
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from posegraph_slam import datasets
from posegraph_slam.datasets.rosbag.clouds import BEAMS as CLOUD_BEAMS
from posegraph_slam.datasets.rosbag.clouds import planar_slice
from posegraph_slam.datasets.rosbag.growing import CHUNK_BYTES, GrowingRows
from posegraph_slam.datasets.rosbag.images import read_header
from posegraph_slam.datasets.rosbag.scans import nearest_beams
from posegraph_slam.geometry import pose_from_xyt
from posegraph_slam.sensors import LaserScans, RobotLog

from .bag_writing import (
    LASER_ON_BASE,
    LATENCY_NS,
    START_NS,
    STORAGES,
    Entry,
    Maker,
    maker_of,
    ranges_at,
    robot,
    stamp_at,
    store_as,
    write_bag,
    xyt_at,
)

SCAN, ODOM, TF = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
COUNT = 20


def scans_of(log: RobotLog) -> LaserScans:
    assert log.scans is not None
    return log.scans


def seen(numbers: range) -> np.ndarray:
    """Ranges (N, B) of scans: what was written, and the maximum range where there was no return."""
    ranges = np.array([ranges_at(k) for k in numbers], np.float32)
    return np.where(np.isinf(ranges), np.float32(20.0), ranges)


def poses_at(count: int) -> np.ndarray:
    return np.array([pose_from_xyt(np.array(xyt_at(k))) for k in range(count)])


def mounting(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
    return T


def read_entries(folder: Path, entries: list[Entry], storage: str = "mcap", **topics: str) -> RobotLog:
    return datasets.read(store_as(storage, folder, entries), topics=topics)


@pytest.mark.parametrize("storage", STORAGES)
def test_every_storage_and_compression_gives_the_same_log(storage: str, tmp_path: Path) -> None:
    log = datasets.read(store_as(storage, tmp_path, robot(maker_of(storage), COUNT)))
    scans = scans_of(log)
    assert (log.format, len(scans)) == ("rosbag", COUNT)
    stamps = np.array([stamp_at(k) * 1e-9 for k in range(COUNT)])
    np.testing.assert_allclose(scans.stamps_s, stamps, atol=1e-6)
    np.testing.assert_array_equal(scans.ranges_m, seen(range(COUNT)))
    np.testing.assert_allclose(scans.angles_rad[[0, -1]], [-1.5, 1.5], atol=1e-6)
    assert (scans.range_min_m, scans.range_max_m) == (pytest.approx(0.1), 20.0)
    footprint = mounting((0, 0, 0.1), (0, 0, 0)) @ mounting(*LASER_ON_BASE)
    np.testing.assert_allclose(scans.T_base_lidar, footprint, atol=1e-12)
    assert log.odometry is not None
    np.testing.assert_allclose(
        log.odometry.poses, [pose_from_xyt(np.array(xyt_at(k))) for k in range(COUNT)], atol=1e-12
    )
    assert log.imu is not None
    np.testing.assert_allclose(log.imu.T_base_imu, mounting((0, 0, 0.1), (0, 0, 0)), atol=1e-12)
    assert log.imu.angular_velocity[0].tolist() == [0.0, 0.0, 0.1]
    assert any("scan /scan (LaserScan, 20), odom /odom" in remark for remark in log.remarks)


def test_a_storage_file_without_metadata_is_read(tmp_path: Path) -> None:
    folder = store_as("mcap", tmp_path, robot(maker_of("mcap")))
    (folder / "metadata.yaml").unlink()
    assert len(scans_of(datasets.read(folder))) == COUNT
    assert len(scans_of(datasets.read(next(folder.glob("*.mcap"))))) == COUNT


def test_a_folder_of_split_bags_is_one_recording(tmp_path: Path) -> None:
    maker = Maker(ros2=False)
    entries = robot(maker, COUNT)
    pixels = np.arange(4, dtype=np.uint8).reshape(2, 2)
    entries.append(("/cam", "sensor_msgs/msg/Image", stamp_at(COUNT), maker.image(stamp_at(COUNT), pixels, "mono8")))
    whole = datasets.read(store_as("ros1", tmp_path / "whole", entries))
    middle = len(entries) // 2
    for number, part in enumerate((entries[:middle], entries[middle:])):
        write_bag(tmp_path / "split" / f"drive_{number}.bag", part, maker)
    split = datasets.read(tmp_path / "split")
    np.testing.assert_array_equal(scans_of(split).ranges_m, scans_of(whole).ranges_m)
    np.testing.assert_array_equal(scans_of(split).T_base_lidar, scans_of(whole).T_base_lidar)
    assert split.odometry is not None
    assert whole.odometry is not None
    np.testing.assert_array_equal(split.odometry.poses, whole.odometry.poses)
    np.testing.assert_array_equal(next(split.images[0].images()), pixels)
    assert "the folder's 2 bags are read as one recording" in split.remarks


def test_a_bag_of_old_storage_without_message_definitions_is_read(tmp_path: Path) -> None:
    folder = store_as("sqlite3", tmp_path, robot(maker_of("sqlite3")))
    with contextlib.closing(sqlite3.connect(next(folder.glob("*.db3")))) as database:
        database.executescript(
            "DROP TABLE schema; DROP TABLE metadata; DROP TABLE message_definitions;"
            "ALTER TABLE topics DROP COLUMN type_description_hash;"
        )
    log = datasets.read(folder)
    np.testing.assert_array_equal(scans_of(log).ranges_m, seen(range(COUNT)))
    assert log.odometry is not None


def test_odometry_comes_from_the_frame_tree_where_no_topic_tells_it(tmp_path: Path) -> None:
    maker = Maker(ros2=False)
    entries = [entry for entry in robot(maker) if entry[0] != "/odom"]
    for k in range(COUNT):
        x, y, yaw = xyt_at(k)
        moving = maker.transform(stamp_at(k), "/odom", "base_footprint", (x, y, 0), (0, 0, yaw))
        entries.append(("/tf", TF, stamp_at(k), maker.transforms(moving)))
    entries.sort(key=lambda entry: entry[2])
    log = read_entries(tmp_path, entries, "ros1")
    assert log.odometry is not None
    np.testing.assert_allclose(
        log.odometry.poses, [pose_from_xyt(np.array(xyt_at(k))) for k in range(COUNT)], atol=1e-12
    )
    assert any("taken from the frame tree: base_footprint in odom, 20 poses" in each for each in log.remarks)
    assert read_entries(tmp_path / "none", entries, "ros1", odom="none").odometry is None


def test_a_topic_and_a_base_can_be_chosen(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    entries = robot(maker)
    for k in range(COUNT):
        entries.append(("/rear/scan", SCAN, stamp_at(k) + 1, maker.scan(stamp_at(k), ranges_at(k, 31), "rear_laser")))
        entries.append(("/ekf/odom", ODOM, stamp_at(k) + 1, maker.odometry(stamp_at(k), (float(k), 0, 0), "base_link")))
    entries.sort(key=lambda entry: entry[2])
    bag = store_as("sqlite3", tmp_path, entries)
    assert scans_of(datasets.read(bag)).beams == 61
    chosen = datasets.read(bag, topics={"scan": "rear/scan", "odom": "/ekf/odom", "base": "base_link", "imu": "none"})
    assert scans_of(chosen).beams == 31
    assert chosen.imu is None
    assert chosen.odometry is not None
    assert chosen.odometry.path_length_m == pytest.approx(COUNT - 1)
    assert any("(rear_laser) is on base_link: at its centre" in remark for remark in chosen.remarks)
    assert any(
        "also there: /odom (Odometry, 20), /scan" in remark.replace("/imu/data (Imu, 20), ", "")
        for remark in chosen.remarks
    )


def test_odometry_of_another_frame_is_carried_to_the_base(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    links = maker.transforms(
        maker.transform(0, "base_footprint", "base_link", (0.5, 0, 0), (0, 0, 0)),
        maker.transform(0, "base_link", "laser", (0, 0, 0), (0, 0, 0)),
    )
    entries: list[Entry] = [("/tf_static", TF, START_NS, links)]
    for k in range(COUNT):
        entries.append(("/scan", SCAN, stamp_at(k), maker.scan(stamp_at(k), ranges_at(k))))
        entries.append(("/odom", ODOM, stamp_at(k), maker.odometry(stamp_at(k), (0, 0, 0.1 * k), "base_link")))
    log = read_entries(tmp_path, entries, base="base_footprint")
    assert log.odometry is not None
    at = log.odometry.positions
    np.testing.assert_allclose(at, [[-0.5 * np.cos(0.1 * k), -0.5 * np.sin(0.1 * k)] for k in range(COUNT)], atol=1e-12)


def test_a_laser_that_hangs_upside_down_is_turned_upright(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    T = mounting((0.1, 0.0, 0.4), (np.pi, 0.0, 0.3))
    links = maker.transforms(maker.transform(0, "base_link", "laser", (0.1, 0.0, 0.4), (np.pi, 0.0, 0.3)))
    entries: list[Entry] = [("/tf_static", TF, START_NS, links)]
    ranges = np.linspace(1.0, 4.0, 61)
    entries += [("/scan", SCAN, stamp_at(k), maker.scan(stamp_at(k), ranges)) for k in range(3)]
    scans = scans_of(read_entries(tmp_path, entries))
    angles = -1.5 + 3.0 / 60 * np.arange(61)
    points = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(61), np.ones(61)]) @ T.T
    upright = np.column_stack([scans.points(0), np.zeros(61), np.ones(61)]) @ scans.T_base_lidar.T
    assert scans.T_base_lidar[2, 2] == pytest.approx(1.0)
    np.testing.assert_allclose(upright[::-1], points, atol=1e-5)


def test_scans_whose_geometry_varies_are_put_on_the_commonest(tmp_path: Path) -> None:
    maker = Maker(ros2=False)
    entries: list[Entry] = []
    for k in range(50):
        beams = 61 if k % 5 else 59 + k % 3
        angles = -1.5 + 3.0 / (beams - 1) * np.arange(beams)
        entries.append(("/scan", SCAN, stamp_at(k), maker.scan(stamp_at(k), 4 + np.sin(angles))))
    entries.append(("/scan", SCAN, stamp_at(50), maker.scan(stamp_at(50), np.zeros(0))))
    log = read_entries(tmp_path, entries, "ros1")
    scans = scans_of(log)
    assert scans.ranges_m.shape == (50, 61)
    step = 3.0 / 58
    assert np.abs(scans.ranges_m - (4 + np.sin(scans.angles_rad))).max() < 0.51 * step
    assert any("1 messages of /scan have no beams" in remark for remark in log.remarks)
    assert any("have other beam angles" in remark for remark in log.remarks)


@pytest.mark.parametrize("turn", [0.0, 2 * np.pi, -2 * np.pi])
def test_nearest_beams_knows_bearings_a_turn_away(turn: float) -> None:
    assert nearest_beams((5, -1.0, 0.5), (5, -1.0 + turn, 0.5)).tolist() == [0, 1, 2, 3, 4]
    assert nearest_beams((5, -1.0, 0.5), (3, -0.5 + turn, 0.5)).tolist() == [-1, 0, 1, 2, -1]
    assert nearest_beams((5, -1.0, 0.5), (5, 1.0 + turn, -0.5)).tolist() == [4, 3, 2, 1, 0]


def test_the_first_echo_of_each_beam_counts(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    kind = "sensor_msgs/msg/MultiEchoLaserScan"
    entries: list[Entry] = [("/scan", kind, stamp_at(k), maker.echoes(stamp_at(k), ranges_at(k))) for k in range(3)]
    scans = scans_of(read_entries(tmp_path, entries))
    np.testing.assert_array_equal(scans.ranges_m, seen(range(3)))


def test_clouds_become_planar_scans_of_what_stands_at_the_height_of_the_sensor(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    pitch = 0.1
    links = maker.transforms(maker.transform(0, "base_link", "velodyne", (0.2, 0, 0.5), (0, pitch, 0)))
    bearing = np.linspace(-np.pi, np.pi, 4000, endpoint=False)
    wall = np.concatenate([np.column_stack([5 * np.cos(bearing), 5 * np.sin(bearing), np.full(4000, z)])
                           for z in (-0.1, 0.0, 0.1)])  # fmt: skip
    floor = np.column_stack([2 * np.cos(bearing), 2 * np.sin(bearing), np.full(4000, -0.5)])
    lamp = np.array([[1.0, 0.0, 1.0]])
    pole = np.array([[0.0, 3.0, 0.05], [np.nan, 0, 0]])
    level = np.concatenate([wall, floor, lamp, pole])
    points = level @ mounting((0, 0, 0), (0, pitch, 0))[:3, :3]  # as the tilted sensor sees them
    kind = "sensor_msgs/msg/PointCloud2"
    entries: list[Entry] = [("/tf_static", TF, START_NS, links)]
    entries += [("/points", kind, stamp_at(k), maker.cloud(stamp_at(k), points)) for k in range(3)]
    scans = scans_of(read_entries(tmp_path, entries))
    assert scans.ranges_m.shape == (3, CLOUD_BEAMS)
    np.testing.assert_allclose(scans.T_base_lidar, mounting((0.2, 0, 0.5), (0, 0, 0)), atol=1e-12)
    hit = np.abs(scans.angles_rad - np.pi / 2) < 0.001
    assert scans.ranges_m[0, hit] == pytest.approx([3.0], abs=1e-3)
    np.testing.assert_allclose(scans.ranges_m[0, ~hit], 5.0, atol=1e-4)


def test_a_slice_leaves_the_floor_out_only_where_its_height_is_known() -> None:
    points = np.array([[2.0, 0.0, -0.15]])
    T = mounting((0, 0, 0.2), (0, 0, 0))
    assert np.isinf(planar_slice(points, T)).all()
    assert np.isfinite(planar_slice(points, np.eye(4))).sum() == 1


@pytest.mark.parametrize("storage", ["ros1_lz4", "sqlite3", "mcap"])
def test_images_are_found_by_stamp_and_read_on_demand(storage: str, tmp_path: Path) -> None:
    maker = maker_of(storage)
    rng = np.random.default_rng(2)
    pictures = rng.integers(0, 255, (5, 4, 6, 3), dtype=np.uint8)
    K = np.array([[500.0, 0, 3], [0, 500, 2], [0, 0, 1]])
    name, info = "/camera/color/image_raw", "/camera/color/camera_info"
    entries = robot(maker, 5)
    entries.append((info, "sensor_msgs/msg/CameraInfo", START_NS, maker.camera(START_NS, K)))
    for k in range(5):
        at = START_NS + (k // 2) * 100_000_000  # two and two recorded at the same nanosecond
        entries.append((name, "sensor_msgs/msg/Image", at, maker.image(stamp_at(k), pictures[k], "bgr8", pad=2)))
        png = cv2.imencode(".png", pictures[k])[1].tobytes()
        entries.append(
            (f"{name}/compressed", "sensor_msgs/msg/CompressedImage", at, maker.compressed(stamp_at(k), png, "png"))
        )
    entries.sort(key=lambda entry: entry[2])
    log = read_entries(tmp_path, entries, storage)
    assert [camera.name for camera in log.images] == [name, f"{name}/compressed"]
    for camera in log.images:
        np.testing.assert_allclose(camera.stamps_s, [stamp_at(k) * 1e-9 for k in range(5)], atol=1e-6)
        assert camera.frame == "camera_optical"
        assert camera.calibration is not None
        np.testing.assert_array_equal(camera.calibration.K, K)
        found = list(camera.images(np.array([4, 1, 0])))
        for image, k in zip(found, (4, 1, 0), strict=True):
            np.testing.assert_array_equal(image, pictures[k][..., ::-1])
    if storage == "mcap":
        only = datasets.read(log.path, topics={"image": name})
        assert [camera.name for camera in only.images] == [name]
        assert len(list(only.images[0].images())) == 5
        assert datasets.read(log.path, topics={"image": "none"}).images == ()


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("mono8", np.arange(12, dtype=np.uint8).reshape(3, 4)),
        ("16UC1", np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000),
        ("32FC1", np.arange(12, dtype=np.float32).reshape(3, 4) / 7),
        ("rgb8", np.arange(36, dtype=np.uint8).reshape(3, 4, 3)),
    ],
)
def test_pixels_keep_their_type(encoding: str, pixels: np.ndarray, tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    entries: list[Entry] = [("/depth", "sensor_msgs/msg/Image", START_NS, maker.image(START_NS, pixels, encoding))]
    (camera,) = read_entries(tmp_path, entries).images
    (image,) = camera.images()
    assert image.dtype == pixels.dtype
    np.testing.assert_array_equal(image, pixels)


def test_bayer_patterns_become_colour(tmp_path: Path) -> None:
    mosaic = np.zeros((8, 8), np.uint8)
    mosaic[::2, ::2] = 200  # red alone
    maker = Maker(ros2=True)
    entries: list[Entry] = [("/raw", "sensor_msgs/msg/Image", START_NS, maker.image(START_NS, mosaic, "bayer_rggb8"))]
    (camera,) = read_entries(tmp_path, entries).images
    (image,) = camera.images()
    assert image[2:6, 2:6].reshape(-1, 3).mean(axis=0).tolist() == [200.0, 0.0, 0.0]


@pytest.mark.parametrize("ros2", [False, True])
def test_headers_are_read_without_the_pixels(ros2: bool) -> None:
    maker = Maker(ros2=ros2)
    message = maker.image(START_NS + 7, np.zeros((2, 2), np.uint8), "mono8", frame="eye")
    serialize = maker.store.serialize_cdr if ros2 else maker.store.serialize_ros1
    assert read_header(bytes(serialize(message, "sensor_msgs/msg/Image")), is_ros2=ros2) == (START_NS + 7, "eye")


def test_true_poses_are_told_by_the_name_of_their_topic(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    entries = robot(maker)
    for k in range(COUNT):
        entries.append(("/ground_truth/odom", ODOM, stamp_at(k), maker.odometry(stamp_at(k), (2.0 * k, 0, 0))))
    log = read_entries(tmp_path, entries)
    assert log.truth is not None
    assert (log.truth.parent, log.truth.path_length_m) == ("ref", pytest.approx(2.0 * (COUNT - 1)))
    assert log.odometry is not None
    assert log.odometry.path_length_m < 3


def test_stamps_are_those_of_the_headers_even_of_another_clock(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    entries: list[Entry] = [
        ("/scan", SCAN, stamp_at(k), maker.scan(k * 100_000_000 + 5, ranges_at(k))) for k in range(3)
    ]
    log = read_entries(tmp_path, entries)
    np.testing.assert_allclose(scans_of(log).stamps_s, [0.0, 0.1, 0.2], atol=1e-7)
    assert any("simulated time" in remark for remark in log.remarks)


def test_messages_without_stamps_take_the_time_of_recording(tmp_path: Path) -> None:
    maker = Maker(ros2=False)
    entries: list[Entry] = [("/scan", SCAN, stamp_at(k), maker.scan(0, ranges_at(k))) for k in range(3)]
    log = read_entries(tmp_path, entries, "ros1")
    np.testing.assert_allclose(scans_of(log).stamps_s, [stamp_at(k) * 1e-9 for k in range(3)], atol=1e-6)
    assert any("carry no stamps" in remark for remark in log.remarks)


def test_messages_that_overtook_each_other_are_put_in_order(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    order = [0, 2, 1, 3]
    entries: list[Entry] = [
        ("/scan", SCAN, START_NS + at * LATENCY_NS, maker.scan(stamp_at(k), ranges_at(k))) for at, k in enumerate(order)
    ]
    log = read_entries(tmp_path, entries)
    np.testing.assert_array_equal(scans_of(log).ranges_m, seen(range(4)))
    assert any("1 messages of /scan are out of order" in remark for remark in log.remarks)


def test_rows_grow_over_many_blocks() -> None:
    width = CHUNK_BYTES // 8 // 3
    rows = GrowingRows((width,))
    for k in range(10):
        rows.append(np.full(width, k))
    assert len(rows) == 10
    np.testing.assert_array_equal(rows.take()[:, 0], np.arange(10))
    assert len(rows) == 0
    assert rows.take().shape == (0, width)


@pytest.mark.parametrize("storage", ["ros1", "sqlite3", "mcap"])
def test_reading_holds_no_more_of_a_longer_bag_in_memory(storage: str, tmp_path: Path) -> None:
    maker = maker_of(storage)
    pixels, points = np.zeros((700, 700), np.uint8), np.ones((10_000, 3))
    peaks = []
    for count in (3, 15):
        entries: list[Entry] = []
        for k in range(count):
            entries.append(("/image", "sensor_msgs/msg/Image", stamp_at(k), maker.image(stamp_at(k), pixels, "mono8")))
            cloud = maker.cloud(stamp_at(k), points, "laser")
            entries.append(("/points", "sensor_msgs/msg/PointCloud2", stamp_at(k), cloud))
        path = store_as(storage, tmp_path / str(count), entries)
        del entries
        tracemalloc.start()
        log = datasets.read(path)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert len(log.images[0]) == len(scans_of(log)) == count
    assert peaks[1] - peaks[0] < 2e6, f"{peaks} bytes at most while 2 and 10 MB are read"
