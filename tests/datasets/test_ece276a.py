from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from posegraph_slam import datasets
from posegraph_slam.errors import InputError
from posegraph_slam.sensors import STANDARD_GRAVITY

Writer = Callable[..., Path]


def test_wheels_ranges_and_imu_arrive_in_their_places(ece276a_log: Writer, tmp_path: Path) -> None:
    counts = np.array([[1], [2], [3], [4]], dtype=np.int16) * np.arange(12, dtype=np.int16)  # FR FL RR RL
    log = datasets.read(ece276a_log(tmp_path, Encoders__counts=counts))
    assert log.encoders is not None
    assert log.scans is not None
    assert log.imu is not None
    np.testing.assert_array_equal(log.encoders.ticks_right[2], [2, 6])
    np.testing.assert_array_equal(log.encoders.ticks_left[2], [4, 8])
    np.testing.assert_allclose(log.encoders.travel_m[2], [0.0022 * 6, 0.0022 * 4])
    with np.load(tmp_path / "Hokuyo7.npz") as stored:
        np.testing.assert_array_equal(log.scans.ranges_m, stored["ranges"].T)
    np.testing.assert_allclose(log.scans.angles_rad[[0, -1]], np.deg2rad([-135, 135]))
    assert (log.scans.range_min_m, log.scans.range_max_m) == (0.1, 30.0)
    assert not log.scans.returns()[0, :2].any(), "a dropout (0.001) and a no-return (60) lie outside"
    assert log.scans.returns().sum() == log.scans.ranges_m.size - 2
    np.testing.assert_array_equal(log.scans.T_base_lidar[:, 3], [0.133, 0, 0.514, 1])
    np.testing.assert_allclose(log.imu.linear_acceleration[:, 2].mean(), 1.01 * STANDARD_GRAVITY, rtol=0.01)
    assert any("from g to m/s^2" in remark for remark in log.remarks)


def test_the_camera_looks_ahead_and_down(ece276a_log: Writer, tmp_path: Path) -> None:
    rgbd = datasets.read(ece276a_log(tmp_path)).rgbd
    assert rgbd is not None
    np.testing.assert_array_equal(rgbd.T_base_camera[:3, 3], [0.18, 0.005, 0.36])
    pitch, yaw = 0.36, 0.021
    ahead = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)]
    np.testing.assert_allclose(rgbd.T_base_camera[:3, 0], ahead, atol=1e-15)
    assert rgbd.T_base_camera[2, 1] == pytest.approx(0.0, abs=1e-15), "no roll"


def test_accelerations_in_si_units_are_left_alone(ece276a_log: Writer, tmp_path: Path) -> None:
    acceleration = np.tile([[0.0], [0.1], [9.7]], 48)
    log = datasets.read(ece276a_log(tmp_path, Imu__linear_acceleration=acceleration))
    assert log.imu is not None
    np.testing.assert_array_equal(log.imu.linear_acceleration, acceleration.T)
    assert any("m/s^2 already" in remark for remark in log.remarks)


@pytest.mark.parametrize("dtype", [np.int16, np.int64, np.float32, np.float64])
def test_counts_of_any_numeric_type_are_ticks(dtype: Any, ece276a_log: Writer, tmp_path: Path) -> None:
    counts = np.arange(48).reshape(4, 12).astype(dtype) - 5
    encoders = datasets.read(ece276a_log(tmp_path, Encoders__counts=counts)).encoders
    assert encoders is not None
    assert encoders.ticks_left.dtype == np.int64
    np.testing.assert_array_equal(encoders.ticks_left[:, 1], counts[3])


@pytest.mark.parametrize("missing", ["Encoders", "Imu", "Hokuyo", "Kinect"])
def test_any_stream_may_be_missing(missing: str, ece276a_log: Writer, tmp_path: Path) -> None:
    log = datasets.read(ece276a_log(tmp_path, **{missing: None}))
    streams = {"Encoders": log.encoders, "Imu": log.imu, "Hokuyo": log.scans, "Kinect": log.rgbd}
    assert {name for name, stream in streams.items() if stream is None} == {missing}
    assert any(f"there is no {missing}7.npz" in remark for remark in log.remarks) == (missing != "Kinect")


def test_nan_ranges_count_as_no_return(ece276a_log: Writer, tmp_path: Path) -> None:
    ranges = np.full((31, 12), 2.0, dtype=np.float32)
    ranges[3, 4], ranges[5, 6] = np.nan, np.inf
    log = datasets.read(ece276a_log(tmp_path, Hokuyo__ranges=ranges))
    assert log.scans is not None
    assert not log.scans.returns()[[4, 6], [3, 5]].any()
    assert log.scans.returns().sum() == ranges.size - 2
    assert any(remark.startswith("2 of 372 ranges are NaN") for remark in log.remarks)


