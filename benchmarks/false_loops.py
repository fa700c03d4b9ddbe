"""False loops for pose graphs: between random nodes, between near ones, and in groups of successive pairs; seeded."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph

POSITION_SIGMA_M, ROTATION_SIGMA_RAD = 0.3, np.radians(10.0)
"""A false loop says what place recognition says: that both nodes see the same place from nearly the same pose."""
NEAR = 20
"""Farthest step in the order of nodes of a local loop."""
GROUP = 10


class Kind(StrEnum):
    RANDOM = "random"
    LOCAL = "local"
    GROUPED = "grouped"


def add_false_loops(graph: PoseGraph, kind: Kind, share: float, rng: np.random.Generator) -> PoseGraph:
    """Append false loops, `share` times as many as there are loops; their information is the loops' mean."""
    c, group = graph.constraints, graph.group
    count = round(share * int(c.is_loop.sum()))
    i, j = false_pairs(len(graph), kind, count, rng)
    draws = -(-count // GROUP) if kind is Kind.GROUPED else count
    sigma = np.full(group.dof, POSITION_SIGMA_M)
    turns = slice(2, 3) if group.dimension == 2 else slice(0, 3)
    sigma[turns] = ROTATION_SIGMA_RAD
    T = group.exp(rng.normal(size=(draws, group.dof)) * sigma)
    T = np.repeat(T, GROUP, axis=0)[:count] if kind is Kind.GROUPED else T
    information = np.repeat(c.information[c.is_loop].mean(axis=0)[None], count, axis=0)
    false = Constraints(i=i, j=j, T_i_j=T, information=information, kind=np.full(count, int(ConstraintKind.EXTERNAL)))
    return graph.with_constraints(Constraints.concatenate([c, false]))


def false_pairs(nodes: int, kind: Kind, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes i < j of `count` false loops, at least two steps apart."""
    if kind is Kind.LOCAL:
        i = rng.integers(0, nodes - NEAR, count)
        return i, i + rng.integers(2, NEAR + 1, count)
    if kind is Kind.RANDOM:
        i = rng.integers(0, nodes - 2, count)
        return i, np.array([rng.integers(a + 2, nodes) for a in i])
    groups = -(-count // GROUP)
    first = rng.integers(0, nodes - 2 * GROUP, groups)
    second = np.array([rng.integers(a + 2, nodes - GROUP) for a in first])
    steps = np.arange(GROUP)
    return (first[:, None] + steps).ravel()[:count], (second[:, None] + steps).ravel()[:count]
