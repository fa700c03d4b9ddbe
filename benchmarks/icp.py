"""Registration against Open3D and small_gicp: the same clouds, starts and gates, one thread, one process, interleaved.

    python benchmarks/icp.py [--data FOLDER] [--out benchmarks/results/icp.json]

Times are CPU seconds of one thread, the least of all passes: from raw arrays to the result (trees and normals
included) and, for prepared clouds, of the loop alone. Open3D returns a pose, small_gicp a pose and its Hessian, ours a
pose with or without its calibrated covariance: both are timed. All errors are printed; no method is left out for a
larger one. Open3D and small_gicp know only points in space: planar scans are given to them with z = 0, where a normal
fitted to the points is the z axis, so that for their plane methods each scan is stacked in three layers.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402  the number of threads is read when it is imported

from posegraph_slam.datasets.clouds import read_cloud  # noqa: E402
from posegraph_slam.geometry import SE2, SE3  # noqa: E402
from posegraph_slam.registration import IcpSettings, Loss, ResidualKind, downsample, icp, prepare_cloud  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "registration"))
from conftest import ROOM, scan  # noqa: E402

LAYERS_M = (-0.05, 0.0, 0.05)
NEIGHBOURS = 10
ROUNDS = 100
TOLERANCE = 1e-5
GATES_M = (0.5, 1.0)
"""Gates of the planar and the spatial cases; settings are made once, as Open3D's criteria are."""


def main() -> None:
    """Run all cases and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("PSG_DATA"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/icp.json"))
    parser.add_argument("--seconds", type=float, default=1.0, help="time spent on each method and case")
    options = parser.parse_args()
    cases = [room_case(beams) for beams in (181, 1081)]
    if options.data:
        cases += [lidar_case(Path(options.data) / "clouds" / "lidar_pair", voxel) for voxel in (0.25, 0.15)]
    rows = [row for case in cases for row in run_case(case, options.seconds)]
    rows.append({"case": "overhead", "method": "ours", "family": "-", "total_ms": call_overhead_ms()})
    print_rows(rows)
    machine = {"python": platform.python_version(), "machine": platform.machine(), "cores": os.cpu_count()}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"machine": machine, "versions": versions(), "rows": rows}, indent=1) + "\n")


def room_case(beams: int, pairs: int = 20) -> dict[str, Any]:
    """Scans of a room with 1 cm noise, a step of 0.1 m and 3 degrees apart; the guess is no motion."""
    rng = np.random.default_rng(0)
    clouds = []
    for _ in range(pairs):
        at = SE2.exp(np.r_[rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3)])
        T = SE2.exp(np.r_[rng.uniform(-0.1, 0.1, 2), rng.uniform(-0.05, 0.05)])
        target, source = (scan(pose, ROOM, beams, 0.01, rng) for pose in (at, at @ T))
        clouds.append((source, target, T, np.eye(3)))
    return {"name": f"room, {beams} beams", "pairs": clouds, "gate": 0.5, "group": SE2}


def lidar_case(folder: Path, voxel_m: float) -> dict[str, Any]:
    """Return the pair of real scans, thinned, from the identity."""
    source, target = (downsample(read_cloud(folder / f"{n}.ply").points, voxel_m) for n in ("source", "target"))
    T = np.loadtxt(folder / "T_target_source.txt")
    name = f"LiDAR pair, {len(source)} points"
    return {"name": name, "pairs": [(source, target, T, np.eye(4))], "gate": 1.0, "group": SE3}


Method = tuple[str, str, Callable[[Any, Any, Any, float], Any], Callable[[Any, Any], tuple[Any, Any]]]


def ours(
    residual: ResidualKind, loss: Loss = Loss.NONE, *, uncertainty: bool = True
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Our loop on prepared clouds, and how to prepare them."""

    by_gate = {gate: IcpSettings(residual=residual, loss=loss, max_distance_m=gate, max_iterations=ROUNDS,
                                 rotation_tolerance_rad=TOLERANCE, translation_tolerance_m=TOLERANCE,
                                 uncertainty=uncertainty) for gate in GATES_M}  # fmt: skip

    def run(source: Any, target: Any, start: np.ndarray, gate: float) -> np.ndarray:
        return icp(source, target, start, by_gate[gate]).T_target_source

    def prepare(source: np.ndarray, target: np.ndarray) -> tuple[Any, Any]:
        clouds = prepare_cloud(source, neighbours=NEIGHBOURS), prepare_cloud(target, neighbours=NEIGHBOURS)
        if residual is not ResidualKind.POINT_TO_POINT:
            _ = clouds[1].surface
        if residual is ResidualKind.GENERALISED:
            _ = clouds[0].surface
        return clouds

    return run, prepare


