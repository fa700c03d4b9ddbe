"""Objects from files to poses: units, folders, what is written, and the real warm-up clouds."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from posegraph_slam.datasets.clouds import read_cloud
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import SE3, transform_points
from posegraph_slam.pipeline.object_poses import (
    align_object,
    aligned_names,
    in_millimetres,
    require_free_output,
    save_objects,
    task_of_files,
    tasks_of_folder,
)
from posegraph_slam.registration import GlobalSearchSettings, RegistrationStatus, prepare_target, register_globally

QUICK = GlobalSearchSettings(rotations=200, survivors=(200, 50, 20), candidates=4)


def wedge(rng: np.random.Generator, count: int) -> np.ndarray:
    """Points on the faces of three boxes of unlike sizes, 0.2 m across."""
    parts = []
    for centre, size in (
        ((0, 0, 0), (0.2, 0.1, 0.06)),
        ((0.06, 0.03, 0.05), (0.05, 0.03, 0.06)),
        ((-0.08, -0.02, 0.05), (0.03, 0.05, 0.04)),
    ):
        points = rng.uniform(-0.5, 0.5, (count, 3))
        points[np.arange(count), rng.integers(3, size=count)] = rng.choice([-0.5, 0.5], count)
        parts.append(points * size + centre)
    return np.vstack(parts)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two objects: a model in millimetres with two clouds in metres, and an array with one."""
    rng = np.random.default_rng(0)
    for name, count in (("block", 2), ("other", 1)):
        (tmp_path / name).mkdir()
        model = wedge(rng, 1500)
        if name == "block":
            savemat(tmp_path / name / "model.mat", {"Mdata": 1000 * model.T})
        else:
            np.save(tmp_path / name / "model.npy", model)
        for k in range(count):
            T = SE3.exp(rng.normal(0, 1.0, 6))
            np.save(tmp_path / name / f"{k}.npy", transform_points(T, wedge(rng, 700)))
    return tmp_path


def test_a_folder_of_objects_is_aligned_and_saved(folder: Path, tmp_path: Path) -> None:
    tasks = tasks_of_folder(folder)
    assert [task.name for task in tasks] == ["block", "other"]
    assert [name for name, _ in tasks[0].clouds] == ["block/0.npy", "block/1.npy"]
    objects = [align_object(task, QUICK) for task in tasks]
    assert any("millimetres" in remark for remark in objects[0].remarks)
    assert objects[1].remarks == ()
    out = tmp_path / "out"
    save_objects(objects, out)
    entries = json.loads((out / "poses.json").read_text())
    assert [entry["cloud"] for entry in entries] == ["block/0.npy", "block/1.npy", "other/0.npy"]
    for entry in entries:
        T = np.array(entry["T_model_cloud"])
        cloud = read_cloud(folder / entry["cloud"]).points
        aligned = read_cloud(out / entry["cloud"].replace(".npy", "_aligned.ply")).points
        np.testing.assert_allclose(aligned, transform_points(T, cloud), atol=1e-12)
        assert entry["trimmed_rmse_m"] < 0.006
        assert np.abs(aligned.mean(axis=0) - [0, 0, 0.033]).max() < 0.01
    again = tmp_path / "again"
    save_objects([align_object(task, QUICK) for task in tasks], again)
    assert (again / "poses.json").read_bytes() == (out / "poses.json").read_bytes()


def test_a_cloud_that_fits_nowhere_keeps_its_place(folder: Path, tmp_path: Path) -> None:
    noise = folder / "noise.xyz"
    np.savetxt(noise, np.random.default_rng(0).uniform(-1, 1, (300, 3)))
    found = align_object(task_of_files(folder / "other" / "model.npy", [noise]), QUICK)
    save_objects([found], tmp_path / "out")
    (entry,) = json.loads((tmp_path / "out" / "poses.json").read_text())
    assert entry["T_model_cloud"] is None
    assert entry["status"] == "too_few_inliers"
    assert list((tmp_path / "out").rglob("*.ply")) == []


def test_folders_without_objects_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder"):
        tasks_of_folder(tmp_path / "none")
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match="holds no object"):
        tasks_of_folder(tmp_path)
    for name in ("model.npy", "model.xyz", "0.npy"):
        (tmp_path / "a" / name).touch()
    with pytest.raises(InputError, match="one model an object"):
        tasks_of_folder(tmp_path)


