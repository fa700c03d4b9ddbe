"""Relations metric, path summary, and the table that compares stages."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.errors import InputError
from posegraph_slam.evaluation import compare, evaluate_trajectory, relation_errors, summarise, summarise_path
from posegraph_slam.geometry import SE2, Relations, Trajectory, pose_from_xyt, spatial_from_planar


def path(xyt: np.ndarray, stamps: np.ndarray | None = None) -> Trajectory:
    times = np.arange(float(len(xyt))) if stamps is None else stamps
    return Trajectory(stamps_s=times, poses=pose_from_xyt(xyt), parent="map", child="base")


def relations_of(trajectory: Trajectory, i: np.ndarray, j: np.ndarray, noise: np.ndarray | None = None) -> Relations:
    T = SE2.between(trajectory.poses[i], trajectory.poses[j])
    T = T if noise is None else T @ SE2.inverse(pose_from_xyt(noise))
    return Relations(stamps_1_s=trajectory.stamps_s[i], stamps_2_s=trajectory.stamps_s[j], T_1_2=spatial_from_planar(T))


@given(st.integers(0, 2**32 - 1))
def test_a_known_error_is_reported_whatever_the_frame_and_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    trajectory = path(np.cumsum(rng.normal(0, [1, 1, 2], (50, 3)), axis=0))
    i, j = rng.integers(0, 50, 30), rng.integers(0, 50, 30)
    noise = np.stack([rng.normal(0, 0.3, 30), rng.normal(0, 0.3, 30), rng.uniform(-3, 3, 30)], axis=1)
    relations = relations_of(trajectory, i, j, noise)
    moved = trajectory.with_poses(SE2.exp(rng.normal(0, 3, 3)) @ trajectory.poses).select(rng.permutation(50))
    errors = relation_errors(moved, relations)
    assert errors.all.translation_m is not None
    assert errors.all.rotation_deg is not None
    # E = ref^-1 T with ref = T N^-1, so that its translation is that of N turned, and its angle that of N
    np.testing.assert_allclose(errors.all.rotation_deg.mean, np.degrees(np.abs(noise[:, 2])).mean(), atol=1e-9)
    E = SE2.between(
        relations.T_1_2[:, [0, 1, 3]][:, :, [0, 1, 3]], SE2.between(trajectory.poses[i], trajectory.poses[j])
    )
    np.testing.assert_allclose(errors.all.translation_m.mean, np.linalg.norm(E[:, :2, 2], axis=1).mean(), atol=1e-9)
    far = np.abs(j - i) > 10
    counts = [0 if group.translation_m is None else group.translation_m.count for group in (errors.near, errors.far)]
    assert counts == [(~far).sum(), far.sum()]
    assert (errors.used, errors.missing) == (30, 0)


def test_between_poses_heading_goes_the_shorter_way_and_near_a_pose_the_pose_counts() -> None:
    trajectory = path(np.array([[0, 0, 3.0], [1, 0, -3.0]]))
    turn = 2 * np.pi - 6.0
    relations = Relations(
        stamps_1_s=np.array([0.0, 0.0, 0.0]),
        stamps_2_s=np.array([0.5, 1.0019, 0.0019]),
        T_1_2=spatial_from_planar(
            np.stack([
                SE2.between(pose_from_xyt(np.array([0, 0, 3.0])), pose_from_xyt(np.array([0.5, 0, 3.0 + turn / 2]))),
                SE2.between(trajectory.poses[0], trajectory.poses[1]),
                np.eye(3),
            ])
        ),
    )  # fmt: skip
    errors = relation_errors(trajectory, relations)
    assert errors.all.translation_m is not None
    assert errors.all.rotation_deg is not None
    assert errors.all.translation_m.max < 1e-12
    assert errors.all.rotation_deg.max < 1e-9
    assert errors.far.translation_m is None


def test_relations_outside_the_trajectory_are_counted_as_missing() -> None:
    trajectory = path(np.zeros((3, 3)))
    relations = Relations(
        stamps_1_s=np.array([0.0, 0.0, -1.0]), stamps_2_s=np.array([2.001, 2.01, 1.0]),
        T_1_2=np.broadcast_to(np.eye(4), (3, 4, 4)),
    )  # fmt: skip
    errors = relation_errors(trajectory, relations)
    assert (errors.used, errors.missing) == (1, 2)
    with pytest.raises(InputError, match="none of 3 relations lies within the trajectory"):
        relation_errors(trajectory.restamped(trajectory.stamps_s + 100), relations)
    with pytest.raises(InputError, match="is empty"):
        relation_errors(path(np.zeros((0, 3))), relations)


def test_of_poses_with_one_stamp_the_first_counts() -> None:
    trajectory = path(np.array([[0, 0, 0], [1, 0, 0], [9, 0, 0.0]]), np.array([0.0, 1.0, 1.0]))
    relations = relations_of(trajectory, np.array([0]), np.array([1]))
    errors = relation_errors(trajectory, relations)
    assert errors.all.translation_m is not None
    assert errors.all.translation_m.max == 0.0


def test_the_path_summary_measures_length_and_gap() -> None:
    square = path(np.array([[0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, np.pi / 2]]))
    summary = summarise_path(square)
    assert summary.length_m == 10.0
    assert summary.start_end_gap_m == 4.0
    np.testing.assert_allclose(summary.start_end_gap_deg, 90.0)
    assert summary.duration_s == 3.0
    with pytest.raises(InputError, match="is empty"):
        summarise_path(path(np.zeros((0, 3))))
    with pytest.raises(InputError, match="pose 1 of the trajectory is not finite"):
        summarise_path(path(np.array([[0, 0, 0], [np.nan, 0, 0]])))


def test_statistics_are_those_of_numpy_and_none_without_errors() -> None:
    statistics = summarise(np.array([1.0, 2.0, 6.0]))
    assert statistics is not None
    assert statistics.as_dict() == {
        "count": 3, "mean": 3.0, "std": pytest.approx(np.std([1, 2, 6])), "median": 2.0,
        "rmse": pytest.approx(np.sqrt(41 / 3)), "max": 6.0,
    }  # fmt: skip
    assert summarise(np.zeros(0)) is None


def test_the_table_shows_what_is_known_of_each_stage() -> None:
    truth = path(np.stack([np.arange(20.0), np.zeros(20), np.zeros(20)], axis=1))
    noisy = truth.with_poses(truth.poses @ SE2.exp(np.random.default_rng(0).normal(0, 0.1, (20, 3))))
    relations = relations_of(truth, np.arange(5), np.arange(5) + 12)
    table = compare({
        "odometry": evaluate_trajectory(noisy, truth=truth, relations=relations),
        "optimised": evaluate_trajectory(truth, truth=truth, crispness=0.25),
    })  # fmt: skip
    rows = {row[0]: row[1:] for row in table.as_text_rows()}
    assert table.as_text_rows()[0] == ["", "odometry", "optimised"]
    assert rows["path length [m]"][1] == "19.00"
    assert rows["map crispness"] == ["–", "0.250"]
    assert rows["APE position RMSE [m]"][1] == "0.000"
    assert float(rows["APE position RMSE [m]"][0]) > 0.05
    assert float(rows["RPE position over 5 m [m]"][0]) > 0.05
    assert float(rows["relations position mean [m]"][0]) > 0.05
    assert rows["relations position mean [m]"][1] == "–"
    assert "near relations position mean [m]" not in rows  # no stage has any
    stored = json.loads(json.dumps(table.as_dict(), allow_nan=False))
    assert stored["stages"] == ["odometry", "optimised"]
    by_metric = {row["metric"]: row["values"] for row in stored["rows"]}
    assert by_metric["map crispness"] == {"odometry": None, "optimised": 0.25}


def test_metrics_are_ready_for_json_with_and_without_truth() -> None:
    trajectory = path(np.stack([np.arange(20.0), np.zeros(20), np.zeros(20)], axis=1))
    bare = evaluate_trajectory(trajectory).as_dict()
    assert bare["ape"] is None
    assert bare["rpe"] is None
    assert bare["relations"] is None
    full = evaluate_trajectory(
        trajectory, truth=trajectory, relations=relations_of(trajectory, np.array([0]), np.array([3]))
    )
    stored = json.loads(json.dumps(full.as_dict(), allow_nan=False))
    assert stored["ape"]["paired"] == 20
    assert stored["relations"]["far"] == {"translation_m": None, "rotation_deg": None}
    assert [row["distance_m"] for row in stored["rpe"]["over_distance"]] == [1.0, 5.0, 10.0]
