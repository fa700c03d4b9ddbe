from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from posegraph_slam.geometry import SE2, SE3, Group
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.noise import information_from_sigmas

GraphMaker = Callable[..., PoseGraph]


def random_information(group: Group, count: int, rng: np.random.Generator) -> np.ndarray:
    """Full, well-conditioned information matrices around deviations of 5 cm and 0.02 rad."""
    mix = np.eye(group.dof) + 0.2 * rng.normal(size=(count, group.dof, group.dof))
    base = information_from_sigmas([0.05] * group.dof) / 4
    information = np.swapaxes(mix, 1, 2) @ base @ mix
    return 0.5 * (information + np.swapaxes(information, 1, 2))


def make_graph(group: Group, *, nodes: int = 40, loops: int = 30, noise: float = 1.0, seed: int = 0) -> PoseGraph:
    """A noisy walk with loops between random nodes; poses are the odometry chain, node 0 is fixed."""
    rng = np.random.default_rng(seed)
    steps = group.exp(rng.normal(size=(nodes - 1, group.dof)) * 0.3 + np.eye(group.dof)[0 if group is SE2 else 3])
    truth = [group.identity(1)[0]]
    for step in steps:
        truth.append(truth[-1] @ step)
    poses = np.array(truth)
    i = np.concatenate([np.arange(nodes - 1), rng.integers(0, nodes // 2, loops)])
    j = np.concatenate([np.arange(1, nodes), rng.integers(nodes // 2, nodes, loops)])
    kind = np.where(np.arange(len(i)) < nodes - 1, int(ConstraintKind.ODOMETRY), int(ConstraintKind.PROXIMITY))
    information = random_information(group, len(i), rng)
    L = np.linalg.cholesky(np.linalg.inv(information))
    delta = noise * (L @ rng.normal(size=(len(i), group.dof, 1)))[..., 0]
    T_i_j = group.retract(group.between(poses[i], poses[j]), delta)
    chain = [poses[0]]
    for T in T_i_j[: nodes - 1]:
        chain.append(chain[-1] @ T)
    return PoseGraph(
        poses=np.array(chain),
        session=np.zeros(nodes, dtype=np.int64),
        index=np.arange(nodes),
        fixed=np.arange(nodes) == 0,
        constraints=Constraints(i=i, j=j, T_i_j=T_i_j, information=information, kind=kind),
    )


@pytest.fixture(params=[SE2, SE3], ids=["SE2", "SE3"])
def group(request: pytest.FixtureRequest) -> Group:
    return request.param


@pytest.fixture
def graph_maker() -> GraphMaker:
    return make_graph


@pytest.fixture
def graph(group: Group) -> PoseGraph:
    return make_graph(group)


@pytest.fixture
def change() -> Callable[..., Constraints]:
    """Return constraints with some arrays replaced."""

    def replaced(constraints: Constraints, **arrays: np.ndarray) -> Constraints:
        fields = {name: getattr(constraints, name) for name in ("i", "j", "T_i_j", "information", "kind")}
        return Constraints(**{**fields, **arrays})

    return replaced