@pytest.mark.parametrize(("clouds", "names"), [
    (["x/0.npy", "x/1.npy"], ["x/0", "x/1"]),
    (["0.npy", "0.ply", "1.npy"], ["0.npy", "0.ply", "1"]),
    (["/abs/x/0.npy", "/abs/x/1.npy"], ["x/0", "x/1"]),
    (["/abs/x/0.npy", "/abs/y/0.npy"], ["abs/x/0", "abs/y/0"]),
    (["/abs/x/0.npy", "/abs/x/0.npy"], ["x/0", "x/0"]),
])  # fmt: skip
def test_outputs_have_names_of_their_own(clouds: list[str], names: list[str]) -> None:
    assert aligned_names(clouds) == {cloud: f"{name}_aligned" for cloud, name in zip(clouds, names, strict=True)}


def test_outputs_stay_in_their_folder(tmp_path: Path) -> None:
    for name in aligned_names(["../../x/0.npy", "x/0.npy", "/0.npy"]).values():
        assert (tmp_path / name).resolve().is_relative_to(tmp_path.resolve())


def test_what_was_written_is_no_input(folder: Path) -> None:
    save_objects([align_object(task, QUICK) for task in tasks_of_folder(folder)], folder)
    assert (folder / "block" / "0_aligned.ply").is_file()
    assert [name for name, _ in tasks_of_folder(folder)[0].clouds] == ["block/0.npy", "block/1.npy"]


def test_poses_are_not_overwritten_unasked(tmp_path: Path) -> None:
    require_free_output(tmp_path / "new", overwrite=False)
    require_free_output(tmp_path, overwrite=False)
    (tmp_path / "poses.json").write_text("[]")
    with pytest.raises(InputError, match="--overwrite"):
        require_free_output(tmp_path, overwrite=False)
    require_free_output(tmp_path, overwrite=True)
    with pytest.raises(InputError, match="not a folder"):
        require_free_output(tmp_path / "poses.json", overwrite=True)


def test_a_model_file_takes_the_name_of_its_folder(tmp_path: Path) -> None:
    assert task_of_files(tmp_path / "drill" / "model.mat", []).name == "drill"
    assert task_of_files(tmp_path / "drill" / "thing.mat", []).name == "thing"


def test_models_of_some_points_are_refused_by_name(folder: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "small.npy", np.eye(3))
    with pytest.raises(InputError, match=r"small\.npy: holds 3 points"):
        align_object(task_of_files(tmp_path / "small.npy", [folder / "other" / "0.npy"]), QUICK)


def test_millimetres_are_recognised_beside_clouds_with_outliers(tmp_path: Path) -> None:
    rng, files = np.random.default_rng(0), []
    cloud = wedge(rng, 200)
    for name, points in (("mm", 1000 * cloud), ("m", cloud), ("far", np.vstack([cloud, [[40.0, -30, 20]] * 20]))):
        np.save(tmp_path / f"{name}.npy", points)
        files.append(read_cloud(tmp_path / f"{name}.npy"))
    assert in_millimetres(files[0], files[1:2])
    assert in_millimetres(files[0], files[2:])
    assert not in_millimetres(files[1], files[1:])


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("name", "limit_m"), [("drill", 0.0025), ("liq_container", 0.0012)])
def test_the_warm_up_clouds_are_aligned(psg_data: Path, name: str, limit_m: float) -> None:
    folder = psg_data / "icp_warm_up" / name
    target = prepare_target(read_cloud(folder / "model.mat").points / 1000)
    rng = np.random.default_rng(3)
    for k in range(4):
        cloud = read_cloud(folder / f"{k}.npy").points
        began = time.process_time()
        found = register_globally(cloud, target)
        assert time.process_time() - began < 20  # 2 s on a free core; the rest is for compiling
        assert found.trimmed_rmse_m <= limit_m
        assert found.result.status is RegistrationStatus.CONVERGED  # the fourth drill circles between two pairings
        T = found.result.T_target_source
        A = SE3.exp(np.r_[rng.normal(0, 1.5, 3), rng.uniform(-1, 1, 3)])
        for other, move in ((transform_points(A, cloud), A), (cloud[::2], np.eye(4))):
            again = register_globally(other, target).result.T_target_source @ move
            assert np.linalg.norm(SE3.local(T, again)[:3]) < np.radians(0.5)
            assert np.linalg.norm(transform_points(T, cloud) - transform_points(again, cloud), axis=1).max() < 0.001
