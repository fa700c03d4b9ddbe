"""Descent on the chordal cost: damped Newton steps with the exact Hessian, at any rank."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray
from posegraph_slam.pose_graph.block_cholesky import factorize
from posegraph_slam.pose_graph.block_pattern import block_pattern
from posegraph_slam.pose_graph.block_substitution import solve_factored
from posegraph_slam.pose_graph.chordal_cost import (
    ChordalProblem,
    Lifted,
    certificate_diagonal,
    moved,
    multipliers,
    tangent_gradient,
    tangent_hessian,
    tangents,
    value,
)

FACTORISATIONS = 100
"""Most of them in one minimisation, far more than proofs need that succeed."""
LEAST_FACTORISATIONS = 20
"""What a minimisation gets even if it spends more than that."""
LEVEL = 1e-13
"""Share of the cost below which a decrease drowns in rounding."""
LEAST_COST = 1e-20


@dataclass(slots=True)
class Budget:
    """Multiplications that are left to be spent."""

    left: float


def minimize_chordal(
    problem: ChordalProblem, at: Lifted, anchors: BoolArray, *, budget: Budget | None = None
) -> tuple[Lifted, float]:
    """Minimise F from lifted poses by damped Newton steps with the exact Hessian; `anchors` (n,) do not move.

    Multiplications are taken from the budget, and end with it after `LEAST_FACTORISATIONS`.
    """
    d, rank = problem.dimension, at.Q.shape[1]
    basis = tangents(d, rank)
    pattern = block_pattern(len(anchors), problem.i, problem.j, len(basis.row), kept=~anchors)
    cost, G = value(problem, at)
    damping, before = 0.0, np.inf
    budget = Budget(np.inf) if budget is None else budget
    done, work = 0, pattern.work
    while done < LEAST_FACTORISATIONS or (done < FACTORISATIONS and budget.left > 0):
        gradient = tangent_gradient(at.Q, G, basis.row, basis.column, basis.sign)
        S = certificate_diagonal(problem, multipliers(at, G))
        diagonal, off = tangent_hessian(at.Q, problem.i, problem.j, S, problem.off_diagonal, basis.row, basis.column,
                                        basis.sign)  # fmt: skip
        least = 1e-10 * float(np.mean(np.abs(np.trace(problem.diagonal, axis1=1, axis2=2))))
        while True:
            factor = factorize(pattern, diagonal, off, damping)
            done, budget.left = done + 1, budget.left - work
            if factor is not None:
                delta = -solve_factored(pattern, factor, gradient)
                predicted = -float(np.sum(delta * gradient))
                trial = moved(at, basis, delta, d)
                new_cost, new_G = value(problem, trial)
                if new_cost <= cost or predicted <= LEVEL * cost:
                    break
            damping = max(10 * damping, least)
            if damping > 1e20 * least or done >= FACTORISATIONS:
                return at, cost
        at, cost, G = trial, new_cost, new_G
        damping = damping / 10 if damping > least else 0.0
        # The multipliers need the gradient to its last digits, well after the cost stopped falling.
        if cost < LEAST_COST or (predicted <= LEVEL * cost and predicted >= 0.1 * before):
            break
        before = predicted
    return at, cost
