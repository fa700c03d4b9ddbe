"""The graph of a run with a person's edits applied and solved, as the editor shows it and as a replay computes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from posegraph_slam.errors import InputError
from posegraph_slam.loop_closure.closing import LoopClosureResult
from posegraph_slam.loop_closure.ledger import LoopRecord
from posegraph_slam.loop_closure.verification import gaussian_sigmas
from posegraph_slam.pipeline.edits import EVIDENCE, Edit, Edits, information_matrix, pose_matrix
from posegraph_slam.pipeline.run_directory import StoredRun
from posegraph_slam.pipeline.stored_graph import StoredGraph
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints
from posegraph_slam.pose_graph.residuals import chi2
from posegraph_slam.pose_graph.solve import solve
from posegraph_slam.pose_graph.solver_settings import SolverSettings

SWITCHED_OFF = "switched off by hand"


def check_log(edits: Edits, run: StoredRun) -> None:
    """Raise InputError where the edits were made for another log."""
    of_run = (run.record.get("input") or {}).get("sha256")
    if edits.log_sha256 and of_run and edits.log_sha256 != of_run:
        raise InputError("edits", f"they were made for another log than {run.folder}", "give the edits of this log")


def planar(stored: StoredGraph) -> StoredGraph:
    """Return the graph of a run in the plane; raise InputError for one in space, whose planar graph is not kept."""
    if stored.graph.group.dimension != 2:
        raise InputError(
            "graph.g2o", "has poses in space, and closures are edited in the plane", "use pose_graph.group=se2"
        )
    return stored


def close_with_edits(stored: StoredGraph, edits: Edits, solver: SolverSettings) -> LoopClosureResult:
    """Apply the edits to the closures of a run and solve the graph of chain and closures from the run's own poses.

    No closure is taken out here: what stays on is what the person wants. The records tell of each closure how far it
    is from the solution. Raises InputError for an edit of a pair that has no closure.
    """
    off, new = resolve(stored, edits)
    records = list(stored.records)
    kept = []
    for place, row in enumerate(stored.record_of.tolist()):
        if pair_of(stored, records[row]) in off:
            records[row] = replace(records[row], accepted=False, reason=SWITCHED_OFF)
        else:
            kept.append(place)
    round_ = 1 + max((record.round for record in records), default=0)
    records += [_record_of(stored, edit, round_) for edit in new.values()]
    closures = [stored.closures.select(np.array(kept, dtype=np.int64)), *(_constraint(stored, e) for e in new.values())]
    graph = stored.graph.with_constraints(Constraints.concatenate([stored.chain, *closures]))
    solution = solve(graph, solver)
    graph = graph.with_poses(solution.poses)
    sigmas = gaussian_sigmas(chi2(graph)[len(stored.chain) :], graph.group.dof).tolist()
    accepted = [row for row, record in enumerate(records) if record.accepted]
    for row, sigma in zip(accepted, sigmas, strict=True):
        records[row] = replace(records[row], sigmas_after=sigma)
    return LoopClosureResult(graph=graph, records=tuple(records), rounds=round_, solution=solution)


def resolve(stored: StoredGraph, edits: Edits) -> tuple[set[tuple[int, int]], Mapping[tuple[int, int], Edit]]:
    """Return the pairs of scans whose closures are off in the end, and the added closures by pair.

    Raises InputError naming the first edit that cannot be applied.
    """
    present = {pair_of(stored, stored.records[row]) for row in stored.record_of.tolist()}
    scans = set(stored.graph.index.tolist())
    off: set[tuple[int, int]] = set()
    new: dict[tuple[int, int], Edit] = {}
    for number, edit in enumerate(edits.edit, start=1):
        where, pair = f"edit {number}", edit.pair
        if not scans.issuperset(pair) or pair[0] >= pair[1]:
            raise InputError(where, f"scans {pair[0]} and {pair[1]} are not an older and a newer keyframe of this run")
        if edit.action == "add":
            new[pair] = edit
        elif edit.action == "off" and pair in new:
            del new[pair]
        elif pair not in present:
            raise InputError(where, f"no closure joins scans {pair[0]} and {pair[1]}", "take the edit out of the file")
        elif edit.action == "off":
            off.add(pair)
        else:
            off.discard(pair)
    return off, new


def pair_of(stored: StoredGraph, record: LoopRecord) -> tuple[int, int]:
    """Return the scans of a candidate's keyframes."""
    return int(stored.graph.index[record.target]), int(stored.graph.index[record.source])


def _rows(stored: StoredGraph, edit: Edit) -> tuple[int, int]:
    target, source = np.searchsorted(stored.graph.index, edit.pair).tolist()
    return target, source


def _constraint(stored: StoredGraph, edit: Edit) -> Constraints:
    assert edit.closure is not None
    i, j = _rows(stored, edit)
    return Constraints(
        i=np.array([i]),
        j=np.array([j]),
        T_i_j=pose_matrix(edit.closure)[None],
        information=information_matrix(edit.closure)[None],
        kind=np.array([int(ConstraintKind.MANUAL)]),
    )


def _record_of(stored: StoredGraph, edit: Edit, round_: int) -> LoopRecord:
    i, j = _rows(stored, edit)
    values = {name: getattr(edit.closure, name) for name in EVIDENCE}
    return LoopRecord(
        round=round_,
        target=i,
        source=j,
        kind=ConstraintKind.MANUAL.name.lower(),
        sigmas_after=float("nan"),
        accepted=True,
        reason="",
        **values,
    )
