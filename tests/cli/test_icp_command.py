"""`psg icp` from files to pictures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from posegraph_slam.cli.application import app


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Return a model of three unlike boxes and a moved sample of it, tall enough to be told apart."""
    rng = np.random.default_rng(0)

    def sample(count: int) -> np.ndarray:
        points = rng.uniform(-0.5, 0.5, (count, 3))
        points[np.arange(count), rng.integers(3, size=count)] = 0.5
        points[: count // 2] = points[: count // 2] * [0.3, 0.2, 0.5] + [0.6, 0.3, 0.2]
        return 0.1 * points

    model, cloud = tmp_path / "thing.npy", tmp_path / "seen.xyz"
    np.save(model, sample(3000))
    np.savetxt(cloud, sample(1000)[:, [1, 2, 0]] + 0.4)
    return model, cloud


def run(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["icp", *map(str, arguments)])
    return result.exit_code, result.stdout, result.stderr


def test_a_cloud_is_aligned_drawn_and_tabulated(files: tuple[Path, Path], tmp_path: Path) -> None:
    code, text, _ = run(*files, "--rotations", 200, "--out", tmp_path / "out")
    assert code == 0
    assert "seen.xyz" in text
    assert "trimmed [mm]" in text
    (entry,) = json.loads((tmp_path / "out" / "poses.json").read_text())
    expected = np.array([[0.0, 0, 1, -0.4], [1, 0, 0, -0.4], [0, 1, 0, -0.4], [0, 0, 0, 1]])
    np.testing.assert_allclose(np.array(entry["T_model_cloud"]), expected, atol=0.01)
    assert len(list((tmp_path / "out").rglob("seen_aligned.png"))) == 1
    assert len(list((tmp_path / "out").rglob("seen_aligned.ply"))) == 1


def test_poses_are_replaced_only_on_demand(files: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "poses.json").write_text("kept")
    code, _, errors = run(*files, "--rotations", 200, "--out", tmp_path)
    assert code == 2
    assert "poses.json: exists already" in errors
    assert (tmp_path / "poses.json").read_text() == "kept"
    code, text, _ = run(*files, "--rotations", 200, "--out", tmp_path, "--overwrite")
    assert code == 0
    assert "s a cloud" in text
    assert json.loads((tmp_path / "poses.json").read_text())[0]["status"] == "converged"


def test_the_course_reports_error_stands_beside_ours(files: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "drill").mkdir()
    model = files[0].rename(tmp_path / "drill" / "model.npy")
    _, text, _ = run(model, files[1], "--rotations", 200)
    assert "drill (3000 points)" in text
    assert "the course report: 52.7" in text


def test_json_is_all_that_is_printed(files: tuple[Path, Path]) -> None:
    code, text, _ = run(*files, "--rotations", 200, "--json")
    assert code == 0
    assert json.loads(text)[0]["status"] in ("converged", "max_iterations")


def test_a_cloud_that_fits_nowhere_ends_with_2(files: tuple[Path, Path], tmp_path: Path) -> None:
    noise = tmp_path / "noise.npy"
    np.save(noise, np.random.default_rng(1).uniform(-1, 1, (400, 3)))
    code, text, errors = run(files[0], noise, "--rotations", 50)
    assert code == 2
    assert "too_few_inliers" in text
    assert [line for line in errors.splitlines() if "noise.npy: no pose (too_few_inliers); check" in line] == [
        errors.strip().splitlines()[-1]
    ]


@pytest.mark.parametrize("arguments", [[], ["model.npy"], ["model.npy", "a.npy", "--folder", "x"]])
def test_files_or_a_folder_must_be_given(arguments: list[str]) -> None:
    code, _, errors = run(*arguments)
    assert code == 2
    assert "psg icp" in errors
