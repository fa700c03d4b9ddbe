"""Offline pose-graph SLAM: a robot's log in, an optimised trajectory and maps out."""

__version__ = "0.1.0"
