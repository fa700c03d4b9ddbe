"""`psg optimize`."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from posegraph_slam.cli.arguments import (
    Config,
    Format,
    Json,
    Log,
    Overwrite,
    Page,
    Quiet,
    Seed,
    Set,
    Topic,
    Verbose,
    Workers,
    topic_names,
)
from posegraph_slam.cli.console import ProgressBars, print_table
from posegraph_slam.cli.runs import report

if TYPE_CHECKING:
    from posegraph_slam.pipeline.run import RunSummary


RunFolder = Annotated[Path | None, typer.Option("--out", "-o", help="Run directory; default: runs/NAME OF LOG.")]
Truth = Annotated[Path | None, typer.Option("--truth", help="File of true poses: TUM, KITTI, EuRoC or CSV.")]
Camera = Annotated[
    Path | None, typer.Option("--camera", help="File of intrinsics for RGB-D images (JSON, or ROS' YAML).")
]
NoLoops = Annotated[bool, typer.Option("--no-loops", help="Close no loops: scan matching alone.")]
Stages = Annotated[
    str | None, typer.Option("--stages", help="Only these, comma-separated: odometry, matching, graph, maps.")
]
Start = Annotated[
    str | None,
    typer.Option("--from", metavar="STAGE", help="LOG is a run directory: start over from `matching` or `graph`."),
]
EditsFile = Annotated[
    Path | None, typer.Option("--edits", metavar="FILE", help="With --from graph: closures edited by hand.")
]


def optimize(
    log: Log,
    out: RunFolder = None,
    config: Config = None,
    settings: Set = None,
    truth: Truth = None,
    log_format: Format = None,
    camera: Camera = None,
    topic: Topic = None,
    seed: Seed = None,
    workers: Workers = None,
    no_loops: NoLoops = False,
    stages: Stages = None,
    start: Start = None,
    edits: EditsFile = None,
    page: Page = True,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: Json = False,
) -> None:
    """Turn a log into an optimised trajectory and maps, in a run directory of its own."""
    from posegraph_slam.pipeline.rerun import plan_run
    from posegraph_slam.pipeline.run import run
    from posegraph_slam.report.page import write_report_of
    from posegraph_slam.report.run_figures import draw_figures

    if camera is not None:
        settings = [*(settings or []), f"rgbd.camera.file={json.dumps(str(camera))}"]
    plan = plan_run(
        log,
        config or [],
        settings or [],
        seed=seed,
        workers=workers,
        no_loops=no_loops,
        stages=stages,
        start=start,
        edits=edits,
    )
    again = start if edits is None else "edited"
    with ProgressBars(enabled=not quiet) as progress:
        summary = run(
            plan.log,
            plan.configuration,
            out=out or default_out(plan.log if start is None else log.with_name(f"{log.resolve().name}-{again}")),
            overwrite=overwrite,
            log_format=log_format or plan.log_format,
            topics={**(plan.topics or {}), **topic_names(topic)},
            truth=truth,
            matching_of=plan.matching_of,
            edits=plan.edits,
            draw=draw_figures,
            report=write_report_of if page else None,
            progress=progress,
        )
    report(summary, partial(show, verbose=verbose), quiet=quiet, as_json=as_json)
    for picture in () if quiet or as_json else sorted(summary.folder.glob("figures/*.png")):
        typer.echo(f"picture:  {picture}")


def default_out(log: Path) -> Path:
    """Return `runs/<name of the log>`, for a log like `20` inside `ece276a` as `runs/20`."""
    resolved = log.resolve()
    name = resolved.name if resolved.is_dir() else resolved.name.removesuffix(".gz").rsplit(".", 1)[0]
    return Path("runs") / (name or "log")


def show(summary: RunSummary, *, verbose: bool) -> None:
    """Print the comparison of the stages, and with `verbose` the time each took."""
    print_table(summary.table.as_text_rows())
    if verbose:
        record = summary.record
        typer.echo("")
        print_table([["stage", "time [s]"], *([name, f"{value:.2f}"] for name, value in record["stages_s"].items())])
        typer.echo(
            f"of this compiling {record['jit_compile_s']:.1f} s; peak memory {record['peak_memory_mib']:.0f} MiB"
        )
