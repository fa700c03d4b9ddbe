"""`psg simulate`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from posegraph_slam.cli.arguments import Overwrite, Quiet, Set, Verbose
from posegraph_slam.cli.console import ProgressBars


class WorldKind(StrEnum):
    """Ground of the simulated world."""

    FLAT = "flat"
    RAMPS = "ramps"


RAMPS = {"world": {"kind": "ramps"}, "kinect": {"images": False}, "lidar": {"antennae": True}}
"""What `--world ramps` sets: images are not rendered there, and the scanner sees the robot's antennae."""


def simulate(
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write the log into.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the world, the drive and the noise.")] = None,
    world: Annotated[
        WorldKind, typer.Option("--world", help="flat; ramps: levels joined by ramps, antennae in view, no images.")
    ] = WorldKind.FLAT,
    settings: Set = None,
    overwrite: Overwrite = False,
    show: Annotated[bool, typer.Option("--show-settings", help="Print all settings as TOML and stop.")] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write the log of a simulated robot, with its truth, as a folder that `psg optimize` reads."""
    from posegraph_slam.datasets.simulation import SimulationSettings
    from posegraph_slam.datasets.simulation import simulate as write_log
    from posegraph_slam.pipeline.settings_files import Layer, build_settings, parse_override, to_toml

    layers = [Layer(source="--world", values=RAMPS)] if world is WorldKind.RAMPS else []
    layers += [parse_override(text) for text in settings or []]
    if seed is not None:
        layers.append(Layer(source="--seed", values={"seed": seed}))
    chosen = build_settings(SimulationSettings, layers, listing="psg simulate --show-settings")
    if show:
        typer.echo(to_toml(chosen), nl=False)
        return
    with ProgressBars(enabled=not quiet) as progress:
        folder = write_log(chosen, out or Path("simulated"), overwrite=overwrite, progress=progress)
    if not quiet:
        typer.echo(f"simulated log with its truth: {folder}")
