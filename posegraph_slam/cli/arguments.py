"""Options that several commands have."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

Log = Annotated[
    Path, typer.Argument(metavar="LOG", help="File or folder of the log; `psg datasets` lists the formats.")
]
Format = Annotated[str | None, typer.Option("--format", help="Reader to use instead of the one that recognises LOG.")]
Topic = Annotated[
    list[str] | None,
    typer.Option(
        "--topic", metavar="ROLE=NAME", help="Topic of a bag for scan, odom, imu, image or truth; repeatable."
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set one configuration key, as section.key=value; repeatable."),
]
Config = Annotated[
    list[str] | None,
    typer.Option("--config", metavar="FILE|PRESET", help="TOML file or preset; repeatable, later ones win."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON and nothing else on stdout.")]
Page = Annotated[bool, typer.Option("--report/--no-report", help="Write report.html at the end.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what an earlier run left there.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Run directory.")]
Seed = Annotated[int | None, typer.Option("--seed", help="Seed of every random choice.")]
Workers = Annotated[
    int | None, typer.Option("--workers", help="Threads where a stage can use several; 0: a core each.")
]


def _tell_at_the_end(context: typer.Context, wanted: bool) -> bool:
    """Print on stderr, when the command ends, how long it took and how much memory it needed."""
    if wanted:
        began = time.perf_counter()

        def tell() -> None:
            from posegraph_slam.cli.console import print_note
            from posegraph_slam.pipeline.run_record import peak_memory_mib

            print_note(f"{time.perf_counter() - began:.2f} s, at most {peak_memory_mib():.0f} MiB of memory")

        context.call_on_close(tell)
    return wanted


Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", help="Print more: remarks, times and memory.", callback=_tell_at_the_end),
]


def topic_names(options: list[str] | None) -> dict[str, str]:
    """Return the roles and topics that --topic options name; InputError for a role that does not exist."""
    from posegraph_slam.datasets.rosbag.topics import parse_topics

    return parse_topics(options or [])


def choice(option: str, value: str, allowed: Sequence[str]) -> str:
    """Return `value` if it is allowed; else raise InputError that names the nearest one and all others."""
    from posegraph_slam.errors import InputError, did_you_mean

    if value in allowed:
        return value
    guess = did_you_mean(value, allowed, cutoff=0.4)
    raise InputError(option, f"'{value}' is not known", f"{guess}it is {', '.join(allowed)}")
