"""A simulated drive of two laps, its chain of keyframes, and its truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.simulation import LidarSettings, demo_settings, drive
from posegraph_slam.geometry import SE2, planar_from_spatial
from posegraph_slam.odometry import odometry_at_scans
from posegraph_slam.odometry.scan_matching import ScanMatchingSettings, match_scans
from posegraph_slam.pipeline.optimize import keyframe_chain
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.registration.beam_scans import BeamScans, BeamScanSettings, prepare_beam_scans


@dataclass(frozen=True)
class Laps:
    """Keyframes of a drive: graph of the chain, scans, and true poses (K, 3, 3)."""

    graph: PoseGraph
    scans: BeamScans
    truth: FloatArray

    @property
    def path_m(self) -> FloatArray:
        """Travel at each keyframe."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.graph.poses[:, :2, 2], axis=0), axis=1))])

    def error_m(self, poses: FloatArray) -> float:
        """Largest distance from the truth, both seen from the first keyframe."""
        estimate = SE2.between(np.broadcast_to(poses[0], poses.shape), poses)
        truth = SE2.between(np.broadcast_to(self.truth[0], poses.shape), self.truth)
        return float(np.linalg.norm(estimate[:, :2, 2] - truth[:, :2, 2], axis=1).max())

    def bent(self, turn_rad_per_keyframe: float) -> PoseGraph:
        """The chain with a heading error at every step, as a slipping robot's odometry has it."""
        c = self.graph.constraints
        bend = SE2.exp(np.array([0.0, 0.0, turn_rad_per_keyframe]))
        steps = c.T_i_j @ bend
        poses = [self.graph.poses[0]]
        for step in steps:
            poses.append(poses[-1] @ step)
        sigmas = np.array([0.02, 0.02, 2 * abs(turn_rad_per_keyframe) + 0.003])
        information = np.tile(np.diag(sigmas**-2.0), (len(c), 1, 1))
        chain = type(c)(i=c.i, j=c.j, T_i_j=steps, information=information, kind=c.kind)
        return self.graph.with_poses(np.array(poses)).with_constraints(chain)


@pytest.fixture(scope="session")
def laps() -> Laps:
    settings = demo_settings(lidar=LidarSettings(beams=361, rate_hz=10.0))
    log = drive(settings)
    assert log.scans is not None
    assert log.truth is not None
    scans = prepare_beam_scans(log.scans, BeamScanSettings())
    matched = match_scans(scans, odometry_at_scans(log), ScanMatchingSettings())
    truth = planar_from_spatial(log.truth.poses)[matched.keyframes]
    return Laps(graph=keyframe_chain(matched), scans=scans.select(matched.keyframes), truth=truth)
