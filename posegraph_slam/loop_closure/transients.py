"""Returns of what does not stay: people, doors, glass that reflects now and then."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.execution import Executor, split_range
from posegraph_slam.geometry import xyt_from_pose
from posegraph_slam.jit import kernel
from posegraph_slam.loop_closure.proposals import Candidates
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.registration.beam_matching import between
from posegraph_slam.registration.beam_scans import BeamScans

KEYFRAMES_A_CHUNK = 256
"""Keyframes in one unit of work."""
MARGIN_M = 0.2
"""A point nearer than all that another scan saw along its bearing by this much was not there."""


def without_transients(
    graph: PoseGraph, scans: BeamScans, pairs: Candidates, seen_through_min: int, executor: Executor
) -> BeamScans:
    """Return `scans` (K) less the points that other keyframes look through.

    In each of the `pairs`, at the poses of `graph`, a point of either scan is confirmed by the other one, or seen
    through: it lies nearer than all returns along its bearing. A point goes when at least `seen_through_min` scans
    see through it, and more than confirm it.
    """
    one, other = np.concatenate([pairs.source, pairs.target]), np.concatenate([pairs.target, pairs.source])
    order = np.argsort(one, kind="stable")
    starts = np.searchsorted(one[order], np.arange(len(scans) + 1))
    find = partial(
        _transient,
        starts=starts,
        others=other[order],
        poses=xyt_from_pose(graph.poses @ scans.T_base_lidar),
        seen_through_min=seen_through_min,
        scans=scans,
    )
    parts = executor.map(find, split_range(len(scans), KEYFRAMES_A_CHUNK))
    transient = np.concatenate(parts)
    return replace(scans, kind=np.where(transient, np.uint8(0), scans.kind), thinned=scans.thinned & ~transient)


def _transient(
    keyframes: tuple[int, int],
    *,
    starts: IntArray,
    others: IntArray,
    poses: FloatArray,
    seen_through_min: int,
    scans: BeamScans,
) -> BoolArray:
    """Mark the transient points (k, B) of a range of keyframes."""
    return np.asarray(
        _seen_through(*keyframes, starts, others, poses, seen_through_min, scans.points, scans.kind, scans.geometry)
    )


@kernel
def _seen_through(first, last, starts, others, poses, least, points, kind, geometry):  # type: ignore[no-untyped-def]
    beams = kind.shape[1]
    turn = int(np.round(2 * np.pi / geometry[1]))
    transient = np.zeros((last - first, beams), np.bool_)
    confirmed, through = np.zeros(beams, np.int64), np.zeros(beams, np.int64)
    ranges = np.zeros(beams)
    for scan in range(first, last):
        confirmed[:], through[:] = 0, 0
        for row in range(starts[scan], starts[scan + 1]):
            ref = others[row]
            for k in range(beams):
                ranges[k] = np.hypot(points[ref, k, 0], points[ref, k, 1]) if kind[ref, k] > 0 else 0.0
            pose = between(poses[ref], poses[scan])
            c, s = np.cos(pose[2]), np.sin(pose[2])
            for b in range(beams):
                if kind[scan, b] == 0:
                    continue
                px, py = points[scan, b, 0], points[scan, b, 1]
                x, y = c * px - s * py + pose[0], s * px + c * py + pose[1]
                r = np.hypot(x, y)
                centre = int(np.round((np.arctan2(y, x) - geometry[0]) / geometry[1]))
                nearest, farthest, returns = np.inf, 0.0, 0
                for step in range(-1, 2):
                    k = (centre + step) % turn
                    if k < beams and ranges[k] > 0.0:
                        nearest, farthest = min(nearest, ranges[k]), max(farthest, ranges[k])
                        returns += 1
                if returns == 3 and r < nearest - MARGIN_M:
                    through[b] += 1
                elif returns > 0 and r <= farthest + MARGIN_M:
                    confirmed[b] += 1
        for b in range(beams):
            transient[scan - first, b] = through[b] >= least and through[b] > confirmed[b]
    return transient
