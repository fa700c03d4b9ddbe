"""The humanoid's files, its chain of frames, and its level scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from posegraph_slam import datasets
from posegraph_slam.datasets.humanoid import imu_odometry, read_joints
from posegraph_slam.datasets.simulation.humanoid import WALLS, write_humanoid_log
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import pose_from_xyt, xyt_from_pose
from posegraph_slam.sensors.humanoid import JointAngles, lidar_on_level_body
from posegraph_slam.sensors.level_scans import level_ranges


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_humanoid_log(tmp_path_factory.mktemp("walk"), rng=np.random.default_rng(0), scans=60)


def wall_distance(points: np.ndarray) -> np.ndarray:
    """Distance (n,) of points to the nearest simulated wall."""
    best = np.full(len(points), np.inf)
    for x0, y0, x1, y1 in WALLS:
        along = np.array([x1 - x0, y1 - y0])
        part = np.clip((points - [x0, y0]) @ along / (along @ along), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - [x0, y0] - part[:, None] * along, axis=1))
    return best


def test_level_scans_lie_on_the_walls(walk: Path) -> None:
    log = datasets.read(walk)
    assert log.format == "humanoid"
    assert log.scans is not None
    assert log.truth is not None
    distances = []
    for k in range(0, len(log.scans), 7):
        T = log.truth.poses[k][np.ix_([0, 1, 3], [0, 1, 3])]
        distances.append(wall_distance(log.scans.points(k) @ T[:2, :2].T + T[:2, 2]))
    everything = np.concatenate(distances)
    assert len(everything) > 5000
    assert np.median(everything) < 0.01
    assert np.percentile(everything, 99) < 0.03


def test_ground_hits_are_dropped(walk: Path) -> None:
    log = datasets.read(walk)
    dropped = int(next(remark for remark in log.remarks if "hit the ground" in remark).split()[0])
    assert dropped > 500  # the head nods far enough to see the ground


def test_heading_comes_from_the_imu_and_steps_from_the_odometry(walk: Path) -> None:
    log = datasets.read(walk)
    assert log.scan_odometry is not None
    assert log.truth is not None
    estimate = xyt_from_pose(log.scan_odometry.poses)
    truth = log.truth.poses
    yaw = np.arctan2(truth[:, 1, 0], truth[:, 0, 0])
    np.testing.assert_allclose(np.sin(estimate[:, 2] - (yaw - yaw[0])), 0, atol=1e-9)
    moved = truth[:, :2, 3] - truth[0, :2, 3]
    c, s = np.cos(yaw[0]), np.sin(yaw[0])
    np.testing.assert_allclose(estimate[:, :2], moved @ np.array([[c, -s], [s, c]]), atol=0.03)


def test_odometry_of_exact_streams_is_the_path() -> None:
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [1.8, 0.5, 1.0], [2.0, 1.4, 3.5]])
    chained = imu_odometry(np.arange(4.0), path, path[:, 2])
    np.testing.assert_allclose(chained.poses, pose_from_xyt(path), atol=1e-12)


def test_chain_by_hand() -> None:
    upright = lidar_on_level_body(*np.zeros((4, 1)))[0]
    np.testing.assert_allclose(upright[:3, 3], [0, 0, 1.41])
    looking_left_and_down = lidar_on_level_body(np.array([np.pi / 2]), np.array([0.3]), np.zeros(1), np.zeros(1))[0]
    np.testing.assert_allclose(looking_left_and_down[:3, 0], [0, np.cos(0.3), -np.sin(0.3)], atol=1e-12)
    leaning = lidar_on_level_body(np.zeros(1), np.zeros(1), np.zeros(1), np.array([0.2]))[0]
    np.testing.assert_allclose(leaning[:3, 3], [0.48 * np.sin(0.2), 0, 0.93 + 0.48 * np.cos(0.2)], atol=1e-12)
    rolled = lidar_on_level_body(np.zeros(1), np.zeros(1), np.array([0.1]), np.zeros(1))[0]
    np.testing.assert_allclose(rolled[:3, 1], [0, np.cos(0.1), np.sin(0.1)], atol=1e-12)


def test_a_level_laser_on_the_axis_keeps_its_ranges() -> None:
    angles = np.deg2rad(np.arange(-90.0, 91.0))
    ranges = (2.0 / np.maximum(np.cos(angles), 0.25)).astype(np.float32)[None]
    pose = np.eye(4)[None].copy()
    pose[0, 2, 3] = 1.0
    levelled = level_ranges(ranges, angles, pose, heights_m=(0.1, np.inf), limits_m=np.array([0.1, 30.0]))
    level, dropped = levelled.ranges_m, levelled.too_low
    assert dropped == 0
    np.testing.assert_allclose(level[0, 90:271], ranges[0], rtol=1e-5)
    assert (level[0, :90] == 0).all()
    assert (level[0, 271:] == 0).all()


def test_nearest_joint_sample_matches_a_slow_search() -> None:
    rng = np.random.default_rng(2)
    stamps = np.sort(rng.uniform(0, 10, 50))
    joints = JointAngles(stamps_s=stamps, neck_yaw_rad=stamps, head_pitch_rad=stamps)
    wanted = rng.uniform(-1, 11, 200)
    np.testing.assert_array_equal(joints.nearest(wanted), np.abs(stamps[None] - wanted[:, None]).argmin(axis=1))


def test_struct_arrays_are_read_like_cells(walk: Path, tmp_path: Path) -> None:
    cells = loadmat(walk)["lidar"].reshape(-1)
    structs = np.array([tuple(cell[0, 0][name] for name in ("t", "pose", "res", "rpy", "scan")) for cell in cells],
                       dtype=[(name, object) for name in ("t", "pose", "res", "rpy", "scan")])  # fmt: skip
    savemat(tmp_path / "lidar3.mat", {"lidar": structs})
    (tmp_path / "joint3.mat").write_bytes(walk.with_name("train_joint0.mat").read_bytes())
    first, second = datasets.read(walk).scans, datasets.read(tmp_path / "lidar3.mat").scans
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.ranges_m, second.ranges_m)


@pytest.fixture(scope="module")
def steps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same walk, upright, in the form of three fields: t, scan, delta_pose."""
    return write_humanoid_log(tmp_path_factory.mktemp("steps"), rng=np.random.default_rng(0), scans=60, steps=True)


