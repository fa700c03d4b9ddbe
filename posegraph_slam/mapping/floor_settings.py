"""Keys of the floor map: which method tells the floor from obstacles in depth images, and what its verdicts weigh."""

from __future__ import annotations

import math
from enum import StrEnum

from pydantic import Field, model_validator

from posegraph_slam.settings import Settings


class FloorMethod(StrEnum):
    """How the floor is found in a depth image."""

    NONE = "none"
    HEIGHT_RANGE = "height_range"
    PLANE = "plane"
    GROUND = "ground"


class HeightRangeSettings(Settings):
    """Floor by the range of heights in each cell of a frame (first robot report, section III.A)."""

    cell_m: float = Field(0.05, gt=0, le=1)
    """Side of the cells in which heights are compared."""
    obstacle_range_m: float = Field(0.2, gt=0, le=10)
    """A cell whose heights range over at least this much is an obstacle."""
    floor_range_m: float = Field(0.01, ge=0, le=10)
    """A cell whose heights range over at most this much is floor; between the two it stays open."""
    min_points: int = Field(5, ge=2)
    """Points that a cell needs: a single one has no range and would always be floor."""
    min_depth_m: float = Field(0.4, ge=0, le=100)
    """Nearest points that count."""
    max_depth_m: float = Field(3.0, gt=0, le=100)
    """Farthest points that count."""

    @model_validator(mode="after")
    def _check_limits(self) -> HeightRangeSettings:
        if self.floor_range_m >= self.obstacle_range_m:
            raise ValueError(
                f"floor_range_m {self.floor_range_m} must be below obstacle_range_m {self.obstacle_range_m}"
            )
        if self.min_depth_m >= self.max_depth_m:
            raise ValueError(f"min_depth_m {self.min_depth_m} must be below max_depth_m {self.max_depth_m}")
        return self


class PlaneSettings(Settings):
    """Floor as the plane that RANSAC finds in the lower part of a depth image (first robot report, section III.B)."""

    bottom_fraction: float = Field(0.25, gt=0, le=1)
    """Lowest part of the image in which the plane is sought and outliers count as obstacles."""
    inlier_m: float = Field(0.03, gt=0, le=1)
    """Largest distance of an inlier from the plane."""
    trials: int = Field(64, ge=1, le=100_000)
    """Planes through three pixels that are tried: with half of the points on the floor, 64 miss it once in 5000."""
    min_inliers: float = Field(0.3, gt=0, le=1)
    """Least share of the bottom's points on the plane; below it the frame is left out."""
    max_tilt_rad: float = Field(0.5, gt=0, le=1.5)
    """A plane steeper than this to the robot is a wall or a box, and its frame is left out; ramps reach 0.35."""
    max_step_m: float = Field(0.3, gt=0, le=10)
    """A plane that passes the robot's base higher or lower than this is a table or a pit: its frame is left out."""
    min_depth_m: float = Field(0.4, ge=0, le=100)
    """Nearest points that count."""
    max_depth_m: float = Field(3.0, gt=0, le=100)
    """Farthest points that count."""

    @model_validator(mode="after")
    def _check_limits(self) -> PlaneSettings:
        if self.min_depth_m >= self.max_depth_m:
            raise ValueError(f"min_depth_m {self.min_depth_m} must be below max_depth_m {self.max_depth_m}")
        return self


class GroundSettings(Settings):
    """Floor as the plane known from the pitch and the height of the camera (humanoid report, section III.C)."""

    max_distance_m: float = Field(0.1, gt=0, le=10)
    """Largest distance of a floor point from the plane; points higher above it are obstacles."""
    min_depth_m: float = Field(0.5, ge=0, le=100)
    """Nearest points that count."""
    max_depth_m: float = Field(5.0, gt=0, le=100)
    """Farthest points that count."""

    @model_validator(mode="after")
    def _check_limits(self) -> GroundSettings:
        if self.min_depth_m >= self.max_depth_m:
            raise ValueError(f"min_depth_m {self.min_depth_m} must be below max_depth_m {self.max_depth_m}")
        return self


class FloorSettings(Settings):
    """How depth images become a floor map, and how much they say against the laser's map."""

    method: FloorMethod = FloorMethod.NONE
    """none: no floor map, and the texture map tells the floor by its height alone."""
    height_range: HeightRangeSettings = HeightRangeSettings()
    plane: PlaneSettings = PlaneSettings()
    ground: GroundSettings = GroundSettings()
    clearance_m: float = Field(1.5, gt=0, le=100)
    """Points higher than this above the level of the robot's base are in nobody's way and are left out."""
    min_pixels: int = Field(5, ge=1)
    """Pixels of a frame that a cell needs to be judged by it."""
    floor_log_odds: float = Field(0.4, ge=0, le=20)
    """Log-odds that a frame takes from a cell that it sees as floor: one frame alone does not call it free."""
    obstacle_log_odds: float = Field(math.log(4), ge=0, le=20)
    """Log-odds that a frame adds to a cell that it sees as an obstacle."""
    min_log_odds: float = Field(-2.5, ge=-100, le=0)
    """Lowest evidence of all frames together: floor under a table must not undo what the laser is sure of."""
    max_log_odds: float = Field(8.0, ge=0, le=100)
    """Highest evidence: more than the laser's 5.5, which looks over low boxes and calls their cells free."""
    max_gap_s: float = Field(0.2, gt=0)
    """Frames without a pose so near in time are skipped."""
    frame_stride: int = Field(1, ge=1)
    """Use every k-th disparity frame."""
