"""How time and memory of `optimize` grow with the length of a log: 1, 2, 4 and 8 times a simulated one.

    python benchmarks/scaling.py [--log office_361] [--size 2] [--out benchmarks/results/scaling.json]

World and drive grow together. Each length runs in a process of its own, with compiled kernels. Writes the JSON file and
docs/images/scaling.png, and tells the exponents b of time ~ scans^b and of memory beyond the imported libraries.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "scaling.json"
FIGURE = ROOT / "docs" / "images" / "scaling.png"
FACTORS = (1, 2, 4, 8)
KEPT = (
    "scans", "ape_m", "proposed", "accepted", "false", "wall_s", "cpu_s", "stages_s",
    "peak_mib", "floor_mib", "log_mib",
)  # fmt: skip


def measure(log: str, size: float, overrides: Sequence[str]) -> dict[str, Any]:
    """Run one length in a process of its own."""
    script = str(Path(__file__).with_name("stress.py"))
    command = [sys.executable, script, log, "--one", "--size", str(size)]
    command += [word for override in overrides for word in ("--set", override)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr.strip().splitlines()[-1])
    report = json.loads(done.stdout)
    return {"size": size, **{key: report[key] for key in KEPT}}


def exponent(rows: Sequence[dict[str, Any]], values: Sequence[float]) -> float:
    """Slope of log(value) over log(scans), by least squares."""
    import numpy as np

    slope, _ = np.polyfit(np.log([row["scans"] for row in rows]), np.log(values), 1)
    return float(slope)


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw time of the stages and memory over the number of scans, with straight lines through the first point."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    scans = [row["scans"] for row in rows]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    below = [0.0] * len(rows)
    for stage in rows[0]["stages_s"]:
        top = [b + row["stages_s"][stage] for b, row in zip(below, rows, strict=True)]
        left.fill_between(scans, below, top, label=stage, alpha=0.75, linewidth=0)
        below = top
    left.plot(scans, [row["cpu_s"] for row in rows], "k.-", linewidth=1, label="CPU time")
    left.plot(scans, [rows[0]["cpu_s"] * n / scans[0] for n in scans], "k--", linewidth=1, label="proportional")
    left.set(xlabel="scans", ylabel="time [s]", xlim=(scans[0], scans[-1]), ylim=(0, None))
    left.legend(fontsize=8)
    used = [row["peak_mib"] - row["floor_mib"] for row in rows]
    right.plot(scans, [row["peak_mib"] for row in rows], "o-", label="peak of the process")
    right.plot(scans, used, "o-", label="above the imported libraries")
    right.plot(scans, [row["log_mib"] for row in rows], "o-", label="the log itself (ranges)")
    right.set(xlabel="scans", ylabel="memory [MiB]", xlim=(0, scans[-1]), ylim=(0, None))
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name("." + path.name)
    figure.savefig(temporary, dpi=130, metadata={"Software": None})
    os.replace(temporary, path)


def main() -> None:
    """Measure all lengths, print a line for each, write the results and the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", default="office_361")
    parser.add_argument("--size", type=float, default=2.0, help="size of the shortest log")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a configuration key")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--figure", type=Path, default=FIGURE)
    arguments = parser.parse_args()
    measure(arguments.log, 1.0, arguments.set)  # compiles what is not in the cache
    rows = []
    for factor in FACTORS:
        row = measure(arguments.log, arguments.size * factor, arguments.set)
        rows.append(row)
        print(
            f"{factor}x: {row['scans']:6d} scans {row['wall_s']:7.1f} s {row['scans'] / row['wall_s']:6.0f}/s "
            f"{row['peak_mib']:6.0f} MiB  APE {row['ape_m']['optimised']:.3f} m  false closures {row['false']}",
            flush=True,
        )
    growth = {
        "CPU time": round(exponent(rows, [row["cpu_s"] for row in rows]), 3),
        "time": round(exponent(rows, [row["wall_s"] for row in rows]), 3),
        "memory": round(exponent(rows, [row["peak_mib"] - row["floor_mib"] for row in rows]), 3),
        **{
            f"time of {stage}": round(exponent(rows, [max(row["stages_s"][stage], 1e-3) for row in rows]), 3)
            for stage in rows[0]["stages_s"]
        },
    }
    print("grows as scans to the power of", ", ".join(f"{name} {value}" for name, value in growth.items()))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    content = {"log": arguments.log, "rows": rows, "exponents": growth}
    arguments.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    draw(rows, arguments.figure)


if __name__ == "__main__":
    main()
