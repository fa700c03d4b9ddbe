"""Files appear whole or not at all, under the name that was asked for."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from posegraph_slam.errors import InputError
from posegraph_slam.files import name_target, replacing


def test_a_file_appears_when_the_block_ends_well(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "a.txt"
    with replacing(path) as temporary:
        temporary.write_text("whole")
        assert not path.exists()
    assert path.read_text() == "whole"
    with pytest.raises(ZeroDivisionError), replacing(path) as temporary:
        temporary.write_text(str(1 / 0))
    assert path.read_text() == "whole"
    assert [each.name for each in path.parent.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("name", ["", ".", "..", "folder"])
def test_a_folder_is_not_taken_for_a_file(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="is a folder; name a file"), replacing(Path(name)):
        pass
    assert [each.name for each in tmp_path.iterdir()] == ["folder"]


def test_errors_of_the_system_name_the_file_and_not_the_temporary_one(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 300)
    with pytest.raises(OSError, match="too long") as caught, replacing(path) as temporary:
        temporary.write_text("x")
    assert caught.value.filename == str(path)


def test_a_full_disk_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with pytest.raises(OSError, match="No space") as caught, replacing(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert caught.value.filename == str(path)


def test_errors_inside_a_temporary_folder_name_the_place_in_the_final_one() -> None:
    error = OSError(errno.ENOSPC, "full", "/out/.run.partial-1/maps/map.png")
    name_target(error, Path("/out/.run.partial-1"), Path("/out/run"))
    assert error.filename == "/out/run/maps/map.png"
    other = PermissionError(errno.EACCES, "denied", "/log")
    name_target(other, Path("/out/.run.partial-1"), Path("/out/run"))
    assert other.filename == "/log"
