"""What the options of `psg solve` ask for, in terms of the library: settings, changes of the graph, covariances."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import ValidationError

from posegraph_slam.arrays import in_range, range_fault
from posegraph_slam.errors import ConfigurationError, InputError, did_you_mean
from posegraph_slam.pose_graph.editing import (
    Component,
    add_edge,
    clamp_indefinite,
    drop_edges,
    duplicate_edges,
    edges_between,
    keep_component,
    row_of,
)
from posegraph_slam.pose_graph.graph import ConstraintKind, PoseGraph
from posegraph_slam.pose_graph.marginals import factored_marginals
from posegraph_slam.pose_graph.noise import information_from_sigmas
from posegraph_slam.pose_graph.optimum import Optimum, OptimumSettings

KINDS = {"odometry": ConstraintKind.ODOMETRY, "external": ConstraintKind.EXTERNAL, "loops": ConstraintKind.EXTERNAL}
"""Kinds that a graph file can hold: edges between ids that follow each other, and all others."""


OPTIONS = {
    "start": "--init",
    "solver.method": "--method",
    "solver.kind": "--solver",
    "solver.max_iterations": "--max-iterations",
    "outliers.method": "--robust",
    "outliers.parameter": "--robust-parameter",
}
"""The option behind each setting."""


def optimum_settings(values: dict[str, Any]) -> OptimumSettings:
    """Check the values of the options; the first fault is named."""
    try:
        return OptimumSettings.model_validate(values)
    except ValidationError as error:
        fault = error.errors()[0]
        option = OPTIONS.get(".".join(map(str, fault["loc"])), "psg solve")
        words = re.findall(r"'(\w+)'", str(fault.get("ctx", {}).get("expected", "")))
        remedy = f"{did_you_mean(str(fault['input']), words)}it is {', '.join(words)}" if words else fault["msg"]
        raise ConfigurationError(option, f"{fault['input']!r} is not allowed", remedy) from None


def edited(
    graph: PoseGraph,
    *,
    component: str | None,
    clamp: bool,
    drop_edges: Sequence[str] | None,
    drop_kinds: Sequence[str] | None,
    add_edges: Sequence[str] | None,
) -> tuple[PoseGraph, list[str]]:
    """Change a graph as the options say: add, drop, clamp, choose parts; return it with remarks."""
    notes = []
    for request in add_edges or []:
        graph = _with_edge(graph, request)
    graph = _without_edges(graph, drop_edges or [], drop_kinds or [])
    if len(repeated := duplicate_edges(graph)):
        notes.append(f"{len(repeated)} duplicate edges count twice, first edge {repeated[0]}")
    if clamp:
        change = clamp_indefinite(graph)
        graph = change.graph
        notes += [change.note] if change.note else []
    if component is not None:
        if component not in list(Component):
            guess = did_you_mean(component, list(Component))
            raise ConfigurationError("--component", f"{component!r} is unknown", f"{guess}give largest or all")
        change = keep_component(graph, Component(component))
        graph = change.graph
        notes += [change.note] if change.note else []
    return graph, notes


def _without_edges(graph: PoseGraph, edges: Sequence[str], kinds: Sequence[str]) -> PoseGraph:
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown:
        remedy = f"{did_you_mean(unknown[0], KINDS)}give {' or '.join(KINDS)}"
        raise ConfigurationError("--drop-kind", f"{unknown[0]!r} is unknown", remedy)
    numbers: list[int] = []
    for word in edges:
        values = _numbers("--drop-edge", word, int)
        if len(values) == 1:
            numbers.append(int(values[0]))
        elif len(values) == 2:
            numbers += edges_between(graph, int(values[0]), int(values[1])).tolist()
        else:
            raise ConfigurationError("--drop-edge", f"{word!r} has {len(values)} numbers", "give N or I,J")
    return drop_edges(graph, edges=numbers, kinds=tuple(KINDS[kind] for kind in kinds))


def _with_edge(graph: PoseGraph, request: str) -> PoseGraph:
    """Add an edge I,J,x,y,theta,sigmas or I,J,x,y,z,qx,qy,qz,qw,sigmas (translation first, as in g2o files)."""
    from posegraph_slam.pose_graph.g2o import pose_of_numbers
    from posegraph_slam.pose_graph.graph_file import TRANSLATION_FIRST

    size, p = (3, 3) if graph.group.dimension == 2 else (7, 6)
    values = _numbers("--add-edge", request, float)
    if len(values) != 2 + size + p:
        raise ConfigurationError(
            "--add-edge", f"{request!r} has {len(values)} numbers", f"give 2 ids, {size} of the pose, {p} deviations"
        )
    sigmas = np.array(values[2 + size :])
    if p == 6:
        ordered = np.empty(6)
        ordered[TRANSLATION_FIRST] = sigmas
        sigmas = ordered
    if not in_range(values).all():
        raise ConfigurationError("--add-edge", f"{request!r} holds a number that is {range_fault(values)}")
    if not all(node.is_integer() for node in values[:2]):
        raise ConfigurationError("--add-edge", f"{request!r} does not begin with the ids of two nodes")
    T = pose_of_numbers("--add-edge", np.array(values[2 : 2 + size]))
    return add_edge(graph, int(values[0]), int(values[1]), T, information=information_from_sigmas(sigmas))


def _numbers(option: str, text: str, kind: type[int] | type[float]) -> list[float]:
    try:
        return [kind(word) for word in text.split(",")]
    except ValueError:
        raise ConfigurationError(option, f"{text!r} is no list of numbers", "separate them by commas") from None


def covariances(optimum: Optimum, nodes: Sequence[int], pairs: Sequence[str]) -> dict[str, Any]:
    """Return the covariances of nodes and of pairs I,J at the solution, by their ids in the file."""
    if not nodes and not pairs:
        return {}
    graph = optimum.graph
    first, second = [], []
    for pair in pairs:
        values = _numbers("--relative", pair, int)
        if len(values) != 2:
            raise InputError("--relative", f"{pair!r} is no pair", "give I,J")
        first.append(int(values[0]))
        second.append(int(values[1]))
    rows = [row_of(graph, node) for node in nodes]
    i, j = [row_of(graph, node) for node in first], [row_of(graph, node) for node in second]
    used = graph.with_constraints(graph.constraints.select(optimum.weights > 0))
    factored = factored_marginals(used, weights=optimum.weights[optimum.weights > 0])
    report: dict[str, Any] = {}
    if nodes:
        own = factored.covariances()[rows]
        report["marginals"] = [{"node": n, "covariance": m.tolist()} for n, m in zip(nodes, own, strict=True)]
    if pairs:
        between = factored.relative(np.array(i), np.array(j))
        report["relative"] = [
            {"i": a, "j": b, "covariance": m.tolist()} for a, b, m in zip(first, second, between, strict=True)
        ]
    return report
