"""Finding the loops that are wrong: robust losses, graduated non-convexity, and the choice between their answers.

Odometry and the matching of neighbours are taken as right. A candidate solution is scored by its odometry chi-square
plus sum min(chi-square, gate) over loops: what a loop costs at most is known before, so that answers of different
losses compare. The best is classified by the gate, solved again without the false loops, and classified again until
nothing changes. Graduated non-convexity with truncated least squares: Yang et al. 2020, equation 14.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pydantic import Field
from scipy.special import chdtri

from posegraph_slam.arrays import BoolArray, FloatArray, read_only
from posegraph_slam.execution import Progress, silent_progress
from posegraph_slam.pose_graph.editing import with_information
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.linearization import chi2_at, residuals_at
from posegraph_slam.pose_graph.marginals import factored_marginals
from posegraph_slam.pose_graph.robust import RobustLoss, RobustSettings, constraint_costs, constraint_weights
from posegraph_slam.pose_graph.solver_settings import SolverSettings
from posegraph_slam.pose_graph.sparse_solver import run_sparse
from posegraph_slam.settings import Settings

SPREAD_STEP = 1.4
"""Growth of the control parameter a step, the value of the paper."""
LEAST_WEIGHT = 1e-6
"""Loops of less weight are left out of a step, which keeps the factor sparse."""
FAINT = 1e-4
"""Under a loss, loops of less weight are left out: random false loops would fill the factor."""
REWEIGHTINGS = 25
WIDTHS = (1024.0, 256.0, 64.0, 16.0, 4.0, 1.0)
"""Gates tried from wide to narrow, over the final one: on manhattan they lead from 15 m to 0.09 m off the optimum."""
WIDENINGS = 4
ROUNDS = 10
"""Classifications with one gate, at most."""
SHORT = 5
"""Solver steps between classifications with a wide gate."""
PURGES = 10
FEW = 0.4
"""Share of loops kept below which a candidate may have missed the right basin."""
AGREEMENT = 1e-3
"""Two candidates whose scores differ by less, relative, are taken to have found the same."""
GATE_MARGIN = 10.0
"""How much wider the gate is than the one that fits the median of chi-square: tails are heavy."""
LEAST_GATE = 1e-3


class OutlierMethod(StrEnum):
    """How false loops are dealt with."""

    NONE = "none"
    HUBER = "huber"
    CAUCHY = "cauchy"
    GEMAN_MCCLURE = "geman_mcclure"
    DCS = "dcs"
    GNC = "gnc"
    """Graduated non-convexity with truncated least squares, then a clean solution of the loops kept."""
    AUTO = "auto"
    """DCS, Cauchy then DCS, and GNC; the best is classified and solved clean."""


class OutlierSettings(Settings):
    """How false loops are found."""

    method: OutlierMethod = Field(
        default=OutlierMethod.NONE, description="none, huber, cauchy, geman_mcclure, dcs, gnc or auto"
    )
    parameter: float | None = Field(default=None, gt=0, description="scale of the loss; unset: standard")
    gate_probability: float = Field(
        default=0.99, gt=0.5, lt=1, description="share of true loops whose chi-square is below the gate"
    )
    inner_iterations: int = Field(default=2, ge=1, description="solver steps for each value of the control parameter")

    @property
    def loss(self) -> RobustSettings | None:
        """The loss, if the method is one."""
        if self.method in (OutlierMethod.NONE, OutlierMethod.GNC, OutlierMethod.AUTO):
            return None
        return RobustSettings(loss=RobustLoss(self.method.value), parameter=self.parameter)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Classified:
    """Which constraints (E,) are kept by which gate, the poses (N, d+1, d+1) found, which candidate won, all scores."""

    kept: BoolArray
    poses: FloatArray
    gate: float
    winner: str
    scores: dict[str, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "kept", read_only(self.kept, np.bool_))
        object.__setattr__(self, "poses", read_only(self.poses))


def gate_of(graph: PoseGraph, probability: float) -> float:
    """Return the chi-square below which a true loop lies with this probability."""
    return float(chdtri(graph.group.dof, 1.0 - probability))


def truncated_score(graph: PoseGraph, gate: float) -> float:
    """Return odometry chi-square plus sum min(chi-square, gate) over loops, at the graph's poses."""
    squared = chi2_at(graph.poses, graph.constraints)
    return float(np.sum(np.where(graph.constraints.is_loop, np.minimum(squared, gate), squared)))


