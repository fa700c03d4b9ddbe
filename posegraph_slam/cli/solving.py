"""`psg solve`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from posegraph_slam.cli.arguments import Json, Quiet, Verbose
from posegraph_slam.cli.console import ProgressBars, print_json, print_note, print_table, print_warning

if TYPE_CHECKING:
    from posegraph_slam.pose_graph.graph import PoseGraph
    from posegraph_slam.pose_graph.optimum import Optimum

Graph = Annotated[Path, typer.Argument(metavar="GRAPH", help="Pose graph: .g2o, .graph or .toro.")]
Out = Annotated[Path | None, typer.Option("--out", help="Write the solved graph there (.g2o, .graph or .toro).")]
NoCertify = Annotated[bool, typer.Option("--no-certify", help="Skip the proof of optimality.")]
Init = Annotated[str, typer.Option("--init", help="Start: best, given (file), odometry, spanning_tree or chordal.")]
Method = Annotated[str, typer.Option("--method", help="levenberg_marquardt, gauss_newton, dogleg or isam2.")]
SolverKind = Annotated[str, typer.Option("--solver", help="auto, sparse (our own) or gtsam.")]
Iterations = Annotated[int, typer.Option("--max-iterations", min=1, help="Accepted steps at most.")]
Robust = Annotated[
    str, typer.Option("--robust", help="False loops: none, huber, cauchy, geman_mcclure, dcs, gnc or auto.")
]
RobustParameter = Annotated[
    float | None, typer.Option("--robust-parameter", help="Scale of the loss; unset: the standard one.")
]
ComponentOption = Annotated[
    str | None, typer.Option("--component", help="Disconnected parts: largest keeps one, all solves each.")
]
Clamp = Annotated[bool, typer.Option("--clamp", help="Repair indefinite or asymmetric information.")]
Edges = Annotated[Path | None, typer.Option("--edges", help="Write chi-square and weight of every edge (CSV).")]
Plot = Annotated[Path | None, typer.Option("--plot", help="Draw the solved graph into a PNG.")]
Marginals = Annotated[
    list[int] | None, typer.Option("--marginal", metavar="ID", help="Covariance of a node; repeatable.")
]
Relative = Annotated[
    list[str] | None, typer.Option("--relative", metavar="I,J", help="Covariance of J seen from I; repeatable.")
]
DropEdge = Annotated[
    list[str] | None, typer.Option("--drop-edge", metavar="N|I,J", help="Leave out edge N, or those of I and J.")
]
DropKind = Annotated[
    list[str] | None, typer.Option("--drop-kind", metavar="KIND", help="Leave out odometry or external edges.")
]
AddEdge = Annotated[
    list[str] | None,
    typer.Option("--add-edge", metavar="I,J,POSE,SIGMAS", help="Add an edge; numbers with commas; repeatable."),
]


def solve(
    graph: Graph,
    out: Out = None,
    init: Init = "best",
    no_certify: NoCertify = False,
    robust: Robust = "none",
    robust_parameter: RobustParameter = None,
    method: Method = "levenberg_marquardt",
    solver: SolverKind = "auto",
    max_iterations: Iterations = 100,
    component: ComponentOption = None,
    clamp: Clamp = False,
    drop_edge: DropEdge = None,
    drop_kind: DropKind = None,
    add_edge: AddEdge = None,
    edges: Edges = None,
    plot: Plot = None,
    marginal: Marginals = None,
    relative: Relative = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Solve a pose graph and prove the solution optimal.

    --out, --edges and --plot write files; nothing else is written.
    """
    from posegraph_slam.cli.graph_requests import covariances, edited, optimum_settings
    from posegraph_slam.pose_graph.files import check_graph_name
    from posegraph_slam.pose_graph.optimum import find_optimum

    settings = optimum_settings(
        {"start": init, "certify": not no_certify,
         "solver": {"method": method, "kind": solver, "max_iterations": max_iterations},
         "outliers": {"method": robust, "parameter": robust_parameter}}
    )  # fmt: skip
    if out is not None:
        check_graph_name(out)
    whole, read_s = read_timed(graph)
    problem, notes = edited(
        whole, component=component, clamp=clamp, drop_edges=drop_edge, drop_kinds=drop_kind, add_edges=add_edge
    )
    for note in () if as_json or quiet else notes:
        print_note(note)
    with ProgressBars(enabled=not quiet and not as_json) as progress:
        optimum = find_optimum(problem, settings, progress=progress)
    asked = covariances(optimum, marginal or [], relative or [])  # before anything is written: it may fail
    seconds = {"read": read_s, **optimum.seconds, "write": write_files(optimum, out, edges)}
    if plot is not None:
        draw(optimum, plot, graph.name)
    report = summary(graph, optimum, seconds, notes)
    if as_json:
        print_json(report | asked)
    elif not quiet:
        print_summary(report, optimum)
        print_covariances(asked)
    if not optimum.result.converged:
        print_warning(f"no optimum was reached: {optimum.stop_reason}")


