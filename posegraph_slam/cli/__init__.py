"""The command `psg`."""

from posegraph_slam.cli.application import main

__all__ = ["main"]