def with_open3d(plane: bool) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Open3D's registration_icp; it ends by the relative change of fitness and RMSE."""
    import open3d as o3d

    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    reg = o3d.pipelines.registration
    estimation = reg.TransformationEstimationPointToPlane() if plane else reg.TransformationEstimationPointToPoint()
    criteria = reg.ICPConvergenceCriteria(1e-7, 1e-7, ROUNDS)

    def run(source: Any, target: Any, start: np.ndarray, gate: float) -> np.ndarray:
        return reg.registration_icp(source, target, gate, start, estimation, criteria).transformation

    def prepare(source: np.ndarray, target: np.ndarray) -> tuple[Any, Any]:
        clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(points))) for points in (source, target)]
        if plane:
            clouds[1].estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
        return clouds[0], clouds[1]

    return run, prepare


def with_small_gicp(kind: str) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Run small_gicp's align on one thread; clouds are prepared without thinning."""
    import small_gicp

    def run(source: Any, target: Any, start: np.ndarray, gate: float) -> np.ndarray:
        return small_gicp.align(target[0], source[0], target[1], init_T_target_source=start, registration_type=kind,
                                max_correspondence_distance=gate, num_threads=1, max_iterations=ROUNDS,
                                rotation_epsilon=TOLERANCE, translation_epsilon=TOLERANCE).T_target_source  # fmt: skip

    def prepare(source: np.ndarray, target: np.ndarray) -> tuple[Any, Any]:
        made = []
        for points in (source, target):
            cloud = small_gicp.PointCloud(points)
            tree = small_gicp.KdTree(cloud, num_threads=1)
            if kind != "ICP":
                small_gicp.estimate_normals_covariances(cloud, tree, num_neighbors=NEIGHBOURS, num_threads=1)
            made.append((cloud, tree))
        return made[0], made[1]

    return run, prepare


def methods() -> list[tuple[str, str, Any, Any]]:
    """Return family, name, run and prepare of every method that is installed."""
    kinds = (("point", ResidualKind.POINT_TO_POINT), ("plane", ResidualKind.POINT_TO_PLANE),
             ("generalised", ResidualKind.GENERALISED))  # fmt: skip
    found = [
        *((family, "ours", *ours(kind)) for family, kind in kinds),
        *((family, "ours, pose alone", *ours(kind, uncertainty=False)) for family, kind in kinds),
        ("plane", "ours, Cauchy", *ours(ResidualKind.POINT_TO_PLANE, Loss.CAUCHY)),
    ]
    try:
        found += [("point", "Open3D", *with_open3d(False)), ("plane", "Open3D", *with_open3d(True))]
    except (ImportError, OSError) as error:
        print(f"without Open3D: {error}", file=sys.stderr)
    try:
        for family, kind in (("point", "ICP"), ("plane", "PLANE_ICP"), ("generalised", "GICP")):
            found.append((family, f"small_gicp {kind}", *with_small_gicp(kind)))
    except ImportError as error:
        print(f"without small_gicp: {error}", file=sys.stderr)
    return found