STAMPS = 100.0 + 0.025 * np.arange(12)
BACKWARDS = STAMPS - 0.1 * (np.arange(12) >= 5)
NOT_FINITE = np.where(np.arange(12) == 3, np.nan, STAMPS)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"Encoders__counts": None}, r"Encoders7\.npz: has no field 'counts'; it holds time_stamps"),
        ({"Encoders__counts": np.zeros((12, 4))}, r"'counts' has shape \(12, 4\); expected \(4, 12\)"),
        ({"Encoders__counts": np.zeros((4, 11))}, r"'counts' has shape \(4, 11\)"),
        ({"Encoders__counts": np.full((4, 12), 0.5)}, "'counts' at index 0 is not a whole number"),
        ({"Encoders__counts": np.full((4, 12), np.nan)}, "'counts' is not finite at index 0"),
        ({"Encoders__counts": np.full((4, 12), 2**63, np.uint64)}, r"'counts' at index 0 is 9\.22337e\+18 ticks"),
        ({"Imu__linear_acceleration": np.full((3, 48), 1e300)}, r"'linear_acceleration' is beyond 1e\+30 at index 0"),
        ({"Encoders__counts": np.full((4, 12), "a")}, "'counts' is <U1, not a number"),
        ({"Encoders__counts": np.full((4, 12), None)}, r"Encoders7\.npz: cannot be read as an \.npz archive"),
        ({"Encoders__time_stamps": NOT_FINITE}, r"Encoders7\.npz: field 'time_stamps' is not finite at index 3"),
        (
            {"Encoders__time_stamps": BACKWARDS},
            r"Encoders7\.npz: the clock in 'time_stamps' runs backwards at index 5: 100\.100000 s, then 100\.025000 s",
        ),
        ({"Encoders__time_stamps": np.empty(0)}, r"'time_stamps' has shape \(0,\)"),
        ({"Imu__angular_velocity": np.zeros((48, 3))}, r"Imu7\.npz: field 'angular_velocity' has shape \(48, 3\)"),
        (
            {"Imu__linear_acceleration": np.full((3, 48), np.inf)},
            r"Imu7\.npz: field 'linear_acceleration' is not finite",
        ),
        ({"Imu__time_stamps": np.arange(48.0)[::-1]}, r"Imu7\.npz: the clock .* runs backwards at index 1"),
        ({"Hokuyo__time_stamps": BACKWARDS}, r"Hokuyo7\.npz: the clock .* at index 5: 100\.100000 s"),
        ({"Hokuyo__ranges": np.ones((12, 31))}, r"Hokuyo7\.npz: field 'ranges' has shape \(12, 31\)"),
        ({"Hokuyo__ranges": np.ones((60, 12))}, r"60 beams of .* do not end at angle_max"),
        ({"Hokuyo__ranges": np.ones(12)}, r"'ranges' has shape \(12,\)"),
        ({"Hokuyo__range_max": np.array(0.05)}, "range_min 0.1 and range_max 0.05 leave no range"),
        ({"Hokuyo__angle_min": np.array([1.0, 2.0])}, r"'angle_min' \(2,\) is not one finite number"),
        ({"Hokuyo__angle_increment": np.array(0.0)}, "do not end at angle_max"),
        ({"Kinect__rgb_time_stamps": None}, r"Kinect7\.npz: has no field 'rgb_time_stamps'"),
    ],
)
def test_bad_input_is_named(change: dict[str, Any], problem: str, ece276a_log: Writer, tmp_path: Path) -> None:
    folder = ece276a_log(tmp_path, **change)
    with pytest.raises(InputError, match=problem) as caught:
        datasets.read(folder)
    assert str(tmp_path) in caught.value.where
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("keep", [0, 1, 40, 300, 0.5, 0.99])
@pytest.mark.parametrize("name", ["Encoders7.npz", "Imu7.npz", "Hokuyo7.npz", "Kinect7.npz"])
def test_a_truncated_archive_is_named(name: str, keep: float, ece276a_log: Writer, tmp_path: Path) -> None:
    file = ece276a_log(tmp_path) / name
    content = file.read_bytes()
    file.write_bytes(content[: int(keep * len(content)) if isinstance(keep, float) else keep])
    with pytest.raises(InputError, match=rf"{name}: cannot be read as an \.npz archive .*truncated"):
        datasets.read(tmp_path)


def test_a_corrupted_archive_is_named(ece276a_log: Writer, tmp_path: Path) -> None:
    file = ece276a_log(tmp_path) / "Hokuyo7.npz"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"Hokuyo7\.npz: cannot be read"):
        datasets.read(tmp_path)


def test_one_run_of_several_is_named_by_its_file(ece276a_log: Writer, tmp_path: Path) -> None:
    ece276a_log(tmp_path, run="20", scans=10)
    ece276a_log(tmp_path, run="21", scans=11)
    with pytest.raises(InputError, match=r"holds several runs \(20, 21\); give a file .* Encoders20\.npz"):
        datasets.read(tmp_path)
    scans = datasets.read(tmp_path / "Encoders21.npz").scans
    assert scans is not None
    assert len(scans) == 11


def test_the_run_may_have_no_number_and_the_folder_no_log(ece276a_log: Writer, tmp_path: Path) -> None:
    assert datasets.read(ece276a_log(tmp_path / "a", run="")).encoders is not None
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "notes.md").touch()
    with pytest.raises(InputError, match="holds no Encoders"):
        datasets.read(tmp_path / "b", format="ece276a")


