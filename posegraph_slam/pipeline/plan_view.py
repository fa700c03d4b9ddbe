"""What the planar stages see of a log: the log itself, or the plan view of a drive over slopes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from posegraph_slam.arrays import IntArray
from posegraph_slam.execution import Progress
from posegraph_slam.geometry import Trajectory, deform
from posegraph_slam.loop_closure.verification import Apart
from posegraph_slam.odometry.estimate import OdometryEstimate
from posegraph_slam.odometry.levelling import level_laser
from posegraph_slam.odometry.scan_matching import ScanMatchingResult
from posegraph_slam.odometry.scan_odometry import odometry_at_scans
from posegraph_slam.odometry.smoothing import smooth
from posegraph_slam.odometry.spatial import SpatialOdometry, spatial_odometry_at_scans
from posegraph_slam.odometry.timing import without_lag
from posegraph_slam.odometry.wheel_calibration import UNCALIBRATED, WheelCalibration, calibrate_wheels
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.spatial import Heights, lift_graph
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.solve import solve
from posegraph_slam.sensors import LaserScans, RobotLog

WHEELS = ("wheels", "wheels_imu")
"""Sources of odometry that is known at the scans' own stamps."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanView:
    """`scans` and `odometry` of the planar stages; `spatial` is the drive in space, None for `pose_graph.group` se2.

    In space the planar frame is that of a level scanner; all trajectories that leave the pipeline are the base's.
    """

    scans: LaserScans
    odometry: OdometryEstimate
    configuration: Configuration
    raw: LaserScans
    spatial: SpatialOdometry | None = None
    remarks: tuple[str, ...] = field(default=())

    @staticmethod
    def of(log: RobotLog, scans: LaserScans, configuration: Configuration) -> PlanView:
        """Estimate the odometry of a log, and level its `scans` where poses in space are asked for.

        Raises InputError for a log that lacks what its group needs.
        """
        if configuration.pose_graph.group == "se2":
            odometry = odometry_at_scans(log, configuration.odometry)
            return PlanView(scans=scans, odometry=odometry, configuration=configuration, raw=scans)
        spatial = spatial_odometry_at_scans(log, configuration.odometry, configuration.spatial.odometry)
        if not configuration.spatial.search:
            configuration = _trusting(configuration, matched_fraction_min=0.0)
        return _in_space(scans, spatial, configuration)

    def calibration(self, matched: ScanMatchingResult) -> WheelCalibration:
        """Calibrate the wheels against matched scans, where poses in space need it, and wheels are trusted at all."""
        configuration = self.configuration
        wheels, matching = configuration.spatial.wheels, configuration.scan_matching
        wanted = wheels.enabled and matching.matcher == "local_map" and not configuration.spatial.search
        if self.spatial is None or not wanted:
            return UNCALIBRATED
        odometry = without_lag(self.odometry, matched.lag)
        return calibrate_wheels(matched.way, odometry, matching.prediction_sigma_m, wheels)

    def calibrated(self, log: RobotLog, wheels: WheelCalibration) -> PlanView:
        """Return the view with the way of calibrated wheels; itself where they are not."""
        if self.spatial is None or not wheels.known or log.encoders is None:
            return self
        configuration = self.configuration
        spatial = spatial_odometry_at_scans(
            replace(log, encoders=wheels.applied(log.encoders)),
            wheels.noise(configuration.odometry, configuration.spatial.wheels.noise_min_per_sqrt_m),
            configuration.spatial.odometry,
            tilt=self.spatial.tilt,
        )
        sigma_m = min(configuration.scan_matching.prediction_sigma_m, configuration.spatial.wheels.prediction_sigma_m)
        view = _in_space(self.raw, spatial, _trusting(configuration, prediction_sigma_m=sigma_m))
        return replace(view, remarks=(wheels.remark, *view.remarks))

    def apart(self, keyframes: IntArray) -> Apart | None:
        """Tell keyframes (K,) on different levels apart, where heights are known."""
        if self.spatial is None:
            return None
        return Heights.of(self.spatial, keyframes, self.configuration.spatial).apart

    def lifted(self, planar: Trajectory) -> Trajectory:
        """Poses of the base from those of the planar stages, with the heights of the odometry."""
        return planar if self.spatial is None else self.spatial.lift(planar)

    def plan(self, trajectory: Trajectory) -> Trajectory:
        """Poses of the planar stages from those of the base."""
        return trajectory if self.spatial is None else self.spatial.plan_view(trajectory)

    def scans_from(self, trajectory: Trajectory) -> LaserScans:
        """Level the scans again, knowing the ground from the poses (N, 4, 4) of the base that were found."""
        if self.spatial is None:
            return self.scans
        return level_laser(self.raw, self.spatial, self.configuration.spatial.levelling, path=trajectory).scans

    def finish(self, graph: PoseGraph, matched: ScanMatchingResult, progress: Progress) -> tuple[PoseGraph, Trajectory]:
        """Return the final graph and a pose of the base for every scan: the planar graph's own, or that in space."""
        planar = matched.trajectory
        if self.spatial is None:
            return graph, self._smoothed(deform(planar, matched.keyframes, graph.poses), matched)
        lifted = lift_graph(graph, self.spatial, self.configuration.spatial)
        lifted = lifted.with_poses(solve(lifted, self.configuration.pose_graph, progress=progress).poses)
        trajectory = deform(self.spatial.lift(planar), matched.keyframes, lifted.poses)
        smoothed = self._smoothed(self.spatial.plan_view(trajectory), matched)
        height = (trajectory.poses @ self.spatial.T_base_lidar)[:, 2, 3]
        return lifted, self.spatial.lift(smoothed, height)

    def _smoothed(self, planar: Trajectory, matched: ScanMatchingResult) -> Trajectory:
        if not self.configuration.smoothing or self.odometry.source not in WHEELS:
            return planar
        return smooth(planar, matched.scan_information, without_lag(self.odometry, matched.lag))


def _in_space(scans: LaserScans, spatial: SpatialOdometry, configuration: Configuration) -> PlanView:
    level = level_laser(scans, spatial, configuration.spatial.levelling)
    return PlanView(
        scans=level.scans,
        odometry=spatial.planar,
        configuration=configuration,
        raw=scans,
        spatial=spatial,
        remarks=level.remarks,
    )


def _trusting(configuration: Configuration, **matching: float) -> Configuration:
    """Return the configuration with settings of scan matching that rely on wheels and gyro more."""
    changed = configuration.scan_matching.model_copy(update=matching)
    return configuration.model_copy(update={"scan_matching": changed})