def classify_loops(
    graph: PoseGraph, settings: OutlierSettings, solver: SolverSettings | None = None, *,
    progress: Progress = silent_progress,
) -> Classified:  # fmt: skip
    """Find the true loops of a graph whose odometry is right, by the candidates of the method (`GNC` or `AUTO`).

    The poses of the graph are the start: the odometry chain, unless something better is known. `AUTO` tries DCS and
    Cauchy before DCS, and graduated non-convexity, which costs far more, only where those two disagree and the better
    one keeps few loops.
    """
    solver = SolverSettings() if solver is None else solver
    gate = gate_of(graph, settings.gate_probability)
    search = {
        "dcs": lambda: _reweighted(graph, graph.poses, solver, RobustLoss.DCS),
        "cauchy, dcs": lambda: _reweighted(
            graph, _reweighted(graph, graph.poses, solver, RobustLoss.CAUCHY), solver, RobustLoss.DCS
        ),
        "gnc": lambda: graduated(graph, settings, solver),
    }
    names = list(search) if settings.method is OutlierMethod.AUTO else ["gnc"]
    found: dict[str, tuple[float, FloatArray]] = {}
    for number, name in enumerate(names):
        progress("outliers", number, len(names))
        if name == "gnc" and len(found) > 1 and _trusted(graph, list(found.values()), gate):
            break
        found[name] = _widened(graph, search[name](), gate, solver)
    progress("outliers", len(names), len(names))
    gate = min(_fitting_gate(graph.with_poses(poses), gate) for _, poses in found.values())
    settled = {name: _settled(graph, poses, gate, gate, solver) for name, (_, poses) in found.items()}
    winner = min(settled, key=lambda name: settled[name][0])
    poses = _purged(graph, settled[winner][1], gate, solver)
    kept = ~graph.constraints.is_loop | (chi2_at(poses, graph.constraints) <= gate)
    return Classified(
        kept=kept, poses=poses, gate=gate, winner=winner, scores={name: settled[name][0] for name in settled}
    )


def _trusted(graph: PoseGraph, found: list[tuple[float, FloatArray]], gate: float) -> bool:
    """Tell whether candidates (score, poses) agree, or the best keeps so many loops that it is in the right basin."""
    scores = [score for score, _ in found]
    if max(scores) <= min(scores) * (1 + AGREEMENT):
        return True
    best = min(found, key=lambda pair: pair[0])[1]
    return bool(np.mean(chi2_at(best, graph.constraints)[graph.constraints.is_loop] <= gate) >= FEW)


def _fitting_gate(graph: PoseGraph, gate: float) -> float:
    """Narrow the gate where kept loops fit better than their information says, by the median of their chi-square."""
    squared = chi2_at(graph.poses, graph.constraints)[graph.constraints.is_loop]
    inside = squared[squared <= gate]
    if len(inside) == 0:
        return gate
    scale = float(np.median(inside)) / float(chdtri(graph.group.dof, 0.5))
    return gate * float(np.clip(GATE_MARGIN * scale, LEAST_GATE, 1.0))


def _purged(graph: PoseGraph, poses: FloatArray, gate: float, solver: SolverSettings) -> FloatArray:
    """Drop loops that bend the rest: those whose absence saves more than the gate, the worst first."""
    is_loop = graph.constraints.is_loop
    dropped = np.zeros(len(is_loop), dtype=np.bool_)
    best = truncated_score(graph.with_poses(poses), gate)
    for _ in range(PURGES):
        kept = ~dropped & (~is_loop | (chi2_at(poses, graph.constraints) <= gate))
        inside = np.flatnonzero(kept & is_loop)
        saved = _savings(graph.with_poses(poses).with_constraints(graph.constraints.select(kept)))
        worst = saved > max(gate, 0.5 * float(np.max(saved, initial=0.0)))
        if not worst.any():
            return poses
        dropped[inside[worst]] = True
        trial = _solved(graph, poses, (kept & ~dropped).astype(np.float64), solver, solver.max_iterations)
        score = truncated_score(graph.with_poses(trial), gate)
        if score < best:
            best, poses = score, trial
            dropped[:] = False
    return poses


def _savings(graph: PoseGraph) -> FloatArray:
    """Return by how much chi-square falls if each loop (in order) is left out, to first order: r^T (C - S)^-1 r.

    C is the covariance of the loop, S that of the same relative pose in the solved graph, which includes it.
    """
    edges = np.flatnonzero(graph.constraints.is_loop)
    loops = graph.constraints.select(edges)
    residuals = residuals_at(graph.poses, loops)
    relative = factored_marginals(graph).of_constraints()[edges]
    spread = np.linalg.inv(loops.information) - relative
    values, vectors = np.linalg.eigh(0.5 * (spread + np.swapaxes(spread, 1, 2)))
    along = np.einsum("eij,ei->ej", vectors, residuals)
    return np.asarray(np.sum(along**2 / np.maximum(values, 1e-6 * values[:, -1:]), axis=1))


