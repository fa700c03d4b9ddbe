"""Poses in space and levelled maps on simulated floors with ramps of 18 to 20 degrees, beside the flat pipeline.

    python benchmarks/ramps.py [--worlds one high] [--seeds 5]
    python benchmarks/ramps.py --picture          # docs/images/ramps.png: both maps of `psg simulate --world ramps`

Each log is optimised twice, in the plane and in space. False cells are occupied cells further than 0.15 m from every
obstacle of the world, with the map laid onto the truth by the trajectory. Writes benchmarks/results/ramps.json and,
for all worlds, the table between the markers in docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from posegraph_slam.datasets.simulation import RampSettings, SimulationSettings, WorldSettings, ramp_settings
from posegraph_slam.datasets.simulation.run import drive, simulate_run
from posegraph_slam.datasets.simulation.world import World
from posegraph_slam.evaluation.ape import absolute_pose_error
from posegraph_slam.geometry import align_points, transform_points
from posegraph_slam.pipeline.configuration import load_configuration
from posegraph_slam.pipeline.optimize import OptimizationResult, optimize
from posegraph_slam.report.figures import draw_map
from posegraph_slam.sensors import RobotLog

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PAGE = ROOT / "benchmarks" / "results" / "ramps.json", ROOT / "docs" / "benchmarks.md"
PICTURE, PICTURE_WIDTH = ROOT / "docs" / "images" / "ramps.png", 1800
BEGIN, END = "<!-- ramps: begin -->", "<!-- ramps: end -->"
MARGIN_M = 0.15
WORLDS = {
    "one block, rises of 0.4 to 0.9 m": WorldSettings(kind="ramps"),
    "one block, wide corridors, little clutter": WorldSettings(
        kind="ramps", corridor_width_m=2.6, room_depth_m=3.5, clutter=0.3
    ),
    "three blocks up, rises of 0.9 to 1.6 m": WorldSettings(
        kind="ramps", blocks_up=3, rooms_across=2, room_depth_m=3.4, ramps=RampSettings(rise_min_m=0.9, rise_max_m=1.6)
    ),
    "two by two blocks": WorldSettings(kind="ramps", blocks_across=2, blocks_up=2),
}


def false_cells(result: OptimizationResult, world: World, log: RobotLog) -> int:
    """Count the occupied cells that belong to no obstacle."""
    assert result.occupancy is not None
    assert log.truth is not None
    path, true = result.trajectory.spatial().positions, log.truth.positions
    T_ref_map, _, _ = align_points(path[:, :2], true[:, :2])
    cells = result.occupancy.geometry.cell_to_world(np.argwhere(result.occupancy.occupied))
    points, nearest = transform_points(T_ref_map, cells), np.full(len(cells), np.inf)
    for xa, ya, xb, yb in world.segments:
        start, along = np.array([xa, ya]), np.array([xb - xa, yb - ya])
        u = np.clip((points - start) @ along / (along @ along), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(points - start - u[:, None] * along, axis=1))
    for x, y, radius in world.circles:
        nearest = np.minimum(nearest, np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius))
    return int((nearest > MARGIN_M).sum())


def measure(name: str, settings: SimulationSettings) -> dict[str, Any]:
    """Optimise one log in the plane and in space."""
    world, log = simulate_run(settings).world, drive(settings)
    assert log.truth is not None
    row: dict[str, Any] = {
        "world": name,
        "seed": settings.seed,
        "metres": log.truth.path_length_m,
        "climb_m": float(np.ptp(log.truth.positions[:, 2])),
    }
    for group in ("se2", "se3"):
        started = time.process_time()
        result = optimize(log, load_configuration([], [f"pose_graph.group={group}", "workers=1"]))
        error = absolute_pose_error(result.trajectory, log.truth)
        row[group] = {
            "rmse_m": error.translation_m.rmse,
            "max_m": error.translation_m.max,
            "rmse_deg": error.rotation_deg.rmse,
            "max_deg": error.rotation_deg.max,
            "false_cells": false_cells(result, world, log),
            "cpu_s": time.process_time() - started,
        }
    return row


def draw_picture() -> None:
    """Draw the maps of one log side by side, in the plane and in space."""
    log, pictures = drive(ramp_settings()), []
    with tempfile.TemporaryDirectory() as folder:
        for group in ("se2", "se3"):
            result = optimize(log, load_configuration([], [f"pose_graph.group={group}", "workers=1"]))
            assert result.occupancy is not None
            draw_map(result.occupancy, Path(folder) / f"{group}.png", trajectory=result.trajectory.spatial())
            pictures.append(Image.open(Path(folder) / f"{group}.png").convert("RGB"))
    joined = Image.new("RGB", (sum(each.width for each in pictures), max(each.height for each in pictures)), "white")
    left = 0
    for each in pictures:
        joined.paste(each, (left, joined.height - each.height))
        left += each.width
    joined.resize((PICTURE_WIDTH, round(PICTURE_WIDTH * joined.height / joined.width))).quantize(64).save(PICTURE)


def table(rows: list[dict[str, Any]]) -> str:
    """Write one line a log."""
    lines = [
        "| world | seed | drive, climb [m] | in space: RMSE, max [m] | RMSE, max [deg] | false cells | CPU [s] "
        "| in the plane: RMSE [m] | false cells |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        space, plane = row["se3"], row["se2"]
        lines.append(
            f"| {row['world']} | {row['seed']} | {row['metres']:.0f}, {row['climb_m']:.2f} "
            f"| {space['rmse_m']:.4f}, {space['max_m']:.3f} | {space['rmse_deg']:.2f}, {space['max_deg']:.2f} "
            f"| {space['false_cells']} | {space['cpu_s']:.1f} | {plane['rmse_m']:.3f} | {plane['false_cells']} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), help="beginnings of the worlds' names")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--picture", action="store_true", help="draw the picture of docs/se3.md instead")
    arguments = parser.parse_args()
    if arguments.picture:
        draw_picture()
        return
    rows = []
    for name in (name for name in WORLDS if any(name.startswith(wanted) for wanted in arguments.worlds)):
        for seed in range(1, arguments.seeds + 1):
            rows.append(measure(name, ramp_settings(seed=seed, world=WORLDS[name])))
            print(json.dumps(rows[-1]), flush=True)
    print(table(rows))
    if len({row["world"] for row in rows}) == len(WORLDS):
        RESULTS.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        text = PAGE.read_text(encoding="utf-8")
        head, tail = text.split(BEGIN)[0], text.split(END)[1]
        PAGE.write_text(f"{head}{BEGIN}\n{table(rows)}\n{END}{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