def test_streams_of_unequal_length_are_remarked(ece276a_log: Writer, tmp_path: Path) -> None:
    log = datasets.read(ece276a_log(tmp_path, scans=100, Imu__time_stamps=1298445275.5 + 0.0025 * np.arange(400)))
    assert "the imu stream starts 1.00 s after and ends 0.48 s before the scans stream" in log.remarks


def test_truth_beside_the_log_is_read(ece276a_log: Writer, tmp_path: Path) -> None:
    ece276a_log(tmp_path)
    (tmp_path / "truth7.tum").write_text("1 2 3 0 0 0 0 1\n")
    truth = datasets.read(tmp_path).truth
    assert truth is not None
    assert (truth.parent, truth.child) == ("ref", "base")
    np.testing.assert_array_equal(truth.positions, [[2, 3, 0]])


@pytest.mark.parametrize(
    ("disparity", "colour"),
    [
        ("dataRGBD/Disparity7/disparity7_{}.png", "dataRGBD/RGB7/rgb7_{}.png"),
        ("Disparity7/disparity7_{}.png", "RGB7/rgb7_{}.png"),
        ("disparity/disparity_{}.png", "rgb/rgb_{}.png"),
        ("../dataRGBD/Disparity7/disparity7_{}.png", "../dataRGBD/RGB7/rgb7_{}.png"),
        ("disparity7_{}.png", "rgb7_{}.png"),
        ("disparity{}.png", "RGB{}.PNG"),
    ],
)
def test_frames_are_found_by_their_number(disparity: str, colour: str, ece276a_log: Writer, tmp_path: Path) -> None:
    folder = ece276a_log(tmp_path / "run")  # 6 disparity and 4 colour stamps
    for pattern, numbers in ((disparity, (1, 2, 6, 7)), (colour, (2, 4))):
        for k in numbers:
            file = folder / pattern.format(k)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch()
    log = datasets.read(folder)
    assert log.rgbd is not None
    assert log.rgbd.has_images
    found = [
        None if file is None else file.stem.rpartition("_")[2].lstrip("disparty") for file in log.rgbd.disparity_files
    ]
    assert found == ["1", "2", None, None, None, "6"]
    assert [file is None for file in log.rgbd.colour_files] == [True, False, True, False]
    assert any("1 disparity frames" in remark and "have no stamp" in remark for remark in log.remarks)
    assert any("lacks 3 of 6 disparity frames, first number 3" in remark for remark in log.remarks)
    assert any("lacks 2 of 4 rgb frames, first number 1" in remark for remark in log.remarks)


def test_frames_of_another_run_are_not_taken(ece276a_log: Writer, tmp_path: Path) -> None:
    folder = ece276a_log(tmp_path, run="20")
    (folder / "dataRGBD" / "Disparity21").mkdir(parents=True)
    (folder / "dataRGBD" / "Disparity21" / "disparity21_1.png").touch()
    log = datasets.read(folder)
    assert log.rgbd is not None
    assert log.rgbd.disparity_files == (None,) * 6


@pytest.mark.data
def test_run_20(psg_data: Path) -> None:
    log = datasets.read(psg_data / "ece276a" / "20")
    assert log.scans is not None
    assert log.encoders is not None
    assert log.imu is not None
    assert log.rgbd is not None
    assert log.truth is not None
    assert log.scans.ranges_m.shape == (4962, 1081)
    assert log.encoders.ticks_left.shape == log.encoders.ticks_right.shape == (4956, 2)
    assert log.imu.angular_velocity.shape == (12187, 3)
    assert (len(log.rgbd.disparity_stamps_s), len(log.rgbd.colour_stamps_s)) == (2407, 2289)
    np.testing.assert_allclose(log.truth.stamps_s, log.scans.stamps_s, atol=1e-6)
    assert log.encoders.travel_m.mean(axis=1).sum() == pytest.approx(95.9, abs=0.2)
    assert np.median(np.linalg.norm(log.imu.linear_acceleration, axis=1)) == pytest.approx(9.92, abs=0.01)
    assert np.mean(log.scans.ranges_m == 60) == pytest.approx(0.0304, abs=1e-3)


def test_a_damaged_header_of_an_array_is_named(ece276a_log: Callable[..., Path], tmp_path: Path) -> None:
    file = ece276a_log(tmp_path) / "Encoders7.npz"
    with np.load(file) as archive:
        members = {f"{name}.npy": archive[name] for name in archive.files}
    for damage in (b"{'descr': '<f8', 'fortran_order': False, 'shape': ((12,  ", b"}}", b"\0" * 20, b"None"):
        with zipfile.ZipFile(file, "w") as archive:
            for name in members:
                header = damage.ljust(118) + b"\n"
                archive.writestr(name, b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(96))
        with pytest.raises(InputError, match=r"Encoders7\.npz: cannot be read as an \.npz archive"):
            datasets.read(tmp_path)
