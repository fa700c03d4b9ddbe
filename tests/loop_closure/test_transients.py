"""Returns that other keyframes look through are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from posegraph_slam.execution import SerialExecutor
from posegraph_slam.loop_closure.refinement import RefinementSettings, overlapping_pairs
from posegraph_slam.loop_closure.transients import without_transients
from posegraph_slam.pipeline.executors import ThreadExecutor

from .conftest import Laps


def test_a_person_goes_and_the_walls_stay(laps: Laps) -> None:
    graph = laps.graph.with_poses(laps.truth)
    pairs = overlapping_pairs(graph, RefinementSettings())
    keyframe, beams = len(laps.scans) // 2, slice(60, 90)
    points, kind = laps.scans.points.copy(), laps.scans.kind.copy()
    distance = np.linalg.norm(points[keyframe, beams], axis=1, keepdims=True)
    points[keyframe, beams] *= 0.4
    seen = (kind[keyframe, beams] > 0) & (distance[:, 0] > 1.0)
    assert seen.sum() >= 5
    crowded = replace(laps.scans, points=points, kind=kind)
    lasting = without_transients(graph, crowded, pairs, 2, SerialExecutor())
    gone = (crowded.kind > 0) & (lasting.kind == 0)
    assert gone[keyframe, beams][seen].mean() > 0.7
    gone[keyframe] = False
    assert gone.mean() < 0.01
    assert not lasting.thinned[lasting.kind == 0].any()
    with ThreadExecutor(2) as executor:
        again = without_transients(graph, crowded, pairs, 2, executor)
    assert again.kind.tobytes() == lasting.kind.tobytes()


def test_one_look_is_not_enough(laps: Laps) -> None:
    graph = laps.graph.with_poses(laps.truth)
    pairs = overlapping_pairs(graph, RefinementSettings())
    lasting = without_transients(graph, laps.scans, pairs, 1000, SerialExecutor())
    assert lasting.kind.tobytes() == laps.scans.kind.tobytes()
