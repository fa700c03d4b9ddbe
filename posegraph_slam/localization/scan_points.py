"""Scans as the filter wants them: few returns in the base frame, with the normals of their surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.registration.beam_scans import BeamScans


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanPoints:
    """Returns `points` (n, 2) in the base frame, `normals` (n, 3) with 1 where there is one, and the `sensor` (2,).

    `sparse` (m, 2) are the few among them that weigh particles.
    """

    points: FloatArray
    normals: FloatArray
    sparse: FloatArray
    sensor: FloatArray


def scan_points(scans: BeamScans, index: int, points_max: int) -> ScanPoints:
    """Take the thinned returns of one scan, and evenly at most `points_max` of them for the weights."""
    chosen = np.flatnonzero(scans.thinned[index])
    T = scans.T_base_lidar
    points = scans.points[index, chosen].astype(np.float64) @ T[:2, :2].T + T[:2, 2]
    normals = np.zeros((len(chosen), 3))
    normals[:, :2] = scans.lines[index, chosen, :2].astype(np.float64) @ T[:2, :2].T
    normals[:, 2] = scans.kind[index, chosen] == 2
    stride = max(1, -(-len(chosen) // points_max))
    return ScanPoints(
        points=points, normals=normals, sparse=np.ascontiguousarray(points[::stride]), sensor=T[:2, 2].copy()
    )
