"""What cannot be read from a bag ends with one line that names file and topic and lists what is there."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from posegraph_slam import datasets
from posegraph_slam.datasets.rosbag.topics import parse_topics
from posegraph_slam.errors import InputError

from .bag_writing import START_NS, Entry, Maker, maker_of, ranges_at, robot, stamp_at, store_as

SCAN, ODOM = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"


def refused(path: Path, **topics: str) -> str:
    with pytest.raises(InputError) as caught:
        datasets.read(path, topics=topics)
    text = str(caught.value)
    assert str(path) in text
    assert "\n" not in text
    return text


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store_as("mcap", tmp_path_factory.mktemp("bag"), robot(maker_of("mcap")))


def test_a_missing_topic_lists_what_is_there(bag: Path) -> None:
    text = refused(bag, scan="/scann")
    assert "no topic /scann for 'scan'; did you mean '/scan'?" in text
    assert "/chatter (String, 20)" in text
    assert "/odom (Odometry, 20)" in text


def test_a_topic_of_another_type_says_what_fits(bag: Path) -> None:
    text = refused(bag, scan="/odom")
    assert "/odom is a nav_msgs/msg/Odometry, which gives no 'scan'" in text
    assert "LaserScan, MultiEchoLaserScan, PointCloud2" in text


def test_an_unknown_base_lists_the_frames(bag: Path) -> None:
    assert "no frame chassis; the frames of its tree are base_footprint, base_link, laser" in refused(
        bag, base="chassis"
    )


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("scna=/scan", "did you mean 'scan'"),
        ("scan", "not of the form ROLE=NAME"),
        ("scan=", "not of the form"),
        ("wheels=/w", "roles are scan, odom, imu"),
    ],
)
def test_roles_are_checked(text: str, part: str) -> None:
    with pytest.raises(InputError, match=part):
        parse_topics([text])


def test_a_format_without_topics_says_so(tmp_path: Path, log_builder) -> None:
    with pytest.raises(InputError, match="a carmen log has no topics"):
        datasets.read(log_builder("carmen", tmp_path), topics={"scan": "/scan"})


@pytest.mark.parametrize("storage", ["ros1", "ros1_lz4", "sqlite3", "mcap", "sqlite3_file_zstd"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.97])
def test_a_truncated_bag_is_named(storage: str, share: float, tmp_path: Path) -> None:
    path = store_as(storage, tmp_path, robot(maker_of(storage), 200))
    file = path if path.is_file() else next(each for each in path.iterdir() if each.suffix != ".yaml")
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])
    text = refused(path)
    assert "truncated" in text
    assert "reindex" in text


def test_bytes_that_are_no_message_name_their_topic(tmp_path: Path) -> None:
    path = store_as("ros1", tmp_path, robot(Maker(ros2=False), 3))
    content = path.read_bytes()
    at = content.index(b"laser", content.index(np.float32(20.0).tobytes()) - 60)
    # the length of the frame's name: beyond the end of the message
    path.write_bytes(content[: at - 4] + (1 << 30).to_bytes(4, "little") + content[at:])
    text = refused(path)
    assert "topic /scan: message" in text
    assert "/odom (Odometry, 3)" in text


def test_a_clock_that_jumps_back_is_named(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    stamps = [*range(5), *range(-100, -95)]
    entries: list[Entry] = [
        ("/scan", SCAN, stamp_at(k), maker.scan(stamp_at(at), ranges_at(k))) for k, at in enumerate(stamps)
    ]
    text = refused(store_as("mcap", tmp_path, entries))
    assert "topic /scan: the clock jumps back by 10.400 s after message 4" in text


def test_streams_of_two_clocks_are_refused(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    entries: list[Entry] = []
    for k in range(5):
        entries.append(("/scan", SCAN, stamp_at(k), maker.scan(stamp_at(k), ranges_at(k))))
        entries.append(("/odom", ODOM, stamp_at(k), maker.odometry(k * 10**8, (0, 0, 0))))
    path = store_as("sqlite3", tmp_path, entries)
    text = refused(path)
    assert "topic /odom covers 0.0 to 0.4 s" in text
    assert "--topic odom=none" in text
    assert datasets.read(path, topics={"odom": "none"}).odometry is None


def test_a_bag_without_anything_to_read_lists_its_topics(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    entries: list[Entry] = [("/chatter", "std_msgs/msg/String", START_NS, maker.text("hello"))]
    assert "/chatter (String, 1)" in refused(store_as("mcap", tmp_path, entries))


def test_an_image_of_an_unknown_encoding_is_named(tmp_path: Path) -> None:
    maker = Maker(ros2=True)
    message = maker.image(START_NS, np.zeros((2, 2), np.uint8), "yuv422")
    path = store_as("mcap", tmp_path, [("/cam", "sensor_msgs/msg/Image", START_NS, message)])
    (camera,) = datasets.read(path).images
    with pytest.raises(InputError, match="topic /cam: image 0: has the encoding yuv422"):
        list(camera.images())
    with pytest.raises(InputError, match="has 1 images"):
        camera.images(np.array([1]))


def test_metadata_without_counts_are_refused(tmp_path: Path) -> None:
    folder = store_as("mcap", tmp_path, robot(maker_of("mcap")))
    metadata = folder / "metadata.yaml"
    metadata.write_text(re.sub(r"message_count: 20", "message_count: many", metadata.read_text()))
    assert "cannot be opened as a bag" in refused(folder)


def test_what_the_bag_library_quotes_is_cut(tmp_path: Path) -> None:
    folder = store_as("mcap", tmp_path, robot(maker_of("mcap")))
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(".mcap", ".mcap" + 9000 * "x"))
    assert len(refused(folder)) < 1000
