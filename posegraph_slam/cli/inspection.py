"""`psg inspect`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from posegraph_slam.cli.arguments import Config, Format, Json, Log, Quiet, Set, Topic, Verbose, topic_names
from posegraph_slam.cli.console import print_json, print_table, print_warning

if TYPE_CHECKING:
    from posegraph_slam.datasets.inspection import Inspection


def inspect(
    log: Log,
    log_format: Format = None,
    topic: Topic = None,
    config: Config = None,
    settings: Set = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Show the streams of a log, what is suspicious in it, and what `psg optimize` would do with it."""
    from posegraph_slam.datasets import read
    from posegraph_slam.datasets.inspection import inspect as inspect_log
    from posegraph_slam.pipeline.configuration import load_configuration
    from posegraph_slam.pipeline.plan import describe

    configuration = load_configuration(config or [], settings or [])
    robot_log = read(log, format=log_format, topics=topic_names(topic))
    inspection = inspect_log(robot_log)
    plan = describe(robot_log, configuration)
    if as_json:
        print_json({**inspection.as_dict(), "plan": plan})
    if as_json or quiet:
        return
    print_inspection(inspection)
    typer.secho("\npsg optimize would", bold=True)
    for step in plan:
        typer.echo(f"  - {step}")


def print_inspection(inspection: Inspection) -> None:
    """Print an inspection for people; what is suspicious goes to stderr."""
    typer.secho(f"{inspection.path} ({inspection.format})", bold=True)
    path = "" if inspection.path_length_m is None else f", {inspection.path_length_m:.1f} m by {inspection.path_source}"
    typer.echo(f"{inspection.duration_s:.1f} s{path}\n")
    header = ["stream", "samples", "rate [Hz]", "start [s]", "end [s]", "largest gap [s]", "backward", "repeated"]
    first = min((row.start_s for row in inspection.streams), default=0.0)
    rows = [
        [
            row.name,
            str(row.count),
            f"{row.rate_hz:.2f}",
            f"{row.start_s - first:.3f}",
            f"{row.end_s - first:.3f}",
            f"{row.largest_gap_s:.3f}",
            str(row.backward_steps),
            str(row.duplicate_stamps),
        ]
        for row in inspection.streams
    ]
    print_table([header, *rows])
    typer.echo("")
    for line in _details(inspection):
        typer.echo(line)
    for remark in inspection.remarks:
        typer.echo(f"note: {remark}")
    for warning in inspection.warnings:
        print_warning(warning)


def _details(inspection: Inspection) -> list[str]:
    lines = []
    scans = inspection.scans
    if scans is not None:
        degrees = scans.field_of_view_rad * 57.29577951308232
        lines.append(
            f"laser: {scans.beams} beams over {degrees:.1f} deg, {scans.range_min_m:g} to {scans.range_max_m:g} m"
        )
        lines.append(
            f"ranges: {scans.nearest_m:.2f} to {scans.farthest_m:.2f} m, median {scans.median_m:.2f} m; "
            f"{100 * scans.no_return_share:.1f} % of the beams without return"
        )
    if inspection.disparity_images or inspection.colour_images:
        lines.append(f"images: {inspection.disparity_images} disparity, {inspection.colour_images} colour")
    if inspection.truth_poses:
        lines.append(f"truth: {inspection.truth_poses} poses")
    if inspection.relations:
        lines.append(f"truth: {inspection.relations} relations")
    return lines
