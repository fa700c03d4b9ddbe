"""One person editing the closures of one run: what was changed, what it gives, and where it is kept."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from posegraph_slam.datasets import read
from posegraph_slam.errors import InputError
from posegraph_slam.execution import SerialExecutor
from posegraph_slam.loop_closure.manual import Proposal, propose
from posegraph_slam.mapping.occupancy import build_occupancy
from posegraph_slam.pipeline.editing import check_log, close_with_edits, pair_of, planar, resolve
from posegraph_slam.pipeline.edits import Edit, Edits, added, read_edits, write_edits
from posegraph_slam.pipeline.matching import motion_in_sweep
from posegraph_slam.pipeline.matching_file import MATCHING, read_matching
from posegraph_slam.pipeline.optimize import MatchedLog, finish, match
from posegraph_slam.pipeline.rerun import plan_run
from posegraph_slam.pipeline.run import run
from posegraph_slam.pipeline.run_directory import EDITS, RECORD, read_run_directory
from posegraph_slam.pipeline.stored_graph import GRAPH, StoredGraph, read_stored_graph
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.report.map_layers import map_layers, rounded
from posegraph_slam.report.page import report_page, write_report_of
from posegraph_slam.report.run_content import RunContent, read_run_content
from posegraph_slam.report.run_figures import draw_figures


class EditSession:
    """The state of the editor. Its methods may be called from several threads; one works at a time.

    Edits go into edits.toml of the run directory at once; all else of the run stays as it is. Everything raises
    InputError for what cannot be done, and is then unchanged.
    """

    def __init__(self, folder: Path) -> None:
        """Load a run and its log; raise InputError where it has no graph or the log is gone."""
        self.folder = folder
        self._lock = threading.RLock()
        self._run = read_run_directory(folder)
        for name in (GRAPH, MATCHING):
            self._run.path(name)
        self._plan = plan_run(folder, [], [], start="graph")
        self._stored = planar(read_stored_graph(self._run))
        self._content = read_run_content(folder)
        self._log = read(self._plan.log, format=self._plan.log_format, topics=self._plan.topics)
        self._basis: MatchedLog | None = None
        self._pending: tuple[Edit, Proposal] | None = None
        self._edits = self._read_edits()
        self._solved, self._graph = Edits(), _without_overlaps(self._stored, self._stored.graph)

    def _read_edits(self) -> Edits:
        path = self.folder / EDITS
        if not path.exists():
            return Edits(log_sha256=(self._run.record.get("input") or {}).get("sha256"))
        edits = read_edits(path)
        check_log(edits, self._run)
        resolve(self._stored, edits)
        return edits

    @property
    def edits(self) -> Edits:
        """All edits so far."""
        return self._edits

    @property
    def content(self) -> RunContent:
        """The run as last solved."""
        return self._content

    @property
    def _matched(self) -> MatchedLog:
        """The log up to scan matching, prepared when it is first needed."""
        if self._basis is None:
            count = len(self._log.scans) if self._log.scans is not None else 0
            matched = read_matching(self._run.path(MATCHING), count)
            self._basis = match(self._log, self._plan.configuration, matched=matched, executor=SerialExecutor())
        return self._basis

    def page(self, **editor: Any) -> str:
        """Return the page with the run as last solved; `editor` is handed to its script."""
        with self._lock:
            return report_page(self._content, editor={**editor, "state": self.state()})

    def state(self) -> dict[str, Any]:
        """Return the edits, which keyframe pairs are off or added, and whether they have been solved."""
        with self._lock:
            off, new = resolve(self._stored, self._edits)
            solved_off, solved_new = resolve(self._stored, self._solved)
            row = {int(scan): at for at, scan in enumerate(self._stored.graph.index)}
            return {
                "edits": [_said(edit) for edit in self._edits.edit],
                "off": [[row[a], row[b]] for a, b in sorted(off)],
                "added": [[row[a], row[b]] for a, b in sorted(new)],
                "solved_off": [[row[a], row[b]] for a, b in sorted(solved_off)],
                "solved_added": [[row[a], row[b]] for a, b in sorted(solved_new)],
                "solved": self._edits.edit == self._solved.edit,
            }

    def switch(self, target: int, source: int, *, on: bool) -> dict[str, Any]:
        """Switch the closure of two keyframes on or off."""
        with self._lock:
            a, b = self._scans(target, source)
            return self._with(Edit(action="on" if on else "off", target_scan=a, source_scan=b))

    def propose(self, target: int, source: int) -> dict[str, Any]:
        """Register two keyframes; tell what was found, and keep it for `add` where it can be added."""
        with self._lock:
            a, b = self._scans(target, source)
            off, new = resolve(self._stored, self._edits)
            joined = {pair_of(self._stored, self._stored.records[row]) for row in self._stored.record_of.tolist()}
            if (a, b) in new or (a, b) in joined:
                how = "; it is switched off: switch it on" if (a, b) in off else ""
                raise InputError("closure", f"scans {a} and {b} are joined by one already{how}")
            settings = self._plan.configuration.loop_closure
            found = propose(self._graph, self._matched.beams, target, source, settings)
            self._pending = None if found.reason else (added(found, a, b), found)
            record = found.record
            return {
                "possible": not found.reason,
                "reason": found.reason,
                "surprise": found.surprise,
                "scans": [a, b],
                "matched": rounded(record.matched_fraction, 2),
                "rmse_mm": rounded(1000 * record.rmse_m, 0),
                "moved_m": rounded(record.error_before_m, 2),
                "sigma": rounded(record.sigmas_before, 1),
            }

    def add(self) -> dict[str, Any]:
        """Add the closure that was proposed last."""
        with self._lock:
            if self._pending is None:
                raise InputError("closure", "there is no proposal to add", "propose one first")
            edit, self._pending = self._pending[0], None
            return self._with(edit)

    def undo(self) -> dict[str, Any]:
        """Take the last edit back."""
        with self._lock:
            if not self._edits.edit:
                raise InputError("edits", "there is nothing to undo")
            return self._keep(self._edits.model_copy(update={"edit": self._edits.edit[:-1]}))

    def _with(self, edit: Edit) -> dict[str, Any]:
        changed = self._edits.model_copy(update={"edit": (*self._edits.edit, edit)})
        resolve(self._stored, changed)
        return self._keep(changed)

    def _keep(self, edits: Edits) -> dict[str, Any]:
        write_edits(edits, self.folder / EDITS)
        self._edits = edits
        return self.state()

    def solve(self) -> dict[str, Any]:
        """Solve the graph with the edits, refine it, and rebuild the map from the keyframes; return the new layers."""
        with self._lock:
            configuration, basis = self._plan.configuration, self._matched
            closed = close_with_edits(self._stored, self._edits, configuration.pose_graph)
            graph, optimised = finish(closed.graph, basis, executor=SerialExecutor())
            accepted = [row for row, record in enumerate(closed.records) if record.accepted]
            solved = StoredGraph(graph=graph, records=closed.records, record_of=np.array(accepted, dtype=np.int64))
            last = list(self._content.trajectories)[-1]
            occupancy = None
            if configuration.maps:
                at = basis.matched.keyframes
                motion = motion_in_sweep(basis.view.scans, basis.matched.trajectory.poses, basis.matched.sweep,
                                         configuration.timing)  # fmt: skip
                occupancy = build_occupancy(
                    basis.view.scans.select(at), optimised.select(at), configuration.mapping, motion=motion[at]
                )
            self._content = replace(
                self._content,
                trajectories={**self._content.trajectories, last: optimised},
                stored=solved,
                occupancy=occupancy,
                texture=None,
            )
            self._solved, self._graph = self._edits, _without_overlaps(solved, graph)
            return {"layers": map_layers(self._content), "stop": str(closed.solution.stop_reason), **self.state()}

    def save(self) -> dict[str, Any]:
        """Write the run with its edits as a run directory of its own, as `psg optimize --edits` does."""
        with self._lock:
            out = self.folder.resolve().with_name(f"{self.folder.resolve().name}-edited")
            ours = (out / RECORD).is_file() and self._made_from_here(out)
            if out.exists() and not ours:
                raise InputError(out, "holds something else", "move it away, then save again")
            run(
                self._plan.log,
                self._plan.configuration,
                out=out,
                overwrite=ours,
                log_format=self._plan.log_format,
                topics=self._plan.topics,
                matching_of=self.folder,
                edits=self._edits,
                draw=draw_figures,
                report=write_report_of,
            )
            return {"saved": str(out), **self.state()}

    def _made_from_here(self, out: Path) -> bool:
        edits = read_run_directory(out).record.get("edits")
        return isinstance(edits, dict) and edits.get("run") == str(self.folder.resolve())

    def _scans(self, target: int, source: int) -> tuple[int, int]:
        target, source = sorted((target, source))
        if target < 0 or source >= len(self._stored.graph) or target == source:
            raise InputError("closure", f"keyframes {target} and {source} are not two of this run")
        return int(self._stored.graph.index[target]), int(self._stored.graph.index[source])


def _without_overlaps(stored: StoredGraph, graph: PoseGraph) -> PoseGraph:
    """Return chain and closures alone: what the overlaps say rests on them."""
    return graph.with_constraints(graph.constraints.select(np.arange(len(graph) - 1 + len(stored.record_of))))


def _said(edit: Edit) -> str:
    """Say an edit in words."""
    scans = f"scans {edit.target_scan} and {edit.source_scan}"
    return {"off": f"off: closure of {scans}", "on": f"on: closure of {scans}", "add": f"added: closure of {scans}"}[
        edit.action
    ]
