"""Pose graphs drawn by the formulas of the usual benchmarks: torus, sphere, garage-like grid, city of streets, maze."""

from __future__ import annotations

import numpy as np

from posegraph_slam.geometry import SE2, SE3, Group, pose_from_rotation_translation, pose_from_xyt
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints, PoseGraph
from posegraph_slam.pose_graph.initialization import propagate_poses
from posegraph_slam.pose_graph.noise import information_isotropic


def noisy_graph(group: Group, poses: np.ndarray, i: np.ndarray, j: np.ndarray, sigma_m: float, sigma_rad: float,
                rng: np.random.Generator) -> PoseGraph:  # fmt: skip
    """Measure true poses along edges with Gaussian noise; the poses of the graph are the odometry chain."""
    sigma = np.full(group.dof, sigma_m)
    sigma[slice(2, 3) if group is SE2 else slice(0, 3)] = sigma_rad
    exact = group.between(poses[i], poses[j])
    T = group.retract(exact, rng.normal(size=(len(i), group.dof)) * sigma)
    one = information_isotropic(group, sigma_translation_m=sigma_m, sigma_rotation_rad=sigma_rad)
    kind = np.where(np.abs(j - i) == 1, int(ConstraintKind.ODOMETRY), int(ConstraintKind.EXTERNAL))
    constraints = Constraints(i=i, j=j, T_i_j=T, information=np.repeat(one[None], len(i), axis=0), kind=kind)
    fixed = np.arange(len(poses)) == 0
    chain = propagate_poses(group, poses, fixed, constraints)
    return PoseGraph(poses=chain, session=np.zeros(len(poses), np.int64), index=np.arange(len(poses)), fixed=fixed,
                     constraints=constraints)  # fmt: skip


def rounds(count: int, around: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of a spiral: from each node to the next, and to the node one round later."""
    ahead, round_later = np.arange(count - 1), np.arange(count - around)
    return np.concatenate([ahead, round_later]), np.concatenate([ahead + 1, round_later + around])


def sphere(rings: int, around: int, sigma_m: float, sigma_rad: float, seed: int, radius_m: float = 50.0) -> PoseGraph:
    """A spiral over a sphere, x along the path and z outwards."""
    k = np.arange(rings * around)
    longitude, latitude = 2 * np.pi * k / around, np.pi * ((k + 0.5) / len(k) - 0.5)
    out = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], 1)
    along = np.stack([-np.sin(longitude), np.cos(longitude), np.zeros(len(k))], axis=1)
    R = np.stack([along, np.cross(out, along), out], axis=2)
    return noisy_graph(SE3, pose_from_rotation_translation(R, radius_m * out), *rounds(len(k), around), sigma_m,
                       sigma_rad, np.random.default_rng(seed))  # fmt: skip


def torus(rings: int, around: int, sigma_m: float, sigma_rad: float, seed: int) -> PoseGraph:
    """A spiral around a torus of radii 10 and 3 m."""
    k = np.arange(rings * around)
    small, large = 2 * np.pi * k / around, 2 * np.pi * k / len(k)
    ring = np.stack([np.cos(large), np.sin(large), np.zeros(len(k))], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    out = np.cos(small)[:, None] * ring + np.sin(small)[:, None] * up
    along = -np.sin(small)[:, None] * ring + np.cos(small)[:, None] * up
    R = np.stack([along, np.cross(out, along), out], axis=2)
    return noisy_graph(SE3, pose_from_rotation_translation(R, 10 * ring + 3 * out), *rounds(len(k), around), sigma_m,
                       sigma_rad, np.random.default_rng(seed))  # fmt: skip


def cube(side: int, sigma_m: float, sigma_rad: float, seed: int, *, loop_share: float = 0.7) -> PoseGraph:
    """A path back and forth through a cube of side^3 places 1 m apart, turned at random; loops join neighbours."""
    rng = np.random.default_rng(seed)
    z, y, x = np.meshgrid(*[np.arange(side)] * 3, indexing="ij")
    y = np.where(z % 2 == 0, y, side - 1 - y)
    x = np.where((z * side + y) % 2 == 0, x, side - 1 - x)
    place = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    number = np.empty((side,) * 3, np.int64)
    number[tuple(place.T)] = np.arange(side**3)
    ends = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:]), (number[:, :, :-1], number[:, :, 1:])]
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in ends])
    pairs = np.sort(pairs, axis=1)
    loops = pairs[(pairs[:, 1] - pairs[:, 0] > 1) & (rng.random(len(pairs)) < loop_share)]
    ahead = np.arange(side**3 - 1)
    R = SE3.exp(np.concatenate([rng.normal(size=(side**3, 3)), np.zeros((side**3, 3))], axis=1))[:, :3, :3]
    return noisy_graph(SE3, pose_from_rotation_translation(R, place.astype(float)),
                       np.concatenate([ahead, loops[:, 0]]), np.concatenate([ahead + 1, loops[:, 1]]),
                       sigma_m, sigma_rad, rng)  # fmt: skip


def streets(count: int, sigma_m: float, sigma_rad: float, seed: int, *, side: int | None = None,
            loop_share: float = 0.5) -> PoseGraph:  # fmt: skip
    """A random drive on a grid of streets of 1 m steps; loops join visits of the same or the next crossing."""
    rng = np.random.default_rng(seed)
    side = max(10, int(np.sqrt(count) * 0.9)) if side is None else side
    step = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    place, heading = np.array([side // 2, side // 2]), 0
    where, turns = np.empty((count, 2), np.int64), np.empty(count, np.int64)
    draws = rng.random(count)
    for k in range(count):
        where[k], turns[k] = place, heading
        choice = (heading + (1 if draws[k] < 0.12 else 3 if draws[k] < 0.24 else 0)) % 4
        for turn in (choice, (choice + 1) % 4, (choice + 3) % 4, (choice + 2) % 4):
            ahead = place + step[turn]
            if np.all((ahead >= 0) & (ahead < side)):
                place, heading = ahead, turn
                break
    poses = pose_from_xyt(np.column_stack([where, turns * np.pi / 2]).astype(float))
    latest: dict[tuple[int, int], int] = {}
    pairs = []
    chances = rng.random(count)
    for k, (x, y) in enumerate(where.tolist()):
        before = latest.get((x, y))
        if before is not None and k - before > 10 and chances[k] < loop_share:
            pairs.append((before, k))
        latest[(x, y)] = k
    loops = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    ahead = np.arange(count - 1)
    return noisy_graph(SE2, poses, np.concatenate([ahead, loops[:, 0]]), np.concatenate([ahead + 1, loops[:, 1]]),
                       sigma_m, sigma_rad, rng)  # fmt: skip
