"""Choosing stages, and taking a finished run up again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.datasets.tum import read_tum
from posegraph_slam.errors import ConfigurationError, InputError
from posegraph_slam.mapping.archive import npz_bytes
from posegraph_slam.odometry.wheel_calibration import UNCALIBRATED
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.matching_file import MATCHING, read_matching
from posegraph_slam.pipeline.rerun import plan_run
from posegraph_slam.pipeline.run import run


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rerun")
    log = simulate(tiny_settings(duration_s=30.0), folder / "log")
    run(log, Configuration(), out=folder / "run")
    return folder / "run"


def test_a_rerun_from_the_graph_equals_the_run(finished: Path, tmp_path: Path) -> None:
    plan = plan_run(finished, [], [], start="graph")
    assert plan.matching_of == finished
    again = run(plan.log, plan.configuration, out=tmp_path / "again", matching_of=plan.matching_of)
    for name in ("trajectory.tum", "graph.g2o", "loops.csv", "maps/map.npz", MATCHING):
        assert (again.folder / name).read_bytes() == (finished / name).read_bytes(), name


def test_overrides_apply_on_top_of_the_runs_configuration(finished: Path) -> None:
    plan = plan_run(finished, [], ["loop_closure.proposals.fixed_interval=3"], start="graph", no_loops=True)
    assert plan.configuration.loop_closure.proposals.fixed_interval == 3
    assert not plan.configuration.loop_closure.enabled
    assert plan_run(finished, [], [], start="matching").matching_of is None


def test_stages_left_out_leave_no_trace(finished: Path, tmp_path: Path) -> None:
    log = plan_run(finished, [], [], start="matching").log
    plan = plan_run(log, [], [], stages="odometry, matching")
    result = run(plan.log, plan.configuration, out=tmp_path / "short")
    assert not (result.folder / "maps").exists()
    assert json.loads((result.folder / "metrics.json").read_text())["loops_proposed"] == 0
    bare = plan_run(log, [], [], stages="odometry")
    alone = run(bare.log, bare.configuration, out=tmp_path / "bare").folder
    poses = [read_tum(alone / name, parent="map", child="base").poses for name in ("odometry.tum", "trajectory.tum")]
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-8)


def test_wrong_stages_and_runs_are_named(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="'loops' is not a stage"):
        plan_run(finished, [], [], stages="loops")
    with pytest.raises(ConfigurationError, match="'maps' is not a stage to start from"):
        plan_run(finished, [], [], start="maps")
    with pytest.raises(InputError, match="not a run directory"):
        plan_run(tmp_path, [], [], start="graph")
    moved = tmp_path / "moved"
    shutil.copytree(finished, moved)
    record = json.loads((moved / "run.json").read_text())
    record["input"]["path"] = str(tmp_path / "gone")
    (moved / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match="is gone"):
        plan_run(moved, [], [], start="graph")
    del record["input"]
    (moved / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"run\.json: does not say which log was read"):
        plan_run(moved, [], [], start="graph")


@pytest.mark.parametrize(
    ("name", "spoil", "problem"),
    [
        ("scan_information", np.ravel, "has shape"),
        ("keyframe_information", lambda a: a[:-1], "has shape"),
        ("matched_fraction", lambda a: a * np.nan, "not finite"),
        ("poses", lambda a: a * 1e300, "beyond"),
        ("keyframes", lambda a: a[::-1], "rising numbers of scans"),
        ("keyframes", lambda a: a + 1000, "rising numbers of scans"),
        ("lag", lambda a: a.astype(str), "does not hold numbers"),
    ],
)
def test_a_damaged_array_of_the_matching_is_named(
    name: str, spoil: Callable[[np.ndarray], np.ndarray], problem: str, finished: Path, tmp_path: Path
) -> None:
    arrays = dict(np.load(finished / MATCHING))
    (tmp_path / MATCHING).write_bytes(npz_bytes({**arrays, name: spoil(arrays[name])}))
    with pytest.raises(InputError, match=rf"scan_matching\.npz: '{name}' .*{problem}"):
        read_matching(tmp_path / MATCHING, len(arrays["stamps_s"]))


def test_matching_without_wheels_is_of_wheels_as_they_are(finished: Path, tmp_path: Path) -> None:
    arrays = dict(np.load(finished / MATCHING))
    count = len(arrays["stamps_s"])
    matched = read_matching(finished / MATCHING, count)
    wheels = arrays.pop("wheels")
    (tmp_path / MATCHING).write_bytes(npz_bytes(arrays))
    earlier = read_matching(tmp_path / MATCHING, count)
    assert earlier.wheels == matched.wheels == UNCALIBRATED
    for bad in (wheels[:2], np.array([np.nan, 0.1, 0.1]), np.array([-1.0, 0.1, 0.1])):
        (tmp_path / MATCHING).write_bytes(npz_bytes({**arrays, "wheels": bad}))
        with pytest.raises(InputError, match="does not hold a calibration of wheels"):
            read_matching(tmp_path / MATCHING, count)


def test_matching_in_the_plane_is_not_taken_for_one_in_space(finished: Path, tmp_path: Path) -> None:
    plan = plan_run(finished, [], ["pose_graph.group=se3"], start="graph")
    with pytest.raises(InputError, match=r"was matched with pose_graph\.group = se2, not se3; start it over"):
        run(plan.log, plan.configuration, out=tmp_path / "space", matching_of=plan.matching_of)
    assert not (tmp_path / "space").exists()


def test_matching_of_another_log_is_refused(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="but the log has 7"):
        read_matching(finished / MATCHING, 7)
    broken = tmp_path / MATCHING
    broken.write_bytes((finished / MATCHING).read_bytes()[:200])
    with pytest.raises(InputError, match="truncated"):
        read_matching(broken, 7)
