"""Offline pose-graph SLAM: a robot's log in, an optimised trajectory and maps out.

    import posegraph_slam as psg

    log = psg.read("demo/log")
    run = psg.optimize(log)
    run.save("demo/run")

Names are imported on first use: `import posegraph_slam` itself takes milliseconds.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from posegraph_slam.api import Run, optimize, read, simulate
    from posegraph_slam.datasets.trajectory_files import read_trajectory, write_trajectory
    from posegraph_slam.errors import ConfigurationError, GraphError, InputError, PosegraphSlamError
    from posegraph_slam.geometry import Relations, Trajectory
    from posegraph_slam.mapping.occupancy import OccupancyGrid
    from posegraph_slam.pipeline.configuration import Configuration
    from posegraph_slam.sensors import RobotLog

__version__ = "0.1.0"

__all__ = [
    "Configuration",
    "ConfigurationError",
    "GraphError",
    "InputError",
    "OccupancyGrid",
    "PosegraphSlamError",
    "Relations",
    "RobotLog",
    "Run",
    "Trajectory",
    "__version__",
    "optimize",
    "read",
    "read_trajectory",
    "simulate",
    "write_trajectory",
]

_HOMES = {
    "api": ("Run", "optimize", "read", "simulate"),
    "datasets.trajectory_files": ("read_trajectory", "write_trajectory"),
    "errors": ("ConfigurationError", "GraphError", "InputError", "PosegraphSlamError"),
    "geometry": ("Relations", "Trajectory"),
    "mapping.occupancy": ("OccupancyGrid",),
    "pipeline.configuration": ("Configuration",),
    "sensors": ("RobotLog",),
}
"""The module in which each public name lives; the imports above say the same to type checkers."""

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """Import the home of a public name when it is asked for; AttributeError for other names."""
        home = next((module for module, names in _HOMES.items() if name in names), None)
        if home is None:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{__name__}.{home}"), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        """List the public names, imported or not."""
        return sorted({*globals(), *__all__})
