"""A simulated log: in memory as readers give it, or as CARMEN files with relations and truth beside it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from posegraph_slam.arrays import Float32Array, FloatArray
from posegraph_slam.datasets.tum import write_tum
from posegraph_slam.geometry import SE2, Relations, Trajectory, pose_from_xyt, spatial_from_planar, wrap_angle
from posegraph_slam.sensors import LaserScans, RobotLog

from simulated.laser import Scanner, mounted

NEAR_S, FAR_S = 9.0, 30.0
RELATIONS = 800
"""At most this many near and as many far relations."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedLog:
    """Scans in recorded order: stamps (N,), ranges (N, B), odometry and true poses (N, 3) [x, y, heading] of the base.

    `odometry_lines` tells whether the logger wrote ODOM messages between the scans.
    """

    name: str
    stamps_s: FloatArray
    ranges_m: Float32Array
    odometry_xyt: FloatArray
    true_xyt: FloatArray
    scanner: Scanner
    odometry_lines: bool = True

    def truth(self) -> Trajectory:
        """Return the true poses of all scans, T_ref_base (N, 3, 3)."""
        return Trajectory(stamps_s=self.stamps_s, poses=pose_from_xyt(self.true_xyt), parent="ref", child="base")

    def robot_log(self, scans: int | None = None) -> RobotLog:
        """Return the log in memory, cut to the first `scans`, with truth and relations."""
        part = slice(scans)
        truth = self.truth().select(np.arange(len(self.stamps_s))[part])
        odometry = Trajectory(
            stamps_s=self.stamps_s[part], poses=pose_from_xyt(self.odometry_xyt[part]), parent="odom", child="base"
        )
        return RobotLog(
            path=Path(f"simulated-{self.name}"),
            format="simulation",
            scans=LaserScans(
                stamps_s=self.stamps_s[part],
                ranges_m=self.ranges_m[part],
                angle_min_rad=-np.pi / 2,
                angle_increment_rad=self.scanner.increment_rad,
                range_min_m=0.021,
                range_max_m=min(self.scanner.range_max_m, self.scanner.no_return_m - 0.005),
                T_base_lidar=spatial_from_planar(pose_from_xyt(np.array(self.scanner.mounting))),
            ),
            scan_odometry=odometry,
            truth=truth.spatial(),
            relations=relations_of(truth),
        )

    def write(self, folder: Path) -> Path:
        """Write NAME.clf, NAME.relations and NAME.tum into `folder`; return the path of the first."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.clf"
        _write_text(path, "".join(self._lines()))
        relations = relations_of(self.truth())
        planar = np.zeros((len(relations), 6))
        planar[:, :2] = relations.T_1_2[:, :2, 3]
        planar[:, 5] = np.arctan2(relations.T_1_2[:, 1, 0], relations.T_1_2[:, 0, 0])
        rows = np.column_stack([relations.stamps_1_s, relations.stamps_2_s, planar])
        _write_text(path.with_suffix(".relations"), "".join(" ".join(f"{v:.6f}" for v in row) + "\n" for row in rows))
        write_tum(self.truth(), path.with_suffix(".tum"))
        return path

    def _lines(self) -> list[str]:
        lines = []
        laser = mounted(self.odometry_xyt, self.scanner.mounting)
        robot = self.odometry_xyt.copy()
        laser[:, 2], robot[:, 2] = wrap_angle(laser[:, 2]), wrap_angle(robot[:, 2])
        for k in range(len(self.stamps_s)):
            stamp = self.stamps_s[k]
            odometry = "{:.6f} {:.6f} {:.6f}".format(*robot[k])
            tail = f"{stamp:.6f} simulation {stamp - self.stamps_s[0]:.6f}\n"
            if self.odometry_lines:
                lines.append(f"ODOM {odometry} 0 0 0 {tail}")
            ranges = " ".join(["%.2f" % value for value in self.ranges_m[k].tolist()])  # noqa: UP031 (twice as fast)
            lines.append(
                f"FLASER {self.ranges_m.shape[1]} {ranges} {'{:.6f} {:.6f} {:.6f}'.format(*laser[k])} {odometry} {tail}"
            )
        return lines


def _write_text(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(text, encoding="ascii")
    os.replace(temporary, path)


def relations_of(truth: Trajectory) -> Relations:
    """Return true relations like those of the public benchmark: a few seconds apart, and of revisited places.

    Far ones are at least `FAR_S` apart in time and lie within 2 m of each other.
    """
    rng = np.random.default_rng(20090)
    stamps, positions = truth.stamps_s, truth.positions
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    at = np.flatnonzero(np.diff(np.floor(path_m / 0.5), prepend=-1.0) > 0)
    near = np.stack([at[:-1], at[1:]], axis=1)
    near = near[np.abs(stamps[near[:, 1]] - stamps[near[:, 0]]) < NEAR_S]
    pairs = at[cKDTree(positions[at]).query_pairs(2.0, output_type="ndarray")]
    pairs = np.sort(pairs[np.abs(stamps[pairs[:, 1]] - stamps[pairs[:, 0]]) > FAR_S].reshape(-1, 2), axis=1)
    chosen = [rng.permutation(each)[:RELATIONS] for each in (near, pairs)]
    first, second = np.concatenate(chosen).T
    T = SE2.between(truth.poses[first], truth.poses[second])
    return Relations(stamps_1_s=stamps[first], stamps_2_s=stamps[second], T_1_2=spatial_from_planar(T))
