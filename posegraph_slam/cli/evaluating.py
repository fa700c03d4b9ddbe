"""`psg evaluate` and `psg compare`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from posegraph_slam.cli.arguments import Json, Quiet, Topic, Verbose, choice, topic_names
from posegraph_slam.cli.console import print_json, print_note, print_table

if TYPE_CHECKING:
    from posegraph_slam.pipeline.compare_runs import RunComparison
    from posegraph_slam.pipeline.evaluate import Evaluation

Align = Annotated[
    str, typer.Option("--align", help="auto, none, first, se2, se3 or sim3: how the estimate is laid over the truth.")
]
Distance = Annotated[
    list[float] | None, typer.Option("--distance", min=1e-6, metavar="M", help="RPE over this distance; repeatable.")
]
MaxDt = Annotated[float, typer.Option("--max-dt", min=0, metavar="S", help="Stamps this near belong together.")]
Figures = Annotated[Path | None, typer.Option("--out", "-o", help="Folder for figures and the JSON document.")]
Times = Annotated[Path | None, typer.Option("--times", help="Stamps of KITTI poses of REF, one a line.")]
TrajectoryFormat = Annotated[str | None, typer.Option("--format", help="Format of EST, where it is not recognised.")]
ReferenceFormat = Annotated[str | None, typer.Option("--ref-format", help="Format of REF.")]


def evaluate(
    estimate: Annotated[Path, typer.Argument(metavar="EST", help="Trajectory file, run directory, or log.")],
    reference: Annotated[Path, typer.Argument(metavar="REF", help="True poses, relations, or a log with truth.")],
    align: Align = "auto",
    distance: Distance = None,
    max_dt: MaxDt = 0.02,
    relations: Annotated[Path | None, typer.Option("--relations", help="True relations beside REF.")] = None,
    out: Figures = None,
    source_format: TrajectoryFormat = None,
    reference_format: ReferenceFormat = None,
    times: Times = None,
    topic: Topic = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Measure a trajectory against the truth: APE, RPE over distances, relations."""
    import dataclasses

    from posegraph_slam.datasets.relations import read_relations
    from posegraph_slam.pipeline.convert import ConversionOptions, source_trajectory
    from posegraph_slam.pipeline.evaluate import ALIGNMENTS, DISTANCES_M, read_reference
    from posegraph_slam.pipeline.evaluate import evaluate as measure

    choice("--align", align, ALIGNMENTS)
    options = ConversionOptions(source_format=source_format, topics=topic_names(topic))
    trajectory, remarks = source_trajectory(estimate, options)
    truth = read_reference(reference, format=reference_format, times=times)
    if relations is not None:
        truth = dataclasses.replace(truth, relations=read_relations(relations))
    found = measure(
        trajectory,
        truth,
        alignment=align,  # type: ignore[arg-type]  # checked above
        distances_m=tuple(distance or DISTANCES_M),
        max_dt_s=max_dt,
    )
    if out is not None:
        save(found, out, title=f"{estimate.name} against {reference.name}")
    if as_json:
        print_json(found.as_dict())
    elif not quiet:
        for remark in remarks if verbose else ():
            print_note(remark)
        show(found)
        if out is not None:
            typer.echo(f"\nresults:  {out}")


def save(found: Evaluation, out: Path, *, title: str) -> None:
    """Write the JSON document, and figures where true poses are known."""
    from posegraph_slam.pipeline.run_directory import RunDirectory
    from posegraph_slam.report.evaluation_figures import draw_error_map, draw_errors

    directory = RunDirectory(out)
    directory.write_json("evaluation.json", found.as_dict())
    if found.paths is not None:
        draw_error_map(found.paths, directory.path("error_map.png"), title=title)
        draw_errors(found.paths, found.rpe, directory.path("errors.png"), title=title)


def show(found: Evaluation) -> None:
    """Print the table, and what it was made from."""
    print_table(found.as_text_rows())
    path = found.path
    typer.echo(f"\npath: {path.length_m:.2f} m in {path.duration_s:.1f} s, {path.poses} poses")
    if found.ape is not None:
        scale = f", scale {found.ape.scale:.6f}" if found.ape.alignment == "sim3" else ""
        name = {"origin": "first pose"}.get(found.ape.alignment, found.ape.alignment)
        typer.echo(f"aligned: {name}{scale}; {found.ape.paired} of {found.ape.reference} true poses have an estimate")
        if found.ape.remark:
            print_note(found.ape.remark)
    if found.relations is not None:
        typer.echo(f"relations: {found.relations.used} used, {found.relations.missing} outside the path")


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Two or more run directories.")],
    truth: Annotated[
        Path | None, typer.Option("--truth", help="True poses or relations to measure all runs against.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", metavar="FILE.png", help="Draw maps and paths.")] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Put runs side by side: errors where the truth is known, and which map looks best where it is not."""
    from posegraph_slam.pipeline.compare_runs import compare_runs
    from posegraph_slam.pipeline.evaluate import read_reference

    found = compare_runs(runs, reference=None if truth is None else read_reference(truth))
    if out is not None:
        from posegraph_slam.report.evaluation_figures import draw_comparison

        out.parent.mkdir(parents=True, exist_ok=True)
        draw_comparison(
            {run.name: (run.trajectory, run.occupancy) for run in found.runs}, out, captions=captions(found)
        )
    if as_json:
        print_json(found.as_dict())
    elif not quiet:
        for remark in found.remarks:
            print_note(remark)
        print_table(found.table.as_text_rows())
        if found.best is not None:
            typer.echo(f"\nbest map: {found.best}")
        if verbose:
            for run in found.runs:
                typer.echo(f"{run.name}: {run.run.folder}")
        if out is not None:
            typer.echo(f"picture:  {out}")


def captions(found: RunComparison) -> dict[str, str]:
    """Return the figures that rank a map, for under its name."""
    return {
        run.name: f"crispness {run.quality.crispness:.3f}, double walls {100 * run.quality.double_walls:.1f} %"
        for run in found.runs
        if run.quality is not None
    }
