"""Checks of a pose graph before it is solved: each fault is one clear line that names the node or the edge."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from posegraph_slam.arrays import LARGEST, BoolArray, FloatArray, IntArray, in_range, range_fault
from posegraph_slam.errors import GraphError
from posegraph_slam.jit import kernel
from posegraph_slam.pose_graph.graph import PoseGraph
from posegraph_slam.pose_graph.noise import SYMMETRY_TOLERANCE, asymmetry

ROTATION_TOLERANCE = 1e-6
"""Largest |R^T R - 1| taken for a rotation; quaternions of files are normalised on reading."""
DEFINITENESS_TOLERANCE = 4e-15
"""Smallest eigenvalue relative to the largest that counts as positive: below, rounding hides the sign."""


def node_name(graph: PoseGraph, row: int) -> str:
    """Name the node at `row` for a message."""
    session, index = int(graph.session[row]), int(graph.index[row])
    return f"node {index}" if session == 0 else f"node {index} of session {session}"


def edge_name(graph: PoseGraph, edge: int) -> str:
    """Name the constraint at `edge` with its nodes for a message."""
    c = graph.constraints
    return f"edge {edge} ({node_name(graph, int(c.i[edge]))} to {node_name(graph, int(c.j[edge]))})"


def check_graph(graph: PoseGraph) -> None:
    """Raise `GraphError`, naming the first offender, unless the graph can be solved.

    Checked: node indices and self edges; finite poses, measurements and information; rotations that are rotations;
    information symmetric and positive definite; every connected part holds a fixed node.
    """
    if len(graph) == 0:
        raise GraphError("pose graph", "it has no nodes")
    _check_shapes(graph)
    _check_indices(graph)
    _check_poses(graph)
    _check_information(graph)
    _check_connection(graph)


def component_labels(graph: PoseGraph) -> IntArray:
    """Return for each node (N,) the number of the connected part that it belongs to."""
    c, n = graph.constraints, len(graph)
    links = coo_array((np.ones(len(c), dtype=np.int8), (c.i, c.j)), shape=(n, n))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def _first(faults: npt.ArrayLike) -> int | None:
    bad = np.asarray(faults)
    return int(np.argmax(bad)) if bad.any() else None


def _check_shapes(graph: PoseGraph) -> None:
    n, p, c = graph.group.matrix_size, graph.group.dof, graph.constraints
    if graph.poses.shape[1:] != (n, n):
        raise GraphError("pose graph", f"poses have shape {graph.poses.shape}", "give (N, 3, 3) or (N, 4, 4)")
    if c.T_i_j.shape[1:] != (n, n) or c.information.shape[1:] != (p, p):
        raise GraphError(
            "constraints",
            f"T_i_j {c.T_i_j.shape} or information {c.information.shape} do not fit poses {graph.poses.shape}",
            f"give (E, {n}, {n}) and (E, {p}, {p})",
        )


def _check_indices(graph: PoseGraph) -> None:
    c, n = graph.constraints, len(graph)
    outside = (c.i < 0) | (c.j < 0) | (c.i >= n) | (c.j >= n)
    if (edge := _first(outside)) is not None:
        raise GraphError(f"edge {edge}", f"joins rows {c.i[edge]} and {c.j[edge]} of a graph of {n} nodes")
    if (edge := _first(c.i == c.j)) is not None:
        raise GraphError(edge_name(graph, edge), "joins a node to itself", "remove it")


def _check_poses(graph: PoseGraph) -> None:
    measured = graph.constraints.T_i_j
    if (row := _first(pose_faults(np.array(graph.poses)))) is not None:
        pose = graph.poses[row]
        usable = in_range(pose).all()
        raise GraphError(
            node_name(graph, row), "its rotation is not orthonormal" if usable else f"its pose is {range_fault(pose)}"
        )
    if (edge := _first(pose_faults(np.array(measured)))) is not None:
        if in_range(measured[edge]).all():
            raise GraphError(edge_name(graph, edge), "the rotation of its measurement is not orthonormal")
        raise GraphError(edge_name(graph, edge), f"its measurement is {range_fault(measured[edge])}")


def _check_information(graph: PoseGraph) -> None:
    information = graph.constraints.information
    suspects = np.flatnonzero(information_faults(np.array(information)))
    if len(suspects) == 0:
        return
    suspect = information[suspects]
    if (first := _first(~in_range(suspect).all(axis=(1, 2)))) is not None:
        raise GraphError(edge_name(graph, int(suspects[first])), f"its information is {range_fault(suspect[first])}")
    if (first := _first(asymmetry(suspect) > SYMMETRY_TOLERANCE)) is not None:
        edge = int(suspects[first])
        raise GraphError(edge_name(graph, edge), "its information is not symmetric", "give a symmetric matrix")
    eigenvalues = np.linalg.eigvalsh(suspect)
    indefinite = eigenvalues[:, 0] <= DEFINITENESS_TOLERANCE * eigenvalues[:, -1]
    if (first := _first(indefinite)) is not None:
        others = int(indefinite.sum()) - 1
        raise GraphError(
            edge_name(graph, int(suspects[first])),
            f"its information is not positive definite (eigenvalues {eigenvalues[first, 0]:.3g} to "
            f"{eigenvalues[first, -1]:.3g})" + (f", nor is that of {others} other edges" if others else ""),
            "clamp eigenvalues (psg solve --clamp) or remove the edge",
        )


@kernel
def pose_faults(poses: FloatArray) -> BoolArray:
    """Tell which poses (n, d+1, d+1) are not finite, far too large or have a matrix that is no rotation."""
    d = poses.shape[1] - 1
    result = np.zeros(len(poses), np.bool_)
    for k in range(len(poses)):
        T, worst = poses[k], 0.0
        for a in range(d):
            for b in range(a + 1):
                inner = -1.0 if a == b else 0.0
                for row in range(d):
                    inner += T[row, a] * T[row, b]
                worst = max(worst, abs(inner))
        turned = T[0, 0] * T[1, 1] - T[0, 1] * T[1, 0]
        if d == 3:  # the last column is the product of the others: with the sign of a rotation, not of a reflection
            turned = turned * T[2, 2] + (T[1, 0] * T[2, 1] - T[1, 1] * T[2, 0]) * T[0, 2]
            turned += (T[2, 0] * T[0, 1] - T[0, 0] * T[2, 1]) * T[1, 2]
        usable = True
        for row in range(d + 1):
            for column in range(d + 1):
                usable = usable and abs(T[row, column]) <= LARGEST
        result[k] = not (usable and worst <= ROTATION_TOLERANCE and turned > 0.0)
    return result


@kernel
def information_faults(information: FloatArray) -> BoolArray:
    """Tell which matrices (E, p, p) are not in range, symmetric and, by Cholesky with a margin, positive definite."""
    p = information.shape[1]
    L, result = np.empty((p, p)), np.zeros(len(information), np.bool_)
    for e in range(len(information)):
        M, largest, skew, trace, good = information[e], 0.0, 0.0, 0.0, True
        for a in range(p):
            trace += M[a, a]
            for b in range(p):
                good = good and abs(M[a, b]) <= LARGEST
                largest, skew = max(largest, abs(M[a, b])), max(skew, abs(M[a, b] - M[b, a]))
        good = good and skew <= SYMMETRY_TOLERANCE * largest
        for a in range(p):
            for b in range(a + 1):
                value = M[a, b] - (DEFINITENESS_TOLERANCE * trace if a == b else 0.0)
                for k in range(b):
                    value -= L[a, k] * L[b, k]
                if a == b:
                    good = good and value > 0.0
                    L[a, a] = np.sqrt(value) if good else 1.0
                else:
                    L[a, b] = value / L[b, b]
        result[e] = not good
    return result


def _check_connection(graph: PoseGraph) -> None:
    labels = component_labels(graph)
    sizes = np.bincount(labels)
    held = np.bincount(labels, weights=graph.fixed) > 0
    if held.all():
        return
    member = node_name(graph, int(np.argmax(labels == int(np.argmin(held)))))
    if len(sizes) == 1:
        raise GraphError("pose graph", "no node is fixed", f"fix one, for instance {member}")
    largest = ", ".join(str(s) for s in np.sort(sizes)[::-1][:5]) + (", ..." if len(sizes) > 5 else "")
    raise GraphError(
        "pose graph",
        f"it falls into {len(sizes)} disconnected parts of {largest} nodes, and the part of {member} has no fixed node",
        "add constraints that join the parts, fix a node in each, or choose (psg solve --component largest or all)",
    )
