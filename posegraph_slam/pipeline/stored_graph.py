"""The pose graph and the loop candidates of a finished run, read back with the kind of every constraint."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.arrays import IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.loop_closure.ledger import LoopRecord
from posegraph_slam.pipeline.run_directory import LOOPS, StoredRun
from posegraph_slam.pose_graph.g2o import read_g2o
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph

GRAPH = "graph.g2o"
REMEDY = "run `psg optimize` again to write it"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredGraph:
    """A run's graph: first the chain of scan matching, then the accepted closures, then the matches of overlaps.

    In space, what holds attitudes and heights follows.
    `records` are all candidates in the order in which they were tried; `record_of` (C,) says which one each of the C
    closures is. `graph.index` holds the scans that are nodes.
    """

    graph: PoseGraph
    records: tuple[LoopRecord, ...]
    record_of: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "record_of", read_only(self.record_of, np.int64))

    @property
    def chain(self) -> Constraints:
        """The constraints of successive keyframes."""
        return self.graph.constraints.select(np.arange(len(self.graph) - 1))

    @property
    def closures(self) -> Constraints:
        """The accepted closures (C)."""
        first = len(self.graph) - 1
        return self.graph.constraints.select(np.arange(first, first + len(self.record_of)))


def read_stored_graph(run: StoredRun) -> StoredGraph:
    """Read graph.g2o and loops.csv of a run and give each constraint its kind, which g2o cannot hold.

    Raises InputError where one is missing or they do not belong together.
    """
    path = run.path(GRAPH)
    graph, records = read_g2o(path), read_loops(run.path(LOOPS))
    record_of = np.array([row for row, record in enumerate(records) if record.accepted], dtype=np.int64)
    c, first = graph.constraints, len(graph) - 1
    ends = np.array([(records[row].target, records[row].source) for row in record_of], dtype=np.int64).reshape(-1, 2)
    found = np.stack([c.i, c.j], axis=1)[first : first + len(ends)]
    chained = np.array_equal(c.i[:first], np.arange(first)) and np.array_equal(c.j[:first], np.arange(1, first + 1))
    if not chained or not np.array_equal(found, ends):
        raise InputError(path, f"does not belong to {LOOPS}: its edges are others", REMEDY)
    kind = np.full(len(c), int(ConstraintKind.OVERLAP))
    kind[:first] = int(ConstraintKind.SCAN_MATCHING)
    at = attitudes(c, len(graph))
    kind[at], kind[at.stop :] = int(ConstraintKind.ATTITUDE), int(ConstraintKind.SAME_GROUND)
    kind[first : first + len(ends)] = [int(ConstraintKind[records[row].kind.upper()]) for row in record_of]
    typed = Constraints(i=c.i, j=c.j, T_i_j=c.T_i_j, information=c.information, kind=kind)
    return StoredGraph(graph=graph.with_constraints(typed), records=records, record_of=record_of)


def attitudes(c: Constraints, nodes: int) -> slice:
    """Return where a graph in space ties every node to the first by its attitude; equal grounds follow it."""
    others = np.arange(1, nodes)
    starts = np.flatnonzero((c.i == 0) & (c.j == 1))[1:].tolist()  # the first is of the chain
    for start in starts if c.T_i_j.shape[-1] == 4 else []:
        rows = slice(start, start + nodes - 1)
        if np.array_equal(c.j[rows], others) and not c.i[rows].any():
            return rows
    return slice(len(c), len(c))


def read_loops(path: Path) -> tuple[LoopRecord, ...]:
    """Read the candidates back from loops.csv; an empty number is NaN. Raises InputError naming the line."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"cannot be read ({error})", REMEDY) from error
    records = []
    for line, row in enumerate(rows, start=2):
        try:
            records.append(LoopRecord(**{name: parse(row[name]) for name, parse in PARSERS.items()}))
            ConstraintKind[records[-1].kind.upper()]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}:{line}", f"is not a loop candidate ({error!r})", REMEDY) from error
    return tuple(records)


def _number(text: str) -> float:
    return float(text) if text else float("nan")


def _flag(text: str) -> bool:
    return {"true": True, "false": False}[text]


_OF_TYPE: Mapping[str, Callable[[str], Any]] = {"int": int, "float": _number, "str": str, "bool": _flag}
PARSERS = {field.name: _OF_TYPE[str(field.type)] for field in fields(LoopRecord)}
