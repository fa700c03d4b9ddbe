"""`psg convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from posegraph_slam.cli.arguments import Json, Overwrite, Quiet, Topic, Verbose, topic_names
from posegraph_slam.cli.console import print_json, print_note


def convert(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Trajectory, log, run directory or cloud.")],
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="File or folder to write.")],
    to: Annotated[
        str | None, typer.Option("--to", help="tum, kitti, euroc, csv, carmen, ece276a, rgbd, ply; else by suffix.")
    ] = None,
    source_format: Annotated[
        str | None, typer.Option("--format", help="Format of SOURCE, where it is not recognised.")
    ] = None,
    times: Annotated[Path | None, typer.Option("--times", help="Stamps of KITTI poses, one a line.")] = None,
    stream: Annotated[str, typer.Option("--stream", help="Of a log as a trajectory: odometry or truth.")] = "odometry",
    topic: Topic = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write a trajectory, log or point cloud in another format."""
    from posegraph_slam.pipeline.convert import ConversionOptions
    from posegraph_slam.pipeline.convert import convert as convert_file

    options = ConversionOptions(source_format=source_format, times=times, topics=topic_names(topic), stream=stream)
    written = convert_file(source, target, to=to, options=options, overwrite=overwrite)
    if as_json:
        print_json(written.as_dict())
    elif not quiet:
        for remark in written.remarks:
            print_note(remark)
        typer.echo(f"{written.count} {written.unit} as {written.format}: {written.target}")
