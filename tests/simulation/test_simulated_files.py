"""The folder on disk: layout, reproducible bytes, refusals, and what the reader makes of it."""

from __future__ import annotations

import hashlib
import json
import re

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from posegraph_slam.datasets import ece276a
from posegraph_slam.datasets.simulation import KinectSettings, drive, simulate, tiny_settings
from posegraph_slam.errors import InputError


def digest(folder):
    """Name and SHA-256 of every file."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return simulate(tiny_settings(images=True), tmp_path_factory.mktemp("logs") / "tiny")


def test_same_settings_give_the_same_bytes(written, tmp_path):
    again = simulate(tiny_settings(images=True), tmp_path / "again")
    assert digest(again) == digest(written)
    other = digest(simulate(tiny_settings(images=True, seed=5), tmp_path / "other"))
    assert all(other.get(name) != value for name, value in digest(written).items())


def test_nothing_unfinished_stays(written):
    assert [entry.name for entry in written.parent.iterdir()] == ["tiny"]


def test_reader_gives_what_drive_gives(written):
    read, driven = ece276a.read(written), drive(tiny_settings())
    np.testing.assert_array_equal(read.scans.ranges_m, driven.scans.ranges_m)
    np.testing.assert_array_equal(read.scans.stamps_s, driven.scans.stamps_s)
    np.testing.assert_allclose(read.scans.angles_rad, driven.scans.angles_rad, atol=1e-12)
    np.testing.assert_array_equal(read.scans.T_base_lidar, driven.scans.T_base_lidar)
    np.testing.assert_array_equal(read.encoders.travel_m, driven.encoders.travel_m)
    np.testing.assert_array_equal(read.encoders.ticks_right, driven.encoders.ticks_right)
    np.testing.assert_allclose(read.imu.angular_velocity, driven.imu.angular_velocity)
    np.testing.assert_allclose(read.imu.linear_acceleration, driven.imu.linear_acceleration)
    np.testing.assert_allclose(read.truth.poses, driven.truth.poses, atol=1e-6)
    np.testing.assert_allclose(read.truth.stamps_s, driven.truth.stamps_s, atol=1e-6)
    assert read.rgbd.has_images
    assert all(read.rgbd.disparity_files)
    assert all(read.rgbd.colour_files)
    np.testing.assert_array_equal(read.rgbd.disparity_stamps_s, driven.rgbd.disparity_stamps_s)


def test_images_have_the_kinects_form(written):
    stamps = np.load(written / "Kinect1.npz")
    for name, key, shape, dtype in (
        ("Disparity1/disparity1", "disparity_time_stamps", (480, 640), np.uint16),
        ("RGB1/rgb1", "rgb_time_stamps", (480, 640, 3), np.uint8),
    ):
        for k in range(1, len(stamps[key]) + 1):
            image = cv2.imread(str(written / "dataRGBD" / f"{name}_{k}.png"), cv2.IMREAD_UNCHANGED)
            assert (image.shape, image.dtype) == (shape, dtype)
            assert image.max() > 0


def test_floor_file_is_placed_by_world_file(written):
    world = json.loads((written / "world.json").read_text())
    image = cv2.imread(str(written / "floor.png"))
    size = np.array(image.shape[1::-1]) * world["floor"]["resolution_m"]
    assert world["floor"]["origin_m"] == world["lower_m"]
    assert (np.abs(size - np.subtract(world["upper_m"], world["lower_m"])) <= world["floor"]["resolution_m"]).all()
    corridor, room = image[-10, 20].astype(int), image[image.shape[0] // 2, image.shape[1] // 2].astype(int)
    assert np.abs(corridor - room).max() > 10


def test_existing_folders_are_kept(written, tmp_path):
    before = digest(written)
    with pytest.raises(InputError, match=r"exists and is not empty"):
        simulate(tiny_settings(), written)
    assert digest(written) == before
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match=r"other things"):
        simulate(tiny_settings(), foreign, overwrite=True)
    assert (foreign / "thesis.txt").read_text() == "mine"
    with pytest.raises(InputError, match=r"is a file"):
        simulate(tiny_settings(), foreign / "thesis.txt")


def test_overwriting_and_empty_folders_work(tmp_path):
    folder = tmp_path / "log"
    folder.mkdir()
    simulate(tiny_settings(duration_s=3.0), folder)
    first = digest(folder)
    simulate(tiny_settings(duration_s=4.0), folder, overwrite=True)
    assert digest(folder) != first
    assert not (folder / "dataRGBD").exists()


def test_impossible_settings_are_refused_by_name():
    with pytest.raises(ValidationError, match="range_min_m"):
        KinectSettings(range_min_m=7.0)
    with pytest.raises(ValidationError, match="beams"):
        tiny_settings().lidar.__class__(beams=1)


@pytest.mark.data
def test_layout_equals_the_real_log(written, psg_data):
    """Same keys, types and numbers of dimensions in every file as in the recorded run."""
    real = psg_data / "ece276a" / "20"
    names = [{re.sub(r"\d+", "", entry.name) for entry in folder.iterdir()} for folder in (real, written)]
    assert names[0] <= names[1]
    for stream in ("Encoders", "Imu", "Hokuyo", "Kinect"):
        with np.load(real / f"{stream}20.npz") as a, np.load(written / f"{stream}1.npz") as b:
            assert sorted(a.files) == sorted(b.files)
            for key in a.files:
                assert (a[key].dtype, a[key].ndim) == (b[key].dtype, b[key].ndim), (stream, key)
                assert a[key].shape[0:1] == b[key].shape[0:1] or key.endswith(("stamps", "ranges"))
            if stream == "Hokuyo":
                for key in ("angle_min", "angle_max", "range_min", "range_max"):
                    assert a[key] == pytest.approx(b[key], abs=1e-6)
    lines = [path.read_text().splitlines() for path in (real / "truth20.tum", written / "truth1.tum")]
    rows = [[line for line in each if not line.startswith("#")] for each in lines]
    assert {len(row.split()) for row in rows[0]} == {len(row.split()) for row in rows[1]} == {8}
