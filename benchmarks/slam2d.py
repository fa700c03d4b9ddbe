"""Accuracy, speed and memory of `psg optimize` on every 2D laser log under PSG_DATA, with one configuration.

    python benchmarks/slam2d.py [--logs intel fr079 20] [--scans 3000] [--out benchmarks/results/slam2d.json]

Each log is one run of the command in a process of its own; times and memory are those of the whole process, from
parsing to the last picture. Kernels are compiled before, by a run over the first scans of each log. The table goes
to the JSON file and, for complete logs, between the markers in docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from readme_table import write_table

from references import REFERENCES, Reference

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "slam2d.json"
PAGE = ROOT / "docs" / "benchmarks.md"
BEGIN, END = "<!-- slam2d: begin -->", "<!-- slam2d: end -->"
WARM_SCANS = 400
STAGES = ("odometry", "scan matching", "optimised")
SCAN_LINES = (b"FLASER", b"ROBOTLASER1", b"RLASER")


def find_logs(data: Path) -> dict[str, Path]:
    """Return the logs with known truth by name: CARMEN logs with relations beside them, and ECE276A folders."""
    carmen = {path.stem: path for path in sorted((data / "carmen").glob("*.clf"))}
    found = {name: path for name, path in carmen.items() if path.with_suffix(".relations").is_file()}
    return found | {path.name: path for path in sorted((data / "ece276a").glob("*")) if any(path.glob("Hokuyo*.npz"))}


def cut(log: Path, scans: int, folder: Path) -> Path:
    """Copy the first scans of a log, with its truth, into `folder`."""
    if log.is_dir():
        short = folder / log.name
        shutil.copytree(log, short)
        for file in short.glob("Hokuyo*.npz"):
            with np.load(file, allow_pickle=False) as arrays:
                names = {"ranges": arrays["ranges"][:, :scans], "time_stamps": arrays["time_stamps"][..., :scans]}
                np.savez(file, **{**{name: arrays[name] for name in arrays.files}, **names})
        return short
    short, taken = folder / log.name, 0
    with log.open("rb") as source, short.open("wb") as target:
        for line in source:
            taken += line.startswith(SCAN_LINES)
            if taken > scans:
                break
            target.write(line)
    for suffix in (".relations", ".tum"):
        if log.with_suffix(suffix).is_file():
            shutil.copy(log.with_suffix(suffix), short.with_suffix(suffix))
    return short


def run(log: Path, folder: Path, overrides: Sequence[str]) -> dict[str, Any]:
    """Run `psg optimize` on a log and return its metrics and record, with the CPU time of the process.

    Raises RuntimeError with the command's last line where it fails.
    """
    code = "import sys; from posegraph_slam.cli import main; sys.argv[0] = 'psg'; main()"
    command = [sys.executable, "-c", code, "optimize", str(log), "--out", str(folder / "run"), "--overwrite"]
    command += ["--json", "--quiet", *(word for override in overrides for word in ("--set", override))]
    started, before = time.perf_counter(), os.times()
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    wall, after = time.perf_counter() - started, os.times()
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1])
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return {**json.loads(done.stdout), "wall_s": wall, "cpu_s": cpu}


def measure(name: str, log: Path, scans: int | None, overrides: Sequence[str]) -> dict[str, Any]:
    """Warm the kernels, run one log, and gather the columns of the table."""
    with tempfile.TemporaryDirectory(prefix="slam2d-") as temporary:
        folder = Path(temporary)
        warm = folder / "warm"
        warm.mkdir()
        run(cut(log, WARM_SCANS, warm), folder, overrides)
        if scans:
            log = cut(log, scans, folder)
        result = run(log, folder, overrides)
    metrics, record = result["metrics"], result["run"]
    proposed, accepted = metrics["loops_proposed"], metrics["loops_accepted"]
    return {
        "log": name,
        "scans": metrics["scans"],
        "cut_to": scans,
        "stages": {stage: accuracy(metrics["stages"][stage]) for stage in STAGES},
        "wall_s": round(result["wall_s"], 2),
        "cpu_s": round(result["cpu_s"], 2),
        "scans_per_s": round(metrics["scans"] / result["wall_s"], 1),
        "peak_mb": round(record["peak_memory_mib"] * 1.048576, 1),
        "jit_compile_s": record["jit_compile_s"],
        "stages_s": record["stages_s"],
        "keyframes": metrics["keyframes"],
        "closures": {"proposed": proposed, "accepted": accepted, "rejected": proposed - accepted},
        "posegraph_slam": record["posegraph_slam"],
        "configuration_sha256": record["configuration_sha256"],
    }


def accuracy(stage: dict[str, Any]) -> dict[str, Any]:
    """Pick the errors of one stage: relations near, far and all, and the absolute error, each where it is known."""
    picked: dict[str, Any] = {}
    for group in ("near", "far", "all") if stage["relations"] else ():
        errors = stage["relations"][group]
        picked[group] = {
            part: {key: round(errors[part][key], 5) for key in ("mean", "std", "count")}
            for part in ("translation_m", "rotation_deg")
            if errors[part]
        }
    if stage["ape"]:
        picked["ape_m"] = round(stage["ape"]["translation_m"]["rmse"], 5)
        picked["ape_deg"] = round(stage["ape"]["rotation_deg"]["mean"], 5)
    return picked


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Return the Markdown of all tables."""
    parts = [_accuracy_table(row) for row in rows if "near" in row["stages"]["optimised"]]
    absolute = [row for row in rows if "ape_m" in row["stages"]["optimised"]]
    if absolute:
        parts.append(_absolute_table(absolute))
    return "\n\n".join([*parts, _resources_table(rows)])


