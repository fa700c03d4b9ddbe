"""Lie groups on stacked arrays, rigid alignment, interpolation and trajectories."""

from posegraph_slam.geometry.deformation import deform
from posegraph_slam.geometry.groups import SE2, SE3, SO2, SO3, Group
from posegraph_slam.geometry.interpolation import interpolate
from posegraph_slam.geometry.kabsch import align_points
from posegraph_slam.geometry.relations import Relations
from posegraph_slam.geometry.spatial import (
    inverse_pose,
    planar_from_spatial,
    pose_from_rotation_translation,
    pose_from_xyt,
    spatial_from_planar,
    transform_points,
    wrap_angle,
    xyt_from_pose,
)
from posegraph_slam.geometry.trajectory import Trajectory

__all__ = [
    "SE2",
    "SE3",
    "SO2",
    "SO3",
    "Group",
    "Relations",
    "Trajectory",
    "align_points",
    "deform",
    "interpolate",
    "inverse_pose",
    "planar_from_spatial",
    "pose_from_rotation_translation",
    "pose_from_xyt",
    "spatial_from_planar",
    "transform_points",
    "wrap_angle",
    "xyt_from_pose",
]
