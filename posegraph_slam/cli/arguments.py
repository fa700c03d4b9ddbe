"""Options that several commands have."""

from __future__ import annotations

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
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what an earlier run left there.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Run directory.")]
Seed = Annotated[int | None, typer.Option("--seed", help="Seed of every random choice.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Print remarks and the time of each stage too.")]


def topic_names(options: list[str] | None) -> dict[str, str]:
    """Return the roles and topics that --topic options name; InputError for a role that does not exist."""
    from posegraph_slam.datasets.rosbag.topics import parse_topics

    return parse_topics(options or [])


def choice(option: str, value: str, allowed: Sequence[str]) -> str:
    """Return `value` if it is allowed; else raise InputError that names the nearest one and all others."""
    import difflib

    from posegraph_slam.errors import InputError

    if value in allowed:
        return value
    near = difflib.get_close_matches(value.lower(), allowed, n=1, cutoff=0.4)
    guess = f"did you mean '{near[0]}'? " if near else ""
    raise InputError(option, f"'{value}' is not known", f"{guess}it is {', '.join(allowed)}")
