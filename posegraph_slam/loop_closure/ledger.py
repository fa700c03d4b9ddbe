"""Every candidate that was tried, with its evidence and what became of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.loop_closure.matching import Evidence
from posegraph_slam.loop_closure.proposals import Candidates
from posegraph_slam.pose_graph.graph import ConstraintKind


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopRecord:
    """One candidate: keyframes, kind, what was measured, and the decision; `reason` is empty where it was accepted.

    `error_before_m`, `error_before_rad` and `sigmas_before` say how far it lay from the estimate when it was found,
    `sigmas_after` how far from the solved graph (NaN where it did not come so far).
    """

    round: int
    target: int
    source: int
    kind: str
    travel_m: float
    reach_m: float
    score: float
    matched_fraction: float
    agreement: float
    overlap: float
    rmse_m: float
    error_before_m: float
    error_before_rad: float
    sigmas_before: float
    sigmas_after: float
    accepted: bool
    reason: str


def rejected_pairs(records: Sequence[LoopRecord]) -> IntArray:
    """Return target and source keyframe (R, 2) of the candidates that were rejected."""
    pairs = [(record.target, record.source) for record in records if not record.accepted]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


@dataclass(slots=True)
class Ledger:
    """Grows while candidates are tried; remembers which pairs need not be tried again."""

    records: list[LoopRecord] = field(default_factory=list)
    rows_in_graph: list[int] = field(default_factory=list)
    _travel_tried: dict[tuple[int, int], float] = field(default_factory=dict)

    def untried(self, candidates: Candidates) -> IntArray:
        """Candidates that are new, or whose uncovered travel has halved since, so that the guess is better now."""
        keys = zip(candidates.target.tolist(), candidates.source.tolist(), strict=True)
        last = [self._travel_tried.get(key, np.inf) for key in keys]
        return np.flatnonzero(candidates.travel_m < 0.5 * np.array(last, dtype=np.float64))

    def add(
        self,
        round_: int,
        candidates: Candidates,
        evidence: Evidence,
        *,
        error_before: FloatArray,
        sigmas_before: FloatArray,
        reasons: list[str],
    ) -> None:
        """Enter one row a candidate; those without a reason are taken to be in the graph, in this order."""
        for m in range(len(candidates)):
            self.enter(
                LoopRecord(
                    round=round_,
                    target=int(candidates.target[m]),
                    source=int(candidates.source[m]),
                    kind=ConstraintKind(int(candidates.kind[m])).name.lower(),
                    travel_m=float(candidates.travel_m[m]),
                    reach_m=float(candidates.reach_m[m]),
                    score=float(evidence.score[m]),
                    matched_fraction=float(evidence.matched_fraction[m]),
                    agreement=float(evidence.agreement[m]),
                    overlap=float(evidence.overlap[m]),
                    rmse_m=float(evidence.rmse_m[m]),
                    error_before_m=float(np.hypot(error_before[m, 0], error_before[m, 1])),
                    error_before_rad=float(abs(error_before[m, 2])),
                    sigmas_before=float(sigmas_before[m]),
                    sigmas_after=float("nan"),
                    accepted=not reasons[m],
                    reason=reasons[m],
                )
            )

    def enter(self, record: LoopRecord) -> None:
        """Enter one row; one that is accepted is taken to be in the graph, after those entered before."""
        self._travel_tried[record.target, record.source] = record.travel_m
        if record.accepted:
            self.rows_in_graph.append(len(self.records))
        self.records.append(record)

    def settle(self, sigmas: FloatArray, kept: BoolArray) -> None:
        """Write how far the closures in the graph are from its solution, and drop those not kept."""
        for k, row in enumerate(self.rows_in_graph):
            old = self.records[row]
            reason = "" if kept[k] else f"disagrees with the solved graph by {sigmas[k]:.1f} sigma"
            self.records[row] = dataclasses.replace(
                old, sigmas_after=float(sigmas[k]), accepted=bool(kept[k]), reason=reason
            )
        self.rows_in_graph = [row for k, row in enumerate(self.rows_in_graph) if kept[k]]
