from __future__ import annotations

import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from posegraph_slam import datasets
from posegraph_slam.datasets import registry
from posegraph_slam.errors import InputError
from posegraph_slam.sensors import RobotLog


def make_reader(name: str) -> registry.Reader:
    return registry.Reader(
        name=name,
        description="a reader of another package",
        layout="a file .other",
        detects=lambda path: path.suffix == ".other",
        read=lambda path: RobotLog(path=path, format=name),
    )


OTHER, CLASHING = make_reader("other"), make_reader("carmen")


@pytest.fixture
def entry_points(monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"a": "OTHER", "b": "CLASHING", "c": "make_reader", "d": "absent"}
    points = [
        metadata.EntryPoint(name, f"{__name__}:{value}", registry.ENTRY_POINT_GROUP) for name, value in values.items()
    ]
    monkeypatch.setattr(registry.metadata, "entry_points", lambda *, group: points if "readers" in group else [])


def test_another_package_adds_a_reader_and_a_broken_one_is_left_out(entry_points: None, tmp_path: Path) -> None:
    with pytest.warns(RuntimeWarning) as caught:
        readers = datasets.available_readers()
    assert [reader.name for reader in readers] == [
        "ece276a",
        "carmen",
        "rosbag",
        "humanoid",
        "imu_vicon",
        "euroc",
        "rgbd",
        "other",
    ]
    messages = " ".join(str(warning.message) for warning in caught)
    assert "'carmen' exists" in messages
    assert "make_reader is not a posegraph_slam Reader" in messages
    assert "absent cannot be loaded" in messages
    path = tmp_path / "log.other"
    path.touch()
    with pytest.warns(RuntimeWarning):
        assert datasets.read(path).format == "other"


def test_a_missing_path_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.clf: no such file or folder"):
        datasets.read(tmp_path / "nowhere.clf")


def test_an_empty_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the folder is empty"):
        datasets.read(tmp_path)


def test_what_nothing_recognises_names_the_formats(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("A page about FLASER messages.\n")
    with pytest.raises(InputError) as caught:
        datasets.read(path)
    assert "no reader recognises it" in str(caught.value)
    assert all(reader.name in str(caught.value) for reader in registry.BUILT_IN)


@pytest.mark.parametrize(("given", "meant"), [("karmen", "carmen"), ("ECE276", "ece276a")])
def test_an_unknown_format_suggests_the_nearest(given: str, meant: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"unknown format '{given}'; did you mean '{meant}'"):
        datasets.read(_touched(tmp_path), format=given)


def test_an_unknown_format_like_no_other_lists_all(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unknown format 'zzz'; available: ece276a, carmen"):
        datasets.read(_touched(tmp_path), format="zzz")


def _touched(folder: Path) -> Path:
    path = folder / "file"
    path.touch()
    return path


def test_listing_the_readers_imports_nothing_heavy() -> None:
    code = (
        "import sys; from posegraph_slam import datasets; datasets.available_readers(); "
        "print([name for name in ('numpy', 'scipy', 'numba', 'gtsam', 'cv2') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