def _accuracy_table(row: dict[str, Any]) -> str:
    near, far, everything = (_count(row["stages"]["optimised"], group) for group in ("near", "far", "all"))
    lines = [
        f"**{row['log']}**: mean ± standard deviation of {everything} relations, of them {near} near (at most 10 s "
        f"apart) and {far} far",
        "",
        "| | near, m | near, ° | far, m | far, ° | all, m | all, ° | CPU s | source |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for stage in STAGES:
        errors = row["stages"][stage]
        cells = [
            _cell(errors[group].get(part), digits)
            for group in ("near", "far", "all")
            for part, digits in (("translation_m", 4), ("rotation_deg", 3))
        ]
        cpu = f"{row['cpu_s']:.0f}" if stage == "optimised" else ""
        name = f"**{stage}**" if stage == "optimised" else stage
        lines.append(f"| {name} | {' | '.join(cells)} | {cpu} | this run |")
    lines += [_reference_line(reference) for reference in REFERENCES if reference.log == row["log"]]
    return "\n".join(lines)


def _count(stage: dict[str, Any], group: str) -> int:
    return int(stage[group].get("translation_m", {}).get("count", 0))


def _cell(statistics: dict[str, float] | None, digits: int) -> str:
    return "–" if statistics is None else f"{statistics['mean']:.{digits}f} ± {statistics['std']:.{digits}f}"


def _reference_line(reference: Reference) -> str:
    def cell(mean: float | None, std: float | None) -> str:
        return "" if mean is None else f"{mean:g}" + ("" if std is None else f" ± {std:g}")

    metres = cell(reference.metres, reference.metres_std)
    degrees = cell(reference.degrees, reference.degrees_std)
    cpu = "" if reference.cpu_s is None else f"{reference.cpu_s:g}"
    return f"| {reference.system} | | | | | {metres} | {degrees} | {cpu} | {reference.source} |"


def _absolute_table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [
        "Absolute error against the true trajectory (RMSE of position after rigid alignment, mean of heading):",
        "",
        "| log | " + " | ".join(STAGES) + " |",
        "|---|" + "---|" * len(STAGES),
    ]
    for row in rows:
        cells = [f"{row['stages'][stage]['ape_m']:.4f} m, {row['stages'][stage]['ape_deg']:.3f}°" for stage in STAGES]
        lines.append(f"| {row['log']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _resources_table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [
        "Whole process, from parsing to the last picture, kernels compiled before:",
        "",
        "| log | scans | scans/s | wall s | CPU s | peak MB | keyframes | closures proposed | accepted | rejected |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        closures = row["closures"]
        lines.append(
            f"| {row['log']} | {row['scans']} | {row['scans_per_s']:.0f} | {row['wall_s']:.1f} | {row['cpu_s']:.1f} | "
            f"{row['peak_mb']:.0f} | {row['keyframes']} | {closures['proposed']} | {closures['accepted']} | "
            f"{closures['rejected']} |"
        )
    return "\n".join(lines)


def write_between_markers(page: Path, begin: str, end: str, text: str) -> None:
    """Replace what stands between two markers of a page."""
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise SystemExit(f"{page}: the markers {begin} and {end} are missing")
    replace_text(page, f"{before}{begin}\n{text}\n{end}{after}")


def replace_text(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def main() -> None:
    """Measure the chosen logs, print the tables and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", nargs="+", help="names of logs; all by default")
    parser.add_argument("--scans", type=int, help="only the first scans of each log; the page is then left alone")
    parser.add_argument("--out", type=Path, help="JSON file; default: the committed one, for complete logs")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a configuration key")
    arguments = parser.parse_args()
    if "PSG_DATA" not in os.environ:
        raise SystemExit("slam2d.py needs the real logs: set PSG_DATA to their folder")
    logs = find_logs(Path(os.environ["PSG_DATA"]).resolve())
    unknown = set(arguments.logs or ()) - set(logs)
    if unknown or not logs:
        raise SystemExit(f"no log named {', '.join(unknown)}; there are {', '.join(logs) or 'none'}")
    rows = []
    for name in arguments.logs or logs:
        rows.append(measure(name, logs[name], arguments.scans, arguments.set))
        print(f"{name}: {rows[-1]['scans']} scans in {rows[-1]['wall_s']:.1f} s", file=sys.stderr, flush=True)
    text = tables(rows)
    print(text)
    official = not (arguments.logs or arguments.scans or arguments.set)
    if arguments.out or official:
        content = {"machine": machine(), "rows": rows}
        replace_text(arguments.out or RESULTS, json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    if official:
        write_between_markers(PAGE, BEGIN, END, text)
        write_table(rows)


def machine() -> dict[str, Any]:
    """Say what the times were measured on."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    model = [line for line in _cpu_lines() if line.startswith("model name")]
    return {"cores": cores, "processor": model[0].partition(":")[2].strip() if model else "unknown"}


def _cpu_lines() -> list[str]:
    info = Path("/proc/cpuinfo")
    return info.read_text(encoding="utf-8").splitlines() if info.is_file() else []


if __name__ == "__main__":
    main()
