"""Readers from file formats to `RobotLog`, and the registry that finds them."""

from posegraph_slam.datasets.registry import Reader, available_readers, read

__all__ = ["Reader", "available_readers", "read"]
