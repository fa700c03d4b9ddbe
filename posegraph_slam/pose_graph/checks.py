"""Checks of a pose graph before it is solved: each fault is one clear line that names the node or the edge."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray
from posegraph_slam.errors import GraphError
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


def _rotation_faults(poses: FloatArray) -> BoolArray:
    d = poses.shape[-1] - 1
    R = poses[:, :d, :d]
    error = np.max(np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(d)), axis=(1, 2)) if len(poses) else np.zeros(0)
    return np.asarray((error > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0))


def _check_poses(graph: PoseGraph) -> None:
    c = graph.constraints
    if (row := _first(~np.isfinite(graph.poses).all(axis=(1, 2)))) is not None:
        raise GraphError(node_name(graph, row), "its pose is not finite")
    if (edge := _first(~np.isfinite(c.T_i_j).all(axis=(1, 2)))) is not None:
        raise GraphError(edge_name(graph, edge), "its measurement is not finite")
    if (row := _first(_rotation_faults(graph.poses))) is not None:
        raise GraphError(node_name(graph, row), "its rotation is not orthonormal")
    if (edge := _first(_rotation_faults(c.T_i_j))) is not None:
        raise GraphError(edge_name(graph, edge), "the rotation of its measurement is not orthonormal")


def _check_information(graph: PoseGraph) -> None:
    information = graph.constraints.information
    if (edge := _first(~np.isfinite(information).all(axis=(1, 2)))) is not None:
        raise GraphError(edge_name(graph, edge), "its information is not finite")
    if (edge := _first(asymmetry(information) > SYMMETRY_TOLERANCE)) is not None:
        raise GraphError(edge_name(graph, edge), "its information is not symmetric", "give a symmetric matrix")
    if _clearly_definite(information):
        return
    eigenvalues = np.linalg.eigvalsh(information)
    if (edge := _first(eigenvalues[:, 0] <= DEFINITENESS_TOLERANCE * eigenvalues[:, -1])) is not None:
        raise GraphError(
            edge_name(graph, edge),
            f"its information is not positive definite (eigenvalues {eigenvalues[edge, 0]:.3g} to "
            f"{eigenvalues[edge, -1]:.3g})",
            "clamp its eigenvalues or remove the edge",
        )


def _clearly_definite(information: FloatArray) -> bool:
    """Tell by Cholesky, five times faster than eigenvalues, that all are positive definite with a margin."""
    margin = DEFINITENESS_TOLERANCE * np.trace(information, axis1=1, axis2=2)[:, None, None]
    try:
        np.linalg.cholesky(information - margin * np.eye(information.shape[-1]))
    except np.linalg.LinAlgError:
        return False
    return True


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
        "add constraints that join the parts, fix a node in each, or keep one part",
    )
