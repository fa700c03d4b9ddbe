"""Maps of a run: the occupancy grid to keep, and how crisp the map of each stage's trajectory is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.execution import Executor, Progress, silent_progress
from posegraph_slam.geometry import Trajectory
from posegraph_slam.mapping.crispness import crispness
from posegraph_slam.mapping.occupancy import OccupancyGrid, OccupancySettings, build_occupancy
from posegraph_slam.odometry.scan_matching import ScanMatchingResult
from posegraph_slam.pipeline.matching import motion_in_sweep
from posegraph_slam.pipeline.plan_view import PlanView
from posegraph_slam.sensors import LaserScans


def build_stage_maps(
    stages: Mapping[str, Trajectory],
    view: PlanView,
    matched: ScanMatchingResult,
    *,
    executor: Executor,
    progress: Progress = silent_progress,
) -> tuple[OccupancyGrid | None, dict[str, float]]:
    """Build the occupancy map of all scans, and those of the keyframes at each stage for their crispness alone.

    `stages` maps names to trajectories of all scans (N); one is "optimised". Returns the map, None where the
    configuration asks for none, and the crispness of each stage's.
    """
    configuration = view.configuration
    if not configuration.maps:
        return None, {}
    scans = view.scans_from(stages["optimised"])
    motion = motion_in_sweep(scans, matched.trajectory.poses, matched.sweep, configuration.timing)
    plans = {name: view.plan(trajectory) for name, trajectory in stages.items()}
    final = _MapWork(trajectory=plans["optimised"], index=np.arange(len(scans)), keep=True)
    compared = [_MapWork(trajectory=trajectory, index=matched.keyframes, keep=False) for trajectory in plans.values()]
    build = partial(_build_map, scans=scans, motion=motion, settings=configuration.mapping, progress=progress)
    (occupancy, _), *measured = executor.map(build, [final, *compared])
    return occupancy, dict(zip(stages, (figure for _, figure in measured), strict=True))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _MapWork:
    """A map to be built from the scans at `index`; only its crispness is wanted where it is not to be kept."""

    trajectory: Trajectory
    index: IntArray
    keep: bool


def _build_map(
    work: _MapWork, *, scans: LaserScans, motion: FloatArray, settings: OccupancySettings, progress: Progress
) -> tuple[OccupancyGrid | None, float]:
    index = work.index
    grid = build_occupancy(
        scans if work.keep else scans.select(index),
        work.trajectory.select(index),
        settings,
        motion=motion[index],
        progress=progress if work.keep else silent_progress,
    )
    return (grid, 0.0) if work.keep else (None, crispness(grid))
