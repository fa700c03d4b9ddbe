"""A run directory appears complete or not at all, and reads back as written."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from enum import StrEnum
from pathlib import Path

import numpy as np
import pytest

from posegraph_slam.errors import InputError
from posegraph_slam.pipeline.clock import StageClock
from posegraph_slam.pipeline.configuration import Configuration, configuration_hash
from posegraph_slam.pipeline.run_directory import create_run_directory, plain, read_run_directory, require_free
from posegraph_slam.pipeline.run_record import fingerprint, peak_memory_mib, run_record


def write_run(path: Path, *, overwrite: bool = False, seed: int = 3, mark: str = "") -> None:
    with create_run_directory(path, overwrite=overwrite) as run:
        configuration = Configuration(seed=seed)
        run.write_configuration(configuration)
        run.write_json("metrics.json", {"ape_m": np.float64(0.1), "mark": mark})
        record = run_record(configuration, path.parent, log_format="test", stages_s={"a": 1.0}, jit_compile_s=0.5)
        run.write_json("run.json", record)


def names(folder: Path) -> set[str]:
    return {item.name for item in folder.iterdir()}


def test_run_appears_only_when_complete(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "run"
    with create_run_directory(out) as run:
        run.write_text("maps/note.txt", "é\n")
        assert not out.exists()
        assert run.folder.parent == out.parent
    assert names(out.parent) == {"run"}
    assert (out / "maps" / "note.txt").read_bytes() == "é\n".encode()


def test_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), create_run_directory(tmp_path / "run") as run:
        run.write_text("run.json", "{}")
        raise RuntimeError
    assert names(tmp_path) == set()


def test_existing_run_is_refused_and_survives_a_failed_overwrite(tmp_path: Path) -> None:
    out = tmp_path / "run"
    write_run(out, mark="first")
    with pytest.raises(InputError, match="already holds a run; add --overwrite"):
        write_run(out)
    with pytest.raises(KeyboardInterrupt), create_run_directory(out, overwrite=True) as run:
        run.write_text("metrics.json", "{}")
        assert read_run_directory(out).metrics["mark"] == "first"
        raise KeyboardInterrupt
    assert read_run_directory(out).metrics["mark"] == "first"
    assert names(tmp_path) == {"run"}
    write_run(out, overwrite=True, mark="second")
    assert read_run_directory(out).metrics["mark"] == "second"
    assert names(tmp_path) == {"run"}


def test_nothing_but_a_run_is_ever_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "home"
    folder.mkdir()
    require_free(folder, overwrite=False)  # an empty folder may be used
    (folder / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="not a run directory"):
        write_run(folder, overwrite=True)
    with pytest.raises(InputError, match="is a file"):
        write_run(folder / "thesis.txt", overwrite=True)
    assert (folder / "thesis.txt").read_text() == "years of work"


def test_empty_folder_is_used(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    write_run(tmp_path / "run")
    assert read_run_directory(tmp_path / "run").configuration.seed == 3


def test_a_run_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(InputError, match="already holds a run"), create_run_directory(out) as run:
        run.write_text("run.json", "{}")
        out.mkdir()
        (out / "run.json").write_text('{"other": 1}')
    assert json.loads((out / "run.json").read_text()) == {"other": 1}


def test_record_reads_back(tmp_path: Path) -> None:
    out = tmp_path / "run"
    write_run(out, seed=11)
    run = read_run_directory(out)
    assert run.configuration == Configuration(seed=11)
    assert run.record["configuration_sha256"] == configuration_hash(run.configuration)
    assert run.record["seed"] == 11
    assert run.record["stages_s"] == {"a": 1.0}
    assert run.record["packages"]["numpy"] == np.__version__
    assert run.record["peak_memory_mib"] > 10
    assert run.path("metrics.json").is_file()
    with pytest.raises(InputError, match=r"has no graph\.g2o"):
        run.path("graph.g2o")


def test_what_is_not_a_run_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a run directory"):
        read_run_directory(tmp_path)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(InputError, match="not valid JSON"):
        read_run_directory(tmp_path)
    (tmp_path / "run.json").write_text("[]")
    with pytest.raises(InputError, match="JSON object"):
        read_run_directory(tmp_path)
    (tmp_path / "run.json").write_text('{"format_version": 99}')
    with pytest.raises(InputError, match="format version 99"):
        read_run_directory(tmp_path)


DIGITS = "9" * 5000


@pytest.mark.parametrize(
    ("file", "text", "problem"),
    [
        ("run.json", '{"format_version": 1, "stages_s": {"maps": "x"}}', r"'stages_s\.maps' cannot be used"),
        ("run.json", '{"format_version": 1, "total_s": NaN}', "'total_s' cannot be used"),
        ("run.json", '{"format_version": 1, "input": []}', "'input' cannot be used"),
        ("run.json", '{"format_version": 1, "command": -1}', "'command' cannot be used"),
        ("run.json", f'{{"total_s": {DIGITS}}}', "not valid JSON"),
        ("run.json", "[" * 200_000, "not valid JSON"),
        ("run.json", "\ufeff{}", "not valid JSON"),
        (
            "metrics.json",
            '{"table": {"rows": [{"metric": "a", "unit": ""}]}}',
            r"'table\.rows\.0\.values' cannot be used",
        ),
        ("metrics.json", '{"table": {"stages": 3}}', r"'table\.stages' cannot be used"),
        ("metrics.json", '{"stages": {"optimised": 1}}', r"'stages\.optimised' cannot be used"),
        ("metrics.json", '{"loops_proposed": "many"}', "'loops_proposed' cannot be used"),
    ],
)
def test_a_key_of_the_wrong_kind_is_named(file: str, text: str, problem: str, tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    (tmp_path / "run" / file).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=problem) as caught:
        read_run_directory(tmp_path / "run")
    assert caught.value.where.endswith(file)


def test_keys_that_are_null_or_unknown_are_no_fault(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    (tmp_path / "run" / "metrics.json").write_text('{"table": null, "stages": {}, "own": [1, {"a": null}]}')
    assert read_run_directory(tmp_path / "run").metrics == {"stages": {}, "own": [1, {"a": None}]}


class Colour(StrEnum):
    RED = "red"


def test_plain_values() -> None:
    value = {1: np.array([1.5, np.nan]), "b": (np.int64(2), np.bool_(True)), "c": Colour.RED, "d": Path("x")}
    assert plain(value) == {"1": [1.5, None], "b": [2, True], "c": "red", "d": "x"}
    assert plain(float("inf")) is None
    with pytest.raises(TypeError, match="object"):
        plain(object())


def test_tables_keep_precision(tmp_path: Path) -> None:
    with create_run_directory(tmp_path / "run") as run:
        rows = [[1, np.float64(1 / 3), True, "a,b", None], [2, np.nan, np.bool_(False), "", np.float32(0.5)]]
        run.write_rows("loops.csv", ["i", "x", "ok", "why", "n"], rows)
        with pytest.raises(InputError, match="2 values does not fit 1"):
            run.write_rows("bad.csv", ["i"], [[1, 2]])
    text = (tmp_path / "run" / "loops.csv").read_text()
    assert text == f'i,x,ok,why,n\n1,{1 / 3!r},true,"a,b",\n2,,false,,0.5\n'
    assert names(tmp_path / "run") == {"loops.csv"}


def test_fingerprint_sees_names_and_content(tmp_path: Path) -> None:
    folder = tmp_path / "log"
    (folder / "sub").mkdir(parents=True)
    (folder / "a.txt").write_text("one")
    (folder / "sub" / "b.txt").write_text("two")
    first = fingerprint(folder)
    assert (first["files"], first["bytes"]) == (2, 6)
    assert fingerprint(folder) == first
    (folder / "a.txt").rename(folder / "c.txt")
    assert fingerprint(folder)["sha256"] != first["sha256"]
    single = fingerprint(folder / "c.txt")
    assert single["sha256"] == hashlib.sha256(b"one").hexdigest()


def test_stage_clock_adds_up_repeated_stages() -> None:
    clock = StageClock()
    for name in ("match", "solve", "match"):
        with clock.stage(name):
            pass
    assert list(clock.seconds) == ["match", "solve"]
    assert all(seconds >= 0 for seconds in clock.seconds.values())
    assert peak_memory_mib() > 10


def test_peak_memory_follows_what_is_allocated() -> None:
    """In a process of its own, which has not needed much yet."""
    code = (
        "import numpy as np\n"
        "from posegraph_slam.pipeline.run_record import peak_memory_mib\n"
        "before = peak_memory_mib()\n"
        "block = np.ones(2**23 + int(before) * 2**17)  # 64 MiB more than ever before\n"
        "print(before, peak_memory_mib(), block[0])\n"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after, first = map(float, found.stdout.split())
    assert 10 < before < 1000
    assert before + 60 <= after < 3 * before + 100
    assert first == 1


def test_names_that_are_no_text_are_recorded(tmp_path: Path) -> None:
    name = os.fsdecode(b"log\xff.clf")
    with create_run_directory(tmp_path / "run") as run:
        run.write_configuration(Configuration())
        run.write_json("run.json", {"format_version": 1, "input": {"path": name}})
    assert read_run_directory(tmp_path / "run").record["input"]["path"] == name
