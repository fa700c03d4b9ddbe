"""Nodes and constraints of a pose graph as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, read_only
from posegraph_slam.errors import GraphError
from posegraph_slam.geometry import SE2, SE3, Group


class ConstraintKind(IntEnum):
    """Where a constraint comes from."""

    ODOMETRY = 0
    SCAN_MATCHING = 1
    """Registration of neighbours in time."""
    FIXED_INTERVAL = 2
    PROXIMITY = 3
    START_END = 4
    GLOBAL = 5
    """Found by a search that does not rely on the current estimate."""
    OVERLAP = 6
    """Registration of a pair that overlaps in the optimised map."""
    EXTERNAL = 7
    """Read from a graph file."""
    ATTITUDE = 8
    """Roll and pitch of a node, relative to a fixed one; all else is left free."""
    SAME_GROUND = 9
    """Two nodes stand at one place at the same height."""
    MANUAL = 10
    """Proposed by a person, and registered like any other."""

    @property
    def is_loop(self) -> bool:
        """Whether the constraint closes a loop, so that it may be wrong as a whole."""
        return self not in CERTAIN_KINDS


CERTAIN_KINDS = (ConstraintKind.ODOMETRY, ConstraintKind.SCAN_MATCHING, ConstraintKind.ATTITUDE)
"""Kinds of constraints that are never wrong as a whole, so that no robust loss applies to them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Constraints:
    """Relative poses T_i_j (E, d+1, d+1) of node j (source, newer) in node i (target, older).

    `i`, `j` (E,) are rows of the node array, not ids; `information` (E, p, p) is in the tangent of T_i_j exp(d), in
    GTSAM's order; `kind` (E,) holds `ConstraintKind` values.
    """

    i: IntArray
    j: IntArray
    T_i_j: FloatArray
    information: FloatArray
    kind: IntArray

    def __post_init__(self) -> None:
        for name in ("i", "j", "kind"):
            object.__setattr__(self, name, read_only(getattr(self, name), np.int64))
        for name in ("T_i_j", "information"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        count = len(self.i)
        if any(len(getattr(self, name)) != count for name in ("j", "T_i_j", "information", "kind")):
            raise GraphError("constraints", "i, j, T_i_j, information and kind differ in length")

    def __len__(self) -> int:
        return int(self.i.shape[0])

    @property
    def is_loop(self) -> BoolArray:
        """Which constraints (E,) close loops."""
        return ~np.isin(self.kind, [int(kind) for kind in CERTAIN_KINDS])

    def select(self, index: IntArray | BoolArray) -> Constraints:
        """Return the constraints at `index`."""
        return Constraints(
            i=self.i[index],
            j=self.j[index],
            T_i_j=self.T_i_j[index],
            information=self.information[index],
            kind=self.kind[index],
        )

    @staticmethod
    def concatenate(parts: Sequence[Constraints]) -> Constraints:
        """Join several sets in the order given."""
        return Constraints(
            i=np.concatenate([p.i for p in parts]),
            j=np.concatenate([p.j for p in parts]),
            T_i_j=np.concatenate([p.T_i_j for p in parts]),
            information=np.concatenate([p.information for p in parts]),
            kind=np.concatenate([p.kind for p in parts]),
        )

    @staticmethod
    def empty(group: Group) -> Constraints:
        """Return a set without constraints."""
        n, p = group.matrix_size, group.dof
        none = np.zeros(0, dtype=np.int64)
        return Constraints(i=none, j=none, T_i_j=np.zeros((0, n, n)), information=np.zeros((0, p, p)), kind=none)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseGraph:
    """Poses T_map_base (N, d+1, d+1) of nodes named (session, index), and the constraints between them.

    `session`, `index` (N,) identify a node across logs; `fixed` (N,) marks nodes that hold the gauge (at least one).
    """

    poses: FloatArray
    session: IntArray
    index: IntArray
    fixed: BoolArray
    constraints: Constraints

    def __post_init__(self) -> None:
        object.__setattr__(self, "poses", read_only(self.poses))
        object.__setattr__(self, "session", read_only(self.session, np.int64))
        object.__setattr__(self, "index", read_only(self.index, np.int64))
        object.__setattr__(self, "fixed", read_only(self.fixed, np.bool_))
        if not len(self.poses) == len(self.session) == len(self.index) == len(self.fixed):
            raise GraphError("pose graph", "poses, session, index and fixed differ in length")

    @staticmethod
    def chain(
        poses: FloatArray, index: IntArray, *, T_i_j: FloatArray, information: FloatArray, kind: int | IntArray
    ) -> PoseGraph:
        """Return nodes (N) of one session, each tied to the one before; the first holds the gauge.

        `index` (N,) names the nodes; `T_i_j` (N-1, d+1, d+1), `information` (N-1, p, p) and `kind` (N-1,), or one kind
        for all, are those of the constraints.
        """
        count = len(poses)
        return PoseGraph(
            poses=poses,
            session=np.zeros(count, dtype=np.int64),
            index=index,
            fixed=np.arange(count) == 0,
            constraints=Constraints(
                i=np.arange(count - 1),
                j=np.arange(1, count),
                T_i_j=T_i_j,
                information=information,
                kind=np.broadcast_to(np.asarray(kind, dtype=np.int64), count - 1),
            ),
        )

    def __len__(self) -> int:
        return int(self.poses.shape[0])

    @property
    def group(self) -> Group:
        """SE2 or SE3."""
        return SE2 if self.poses.shape[1] == 3 else SE3

    def with_poses(self, poses: FloatArray) -> PoseGraph:
        """Return the graph with other pose values."""
        return PoseGraph(
            poses=poses,
            session=self.session,
            index=self.index,
            fixed=self.fixed,
            constraints=self.constraints,
        )

    def with_constraints(self, constraints: Constraints) -> PoseGraph:
        """Return the graph with other constraints."""
        return PoseGraph(
            poses=self.poses,
            session=self.session,
            index=self.index,
            fixed=self.fixed,
            constraints=constraints,
        )
