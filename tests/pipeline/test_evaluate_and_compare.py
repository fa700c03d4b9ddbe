"""`psg evaluate` and `psg compare`: the numbers of evo, alignment options, ranks without truth, figures, refusals."""

from __future__ import annotations

import json
import re
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.units import Unit
from evo.tools import file_interface
from typer.testing import CliRunner, Result

from posegraph_slam import Run, optimize
from posegraph_slam.cli.application import app
from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.datasets.trajectory_files import write_trajectory
from posegraph_slam.geometry import SE3, Trajectory
from posegraph_slam.mapping.quality import MapQuality
from posegraph_slam.pipeline.compare_runs import compare_runs, distinct_names, map_ranks


def psg(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


def refused(*arguments: str | Path) -> str:
    result = psg(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    return result.stderr


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A true path in space and a noisy copy of it, in another frame and another unit of length."""
    rng = np.random.default_rng(5)
    true, estimate = [np.eye(4)], [SE3.exp(np.array([0.1, 0.2, 0.3, 4.0, 5.0, 6.0]))]
    for _ in range(200):
        step = SE3.exp(np.concatenate([rng.normal(0, 0.1, 3), [0.3, 0, 0.05]]))
        true.append(true[-1] @ step)
        estimate.append(estimate[-1] @ step @ SE3.exp(rng.normal(0, 0.01, 6)))
    stamps = 1e9 + 0.1 * np.arange(201)
    folder = tmp_path_factory.mktemp("files")
    for name, poses in (("true", np.array(true)), ("estimate", np.array(estimate))):
        if name == "estimate":
            poses[:, :3, 3] *= 1.25
        path = Trajectory(stamps_s=stamps, poses=poses, parent="map", child="base")
        write_trajectory(path, folder / f"{name}.tum")
    return folder / "estimate.tum", folder / "true.tum"


@pytest.mark.parametrize("align", ["none", "first", "se3", "sim3"])
def test_errors_and_alignments_are_those_of_evo(files: tuple[Path, Path], align: str) -> None:
    ours = json.loads(psg("evaluate", *files, "--align", align, "--distance", "2", "--json").stdout)
    estimate, true = (file_interface.read_tum_trajectory_file(path) for path in files)
    true, estimate = sync.associate_trajectories(true, estimate)
    if align == "first":
        estimate.align_origin(true)
    elif align != "none":
        _, _, scale = estimate.align(true, correct_scale=align == "sim3")
        assert ours["ape"]["scale"] == pytest.approx(scale if align == "sim3" else 1.0)
    for name, relation in (
        ("translation_m", metrics.PoseRelation.translation_part),
        ("rotation_deg", metrics.PoseRelation.rotation_angle_deg),
    ):
        theirs = metrics.APE(relation)
        theirs.process_data((true, estimate))
        drift = metrics.RPE(relation, 2.0, Unit.meters, rel_delta_tol=0.1, all_pairs=True, pairs_from_reference=True)
        drift.process_data((true, estimate))
        for statistic in ("rmse", "mean", "median", "std", "max"):
            kind = metrics.StatisticsType(statistic)
            assert ours["ape"][name][statistic] == pytest.approx(theirs.get_statistic(kind), rel=1e-6, abs=1e-9)
            found = ours["rpe"]["over_distance"][0][name][statistic]
            assert found == pytest.approx(drift.get_statistic(kind), rel=1e-5, abs=1e-8)


def test_evaluate_prints_a_table_and_draws(files: tuple[Path, Path], tmp_path: Path) -> None:
    result = psg(
        "evaluate", *files, "--align", "sim3", "--distance", "1", "--distance", "7.5", "--out", tmp_path / "ev"
    )
    assert result.exit_code == 0
    assert "RPE over 7.5 m [deg]" in result.stdout
    scale = re.search(r"aligned: sim3, scale ([\d.]+); 201 of 201", result.stdout)
    assert scale is not None
    assert float(scale[1]) == pytest.approx(1 / 1.25, rel=0.1)
    for name in ("error_map.png", "errors.png"):
        picture = matplotlib.image.imread(tmp_path / "ev" / name)
        assert min(picture.shape[:2]) > 300
        assert picture[..., :3].std() > 0.02
    assert json.loads((tmp_path / "ev" / "evaluation.json").read_text())["ape"]["alignment"] == "sim3"


def test_evaluate_says_where_positions_do_not_tell_the_rotation(tmp_path: Path) -> None:
    rows = np.column_stack([0.1 * np.arange(40), np.linspace(0, 4, 40), np.zeros((40, 5)), np.ones(40)])
    moved = rows.copy()
    moved[:, 2:4] += 0.01 * np.random.default_rng(2).standard_normal((40, 2))
    np.savetxt(tmp_path / "true.tum", rows + 1e-3 * np.sin(np.arange(40))[:, None] * [0, 0, 1, 0, 0, 0, 0, 0])
    np.savetxt(tmp_path / "estimate.tum", moved)
    told = psg("evaluate", tmp_path / "estimate.tum", tmp_path / "true.tum", "--align", "se3")
    assert "the positions tell the rotation of the alignment to" in told.stderr
    assert psg("evaluate", tmp_path / "estimate.tum", tmp_path / "true.tum", "--align", "first").stderr == ""


def test_evaluate_refuses_what_does_not_fit(files: tuple[Path, Path], tmp_path: Path) -> None:
    assert "did you mean 'sim3'" in refused("evaluate", *files, "--align", "sim")
    late = tmp_path / "late.tum"
    late.write_text("5 0 0 0 0 0 0 1\n6 1 0 0 0 0 0 1\n7 2 0 0 0 0 0 1\n")
    assert "check that both use one clock" in refused("evaluate", late, files[1])
    assert "no such file" in refused("evaluate", tmp_path / "none.tum", files[1])
    relations = tmp_path / "a.relations"
    relations.write_text("1 2 0 0 0 0 0 0\n")
    assert "none of 1 relations" in refused("evaluate", files[0], relations)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path, Path]:
    """A drive, optimised, and the same by its wheels alone."""
    folder = tmp_path_factory.mktemp("runs")
    log = simulate(tiny_settings(duration_s=30.0), folder / "log")
    best = optimize(log)
    odometry = {"scan_matching.matcher": "none", "loop_closure.enabled": False, "odometry.source": "wheels"}
    best.save(folder / "optimised", figures=False)
    optimize(log, odometry).save(folder / "odometry", figures=False)
    return best, folder / "optimised", folder / "odometry"


def test_compare_ranks_maps_without_truth(runs: tuple[Run, Path, Path], tmp_path: Path) -> None:
    _, optimised, odometry = runs
    found = compare_runs([odometry, optimised])
    assert found.best == "optimised"
    ranks = next(row.values for row in found.table.rows if row.name == "rank by map")
    assert ranks[1] < ranks[0]
    result = psg("compare", odometry, optimised, "--out", tmp_path / "runs.png")
    assert "best map: optimised" in result.stdout
    assert "double walls [%]" in result.stdout
    assert min(matplotlib.image.imread(tmp_path / "runs.png").shape[:2]) > 300
    record = json.loads(psg("compare", odometry, optimised, "--json").stdout)
    assert record["best"] == "optimised"
    assert record["runs"] == {"odometry": str(odometry), "optimised": str(optimised)}


def test_compare_measures_against_a_truth_that_is_given(runs: tuple[Run, Path, Path]) -> None:
    run, optimised, odometry = runs
    truth = next(run.log.path.glob("truth*.tum"))
    table = json.loads(psg("compare", optimised, odometry, "--truth", truth, "--json").stdout)
    values = {row["metric"]: row["values"] for row in table["rows"]}
    stored = run.metrics["stages"]["optimised"]["ape"]["translation_m"]["rmse"]
    assert values["APE position RMSE"]["optimised"] == pytest.approx(stored, rel=1e-6)


def test_evaluate_takes_a_run_and_a_log(runs: tuple[Run, Path, Path]) -> None:
    run, optimised, _ = runs
    found = json.loads(psg("evaluate", optimised, run.log.path, "--json").stdout)
    stored = run.metrics["stages"]["optimised"]
    assert found["ape"]["alignment"] == "se2"
    for part in ("translation_m", "rotation_deg"):
        assert found["ape"][part]["rmse"] == pytest.approx(stored["ape"][part]["rmse"], rel=1e-6, abs=1e-6)


def test_compare_warns_of_what_does_not_compare(runs: tuple[Run, Path, Path], tmp_path: Path) -> None:
    run, optimised, _ = runs
    other = optimize(simulate(tiny_settings(duration_s=6.0), tmp_path / "log"), {"mapping.resolution_m": 0.2})
    remarks = compare_runs([optimised, other.save(tmp_path / "other", figures=False)]).remarks
    assert any("different logs" in remark for remark in remarks)
    assert any("different settings" in remark for remark in remarks)
    assert "two or more" in refused("compare", optimised)
    assert "twice" in refused("compare", optimised, optimised)
    assert "is not a run directory" in refused("compare", optimised, tmp_path)
    assert run.map is not None


def test_names_tell_runs_apart(tmp_path: Path) -> None:
    folders = [tmp_path / "a" / "run", tmp_path / "b" / "run"]
    assert distinct_names(folders) == ("a/run", "b/run")


def test_ranks_share_ties_and_leave_out_runs_without_maps() -> None:
    def quality(crispness: float, entropy: float, double: float) -> MapQuality:
        return MapQuality(
            crispness=crispness, entropy_bits=entropy, wall_thickness_m=0.1, double_walls=double, wall_area_m2=1
        )

    best, worst = quality(0.9, 0.1, 0.0), quality(0.5, 0.3, 0.2)
    assert map_ranks([worst, None, best]) == (2.0, None, 1.0)
    assert map_ranks([best, best]) == (1.5, 1.5)
    assert map_ranks([best, None]) == (None, None)
