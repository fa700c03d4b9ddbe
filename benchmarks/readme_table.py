"""The table of accuracy and speed in README.md, from the results of `slam2d.py`; run alone, it writes it anew."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from references import MEASURED, REFERENCES

ROOT = Path(__file__).resolve().parents[1]
PAGE, RESULTS = ROOT / "README.md", ROOT / "benchmarks" / "results" / "slam2d.json"
BEGIN, END = "<!-- slam2d: begin -->", "<!-- slam2d: end -->"
LOGS = {"intel": "Intel lab", "fr079": "Freiburg 079"}


def readme_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the Markdown: a row a system and source, for each log the mean over all relations and CPU seconds."""
    by_log = {row["log"]: row for row in rows if row["log"] in LOGS}
    header = " | ".join(f"{name}, m | ° | CPU s" for name in LOGS.values())
    lines = [f"| | {header} | source |", "|---|" + "---|" * (3 * len(LOGS) + 1)]
    for stage in ("odometry", "optimised"):
        cells = []
        for log in LOGS:
            errors = by_log[log]["stages"][stage]["all"]
            metres, degrees = errors["translation_m"]["mean"], errors["rotation_deg"]["mean"]
            cpu = f"{by_log[log]['cpu_s']:.0f}" if stage == "optimised" else ""
            cells += [f"{metres:.4f}", f"{degrees:.2f}", cpu]
        name = "**posegraph_slam**" if stage == "optimised" else stage
        lines.append(f"| {name} | {' | '.join(cells)} | this benchmark |")
    for system, source in dict.fromkeys((each.system, each.source) for each in REFERENCES):
        cells = []
        for log in LOGS:
            known = next((r for r in REFERENCES if (r.log, r.system, r.source) == (log, system, source)), None)
            values = (None, None, None) if known is None else (known.metres, known.degrees, known.cpu_s)
            cells += ["" if value is None else f"{value:g}" for value in values]
        lines.append(f"| {system} | {' | '.join(cells)} | {'measured †' if source == MEASURED else source} |")
    return "\n".join([*lines, "", f"† {MEASURED}."])


def write_table(rows: Sequence[dict[str, Any]], page: Path = PAGE) -> None:
    """Replace what stands between the markers of the page."""
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise SystemExit(f"{page}: the markers {BEGIN} and {END} are missing")
    page.write_text(f"{before}{BEGIN}\n{readme_table(rows)}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    write_table(json.loads(RESULTS.read_text(encoding="utf-8"))["rows"])