def read_timed(path: Path) -> tuple[PoseGraph, float]:
    """Read a graph; return it and the seconds that took, kernels loaded before, so that later times are its own too."""
    from posegraph_slam.pose_graph.files import read_graph
    from posegraph_slam.pose_graph.warmup import load_kernels

    load_kernels(path)
    began = time.perf_counter()
    graph = read_graph(path)
    return graph, time.perf_counter() - began


def write_files(optimum: Optimum, out: Path | None, edges: Path | None) -> float:
    """Write the graph and the table of its edges where asked for; return the seconds that took."""
    from posegraph_slam.pose_graph.files import write_graph
    from posegraph_slam.pose_graph.optimum import write_edges

    began = time.perf_counter()
    if out is not None:
        write_graph(optimum.kept_graph, out)
    if edges is not None:
        write_edges(optimum, edges)
    return time.perf_counter() - began


def draw(optimum: Optimum, path: Path, name: str) -> None:
    """Draw the solution."""
    from posegraph_slam.report.graph_figure import draw_graph

    draw_graph(optimum.graph, path, kept=optimum.kept, title=f"{name}: {optimum.error:.9g}")


def summary(graph: Path, optimum: Optimum, seconds: dict[str, float], notes: list[str]) -> dict[str, Any]:
    """Return what --json prints."""
    certificate = optimum.certificate
    kept_loops = int((optimum.kept & optimum.graph.constraints.is_loop).sum())
    report: dict[str, Any] = {
        "file": str(graph),
        "poses": len(optimum.graph),
        "edges": len(optimum.graph.constraints),
        "init": optimum.start.value,
        "error_initial": optimum.error_initial,
        "error": optimum.error,
        "iterations": optimum.iterations,
        "stop_reason": optimum.stop_reason,
        "certified": certificate is not None and certificate.holds,
        "chordal_cost": None if certificate is None else certificate.chordal_cost,
        "lower_bound": None if certificate is None else certificate.lower_bound,
        "seconds": {key: round(value, 6) for key, value in seconds.items()},
        "status": "unknown" if certificate is None else certificate.status.value,
        "reason": "no certificate was asked for, or a robust loss has none"
        if certificate is None
        else certificate.reason,
        "gap": None if certificate is None or certificate.rank == 0 else certificate.gap,
        "notes": [*notes, *optimum.notes],
    }
    if optimum.classified is not None:
        report["robust"] = {
            "winner": optimum.classified.winner, "scores": optimum.classified.scores,
            "gate": optimum.classified.gate, "loops": int(optimum.graph.constraints.is_loop.sum()),
            "kept_loops": kept_loops, "rejected_loops": int((~optimum.kept).sum())}  # fmt: skip
    return report


def print_summary(report: dict[str, Any], optimum: Optimum) -> None:
    """Print the solution as a table of two columns."""
    rows = [["", report["file"]]]
    rows += [["poses, edges", f"{report['poses']}, {report['edges']}"], ["start", report["init"]]]
    rows += [["error", f"{report['error_initial']:.9g} -> {report['error']:.9g}"]]
    rows += [["stopped", f"{report['stop_reason']} after {report['iterations']} iterations"]]
    if report["chordal_cost"] is not None:
        gap = "" if report["gap"] is None else f", gap {report['gap']:.1e}"
        reason = f" ({report['reason']})" if report["reason"] else ""
        rows += [["certificate", f"{report['status']}{gap}{reason}"]]
        rows += [["chordal cost, bound", f"{report['chordal_cost']:.9g}, {report['lower_bound']:.9g}"]]
    if "robust" in report:
        found = report["robust"]
        rows += [["loops kept", f"{found['kept_loops']} of {found['loops']} by {found['winner']}"]]
    rows += [["time [s]", ", ".join(f"{name} {value:.3f}" for name, value in report["seconds"].items())]]
    print_table(rows)
    for note in optimum.notes:
        print_note(note)


def print_covariances(asked: dict[str, Any]) -> None:
    """Print standard deviations of the covariances asked for."""
    for title, key in (("standard deviations", "marginals"), ("standard deviations of J seen from I", "relative")):
        entries = asked.get(key, [])
        if entries:
            rows = [[str(e.get("node", f"{e.get('i')},{e.get('j')}")),
                     *(f"{e['covariance'][k][k] ** 0.5:.6g}" for k in range(len(e["covariance"])))]
                    for e in entries]  # fmt: skip
            names = ["x [m]", "y [m]", "theta"] if len(rows[0]) == 4 else ["rx", "ry", "rz", "x [m]", "y [m]", "z [m]"]
            print_table([["node", *names], *rows], title=title)
