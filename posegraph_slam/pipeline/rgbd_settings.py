"""Configuration of RGB-D logs."""

from __future__ import annotations

from pydantic import Field

from posegraph_slam.loop_closure.rgbd_closing import RgbdLoopSettings
from posegraph_slam.mapping.colour_cloud import ColourCloudSettings
from posegraph_slam.odometry.rgbd_tracker import RgbdOdometrySettings
from posegraph_slam.settings import Settings


class CameraSettings(Settings):
    """Intrinsics that replace those of the log; unset values are the log's own."""

    file: str = ""
    """File of intrinsics: JSON with fx, fy, cx, cy or Open3D's intrinsic_matrix, or ROS' camera_info as YAML."""
    fx_px: float | None = Field(default=None, gt=0)
    """Focal length along the rows, in pixels,"""
    fy_px: float | None = Field(default=None, gt=0)
    """and along the columns."""
    cx_px: float | None = None
    """Column of the optical axis, pixel centres at whole numbers,"""
    cy_px: float | None = None
    """and its row."""
    depth_units_per_m: float | None = Field(default=None, gt=0)
    """Stored depth of one metre."""


class RgbdSettings(Settings):
    """RGB-D logs: camera, odometry, loop closure and cloud."""

    camera: CameraSettings = CameraSettings()
    max_depth_m: float = Field(default=10.0, gt=0)
    """Depths further away are not aligned; what depth is worth falls with its square anyway."""
    odometry: RgbdOdometrySettings = RgbdOdometrySettings()
    loops: RgbdLoopSettings = RgbdLoopSettings()
    cloud: ColourCloudSettings = ColourCloudSettings()