def test_files_of_odometry_steps_are_read(steps: Path) -> None:
    assert loadmat(steps)["lidar"][0, 5].dtype.names == ("t", "scan", "delta_pose")
    log = datasets.read(steps)
    assert log.scans is not None
    assert log.truth is not None
    assert log.scan_odometry is not None
    T = log.truth.poses[20][np.ix_([0, 1, 3], [0, 1, 3])]
    assert np.median(wall_distance(log.scans.points(20) @ T[:2, :2].T + T[:2, 2])) < 0.01
    # The steps are differences of poses in the odometry's own frame: their sum is the odometry.
    cells = loadmat(steps)["lidar"].reshape(-1)
    summed = np.cumsum([cell["delta_pose"][0, 0].reshape(-1) for cell in cells], axis=0)
    np.testing.assert_allclose(log.scan_odometry.poses, pose_from_xyt(summed), atol=1e-9)
    assert any("no IMU angles" in remark for remark in log.remarks)


@pytest.mark.parametrize("form", ["poses", "poses and one more", "steps"])
def test_fields_of_other_names_are_known_by_their_order(walk: Path, steps: Path, tmp_path: Path, form: str) -> None:
    source = steps if form == "steps" else walk
    order = ("t", "scan", "delta_pose") if form == "steps" else ("t", "pose", "res", "rpy", "scan")
    stored = loadmat(source)["lidar"].reshape(-1)
    cells = np.empty((1, len(stored)), dtype=object)
    for k, cell in enumerate(stored):
        values = [cell[0, 0][name] for name in order]
        values[1:1] = [np.zeros((1, 1))] * (form == "poses and one more")
        cells[0, k] = {f"field{number}": value for number, value in enumerate(values)}
    savemat(tmp_path / "lidar.mat", {"lidar": cells})
    (tmp_path / "joint.mat").write_bytes(source.with_name("train_joint0.mat").read_bytes())
    first, second = datasets.read(source), datasets.read(tmp_path / "lidar.mat")
    assert first.scans is not None
    assert second.scans is not None
    np.testing.assert_array_equal(first.scans.ranges_m, second.scans.ranges_m)
    assert first.scan_odometry is not None
    assert second.scan_odometry is not None
    np.testing.assert_array_equal(first.scan_odometry.poses, second.scan_odometry.poses)


def test_joints_in_a_folder_of_their_own(walk: Path, tmp_path: Path) -> None:
    for kind in ("lidar", "joint"):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / f"train_{kind}0.mat").write_bytes(walk.with_name(f"train_{kind}0.mat").read_bytes())
    assert datasets.read(tmp_path / "lidar" / "train_lidar0.mat").scans is not None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content["lidar"][0, 3].__setitem__("rpy", np.full((1, 3), np.nan)), "'rpy' of scan 3"),
        (lambda content: content["lidar"][0, 3].__setitem__("scan", np.ones((1, 7))), "'scan' has"),
        (lambda content: content["lidar"][0, 3].pop("pose"), "scan 3 has no field 'pose'"),
        (lambda content: content.pop("lidar"), "no field 'lidar'"),
    ],
)
def test_bad_fields_are_named(walk: Path, tmp_path: Path, change, words: str) -> None:
    cells = loadmat(walk)["lidar"]
    content = {"lidar": np.empty((1, 6), dtype=object), "other": 1}
    for k in range(6):
        content["lidar"][0, k] = {name: cells[0, k][0, 0][name] for name in ("t", "pose", "res", "rpy", "scan")}
    change(content)
    savemat(tmp_path / "lidar.mat", content)
    (tmp_path / "joint.mat").write_bytes(walk.with_name("train_joint0.mat").read_bytes())
    with pytest.raises(InputError, match=words):
        datasets.read(tmp_path / "lidar.mat", format="humanoid")


def test_a_missing_joint_file_is_named(walk: Path, tmp_path: Path) -> None:
    (tmp_path / "train_lidar4.mat").write_bytes(walk.read_bytes())
    with pytest.raises(InputError, match=r"train_joint4\.mat: is missing"):
        datasets.read(tmp_path / "train_lidar4.mat")


@pytest.mark.data
def test_the_real_joint_file(psg_data: Path) -> None:
    joints = read_joints(psg_data / "humanoid" / "train_joint0.mat")
    assert len(joints) == 38318
    assert np.ptp(joints.neck_yaw_rad) < 0.01  # this walk looks straight ahead
    assert 0.2 < joints.head_pitch_rad.max() < 1.0


@pytest.mark.parametrize("field", ["ts", "head_angles"])
def test_joint_fields_of_text_are_named(field: str, tmp_path: Path) -> None:
    content: dict[str, object] = {"ts": np.arange(3.0)[None], "head_angles": np.zeros((2, 3))}
    savemat(tmp_path / "train_joint0.mat", content | {field: "text"})
    with pytest.raises(InputError, match=rf"train_joint0\.mat: field '{field}' holds <U4, not numbers"):
        read_joints(tmp_path / "train_joint0.mat")