def _widened(graph: PoseGraph, poses: FloatArray, gate: float, solver: SolverSettings) -> tuple[float, FloatArray]:
    """Improve poses by admitting loops through a wide gate that narrows, as long as the score falls."""
    best = _settled(graph, poses, gate, gate, solver)
    for _ in range(WIDENINGS):
        entry, poses = best, best[1]
        for width in WIDTHS:
            score, poses, last = _passes(graph, poses, gate, width * gate, solver)
            best = min(best, (score, last), key=lambda pair: pair[0])
        if best[0] >= entry[0] * (1 - 1e-6):
            break
    return best


def _settled(
    graph: PoseGraph, poses: FloatArray, gate: float, admit: float, solver: SolverSettings
) -> tuple[float, FloatArray]:
    score, _, best = _passes(graph, poses, gate, admit, solver)
    return score, best


def _passes(
    graph: PoseGraph, poses: FloatArray, gate: float, admit: float, solver: SolverSettings
) -> tuple[float, FloatArray, FloatArray]:
    """Solve with the loops below `admit` until they stay the same: least score met, last poses, poses of that score."""
    is_loop, kept = graph.constraints.is_loop, None
    best = truncated_score(graph.with_poses(poses), gate), poses
    steps = solver.max_iterations if admit <= gate else SHORT
    for _ in range(ROUNDS):
        now = ~is_loop | (chi2_at(poses, graph.constraints) <= admit)
        if kept is not None and np.array_equal(now, kept):
            break
        kept = now
        poses = _solved(graph, poses, kept.astype(np.float64), solver, steps)
        best = min(best, (truncated_score(graph.with_poses(poses), gate), poses), key=lambda pair: pair[0])
    return best[0], poses, best[1]


def _reweighted(graph: PoseGraph, poses: FloatArray, solver: SolverSettings, loss: RobustLoss) -> FloatArray:
    """Minimise under a loss by reweighting; loops of next to no weight are left out, which keeps the factor sparse."""
    settings, is_loop = RobustSettings(loss=loss), graph.constraints.is_loop
    before = np.inf
    for _ in range(REWEIGHTINGS):
        squared = chi2_at(poses, graph.constraints)
        cost = float(np.sum(constraint_costs(is_loop, squared, settings)))
        if before - cost <= 1e-4 * cost:
            break
        before, weights = cost, constraint_weights(is_loop, squared, settings)
        poses = _solved(graph, poses, np.where(weights > FAINT, weights, 0.0), solver, 2)
    return poses


def _solved(graph: PoseGraph, poses: FloatArray, weights: FloatArray, solver: SolverSettings, steps: int) -> FloatArray:
    used = weights > LEAST_WEIGHT
    c = graph.constraints.select(used)
    part = graph.with_constraints(with_information(c, c.information * weights[used][:, None, None]))
    settings = solver.model_copy(
        update={"max_iterations": steps, "relative_tolerance": 1e-6, "robust": RobustSettings()}
    )
    return run_sparse(part.with_poses(poses), settings, silent_progress).poses


def graduated(graph: PoseGraph, settings: OutlierSettings, solver: SolverSettings) -> FloatArray:
    """Solve with truncated least squares on loops by graduated non-convexity; return poses (N, d+1, d+1)."""
    is_loop, gate = graph.constraints.is_loop, gate_of(graph, settings.gate_probability)
    poses = _solved(graph, graph.poses, np.ones(len(is_loop)), solver, SHORT)
    squared = chi2_at(poses, graph.constraints)
    largest = float(np.max(squared[is_loop], initial=0.0))
    if largest <= gate:
        return poses
    control = 1.0 / max(2.0 * largest / gate - 1.0, 1e-9)
    for _ in range(200):
        weights = np.where(is_loop, truncated_weights(squared, gate, control), 1.0)
        poses = _solved(graph, poses, weights, solver, settings.inner_iterations)
        squared = chi2_at(poses, graph.constraints)
        inside = weights[is_loop]
        if np.all((inside < LEAST_WEIGHT) | (inside > 1 - LEAST_WEIGHT)) or control > 1e6:
            break
        control *= SPREAD_STEP
    return poses


def truncated_weights(chi2: FloatArray, gate: float, control: float) -> FloatArray:
    """Return the weight in [0, 1] of each squared error at a value of the control parameter mu.

    1 up to mu/(mu+1) gate, 0 from (mu+1)/mu gate on, between them sqrt(gate mu (mu+1) / chi2) - mu.
    """
    between = np.sqrt(gate * control * (control + 1.0) / np.maximum(chi2, 1e-300)) - control
    return np.clip(between, 0.0, 1.0)


def loop_weights(graph: PoseGraph, settings: OutlierSettings, kept: BoolArray | None) -> FloatArray:
    """Return the weight (E,) of every constraint at the graph's poses: of the loss, or 1 where kept and 0 elsewhere."""
    if settings.loss is not None:
        return constraint_weights(graph.constraints.is_loop, chi2_at(graph.poses, graph.constraints), settings.loss)
    return np.ones(len(graph.constraints)) if kept is None else kept.astype(np.float64)
