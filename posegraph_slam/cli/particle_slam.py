"""`psg pf-slam`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from posegraph_slam.cli.arguments import (
    Config,
    Format,
    Json,
    Log,
    Out,
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
    from posegraph_slam.pipeline.recording import RunSummary


def pf_slam(
    log: Log,
    out: Out,
    config: Config = None,
    settings: Set = None,
    log_format: Format = None,
    topic: Topic = None,
    seed: Seed = None,
    workers: Workers = None,
    page: Page = True,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: Json = False,
) -> None:
    """Map a log with a particle filter: no graph, no loop closures; a baseline, and a way to learn."""
    from posegraph_slam.pipeline.configuration import load_configuration
    from posegraph_slam.pipeline.particle_slam import run_particle_slam
    from posegraph_slam.report.page import write_report_of

    configuration = load_configuration(config or [], settings or [], seed=seed, workers=workers)
    with ProgressBars(enabled=not quiet) as progress:
        summary = run_particle_slam(
            log,
            configuration,
            out=out,
            overwrite=overwrite,
            log_format=log_format,
            topics=topic_names(topic),
            report=write_report_of if page else None,
            progress=progress,
        )
    report(summary, show, quiet=quiet, as_json=as_json)


def show(summary: RunSummary) -> None:
    """Print the comparison with odometry."""
    print_table(summary.table.as_text_rows())