def run_case(case: dict[str, Any], seconds: float) -> list[dict[str, Any]]:
    """Time every method on all pairs of a case, in turns; the least of the passes."""
    entries = []
    for family, name, run, prepare in methods():
        lift = case["group"] is SE2 and not name.startswith("ours")
        pairs = [lifted(pair, family != "point") if lift else pair for pair in case["pairs"]]
        entries.append({"family": family, "name": name, "run": run, "prepare": prepare, "pairs": pairs,
                        "total": [], "align": [], "poses": []})  # fmt: skip
    began = time.process_time()
    while time.process_time() - began < seconds * len(entries) or len(entries[0]["total"]) < 4:
        for entry in entries:
            total = align = 0.0
            entry["poses"] = []
            for source, target, _, start in entry["pairs"]:
                t0 = time.process_time()
                prepared = entry["prepare"](source, target)
                t1 = time.process_time()
                entry["poses"].append(entry["run"](*prepared, start, case["gate"]))
                t2 = time.process_time()
                total, align = total + t2 - t0, align + t2 - t1
            entry["total"].append(total / len(entry["pairs"]))
            entry["align"].append(align / len(entry["pairs"]))
    return [summarise(case, entry) for entry in entries]


def summarise(case: dict[str, Any], entry: dict[str, Any]) -> dict[str, Any]:
    """Error and times of one method; the first pass, which may compile, does not count."""
    errors = []
    for pose, (_, _, T, _) in zip(entry["poses"], case["pairs"], strict=True):
        found = np.asarray(pose)
        if case["group"] is SE2 and found.shape == (4, 4):
            found = found[np.ix_([0, 1, 3], [0, 1, 3])]
        d = len(T) - 1
        off = np.linalg.inv(T) @ found
        turn = np.linalg.norm(off[:d, :d] - np.eye(d)) / np.sqrt(2)
        errors.append((np.linalg.norm(off[:d, d]), np.degrees(turn)))
    moved, turned = np.sqrt(np.mean(np.square(errors), axis=0))
    return {"case": case["name"], "family": entry["family"], "method": entry["name"],
            "total_ms": 1e3 * float(np.min(entry["total"][1:])), "align_ms": 1e3 * float(np.min(entry["align"][1:])),
            "error_m": float(moved), "error_deg": float(turned)}  # fmt: skip


def lifted(pair: tuple[Any, ...], layers: bool) -> tuple[Any, ...]:
    """Put a planar pair into space: at z = 0, or stacked in layers so that fitted normals lie in the plane."""
    source, target, T, start = pair
    pose = np.eye(4)
    pose[:2, :2], pose[:2, 3] = start[:2, :2], start[:2, 2]
    heights = LAYERS_M if layers else (0.0,)
    stacked = [np.vstack([np.column_stack([p, np.full(len(p), z)]) for z in heights]) for p in (source, target)]
    return stacked[0], stacked[1], T, pose


def call_overhead_ms() -> float:
    """Time of one round on twelve prepared points: what a call costs before any work."""
    points = np.random.default_rng(0).normal(size=(12, 2))
    source, target, settings = prepare_cloud(points), prepare_cloud(points), IcpSettings(max_iterations=1)
    times = []
    for _ in range(2000):
        t0 = time.process_time()
        icp(source, target, np.eye(3), settings)
        times.append(time.process_time() - t0)
    return 1e3 * float(np.median(times[100:]))


def versions() -> dict[str, str]:
    """Versions of the packages compared."""
    from importlib.metadata import PackageNotFoundError, version

    result = {}
    for package in ("numpy", "numba", "open3d-cpu", "open3d", "small_gicp"):
        try:
            result[package] = version(package)
        except PackageNotFoundError:
            continue
    return result


def print_rows(rows: list[dict[str, Any]]) -> None:
    """Print the table as Markdown."""
    print(
        "| case | family | method | total [ms] | loop [ms] | error [mm] | error [deg] |\n|---|---|---|--:|--:|--:|--:|"
    )
    for row in rows:
        cells = [row["case"], row["family"], row["method"], f"{row['total_ms']:.3f}"]
        if "align_ms" in row:
            cells += [f"{row['align_ms']:.3f}", f"{1e3 * row['error_m']:.2f}", f"{row['error_deg']:.3f}"]
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
