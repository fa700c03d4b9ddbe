"""ROS 1 bags and ROS 2 bags (sqlite3, MCAP), read without ROS."""

from posegraph_slam.datasets.rosbag.reader import detects, read

__all__ = ["detects", "read"]
