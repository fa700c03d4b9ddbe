"""The walk through the grid against an oracle in exact fractions."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.raycast import CELL, ray_cells

UNIT = GridGeometry(origin_m=np.zeros(2), resolution_m=1.0, shape=(8, 8))


def on_the_kernels_lattice(value: float) -> Fraction:
    """Positions are odd multiples of 1 / CELL cells."""
    return Fraction(int(np.floor(value * CELL)) | 1, CELL)


def crossed_cells(start: np.ndarray, end: np.ndarray) -> list[tuple[int, int]]:
    """Cut the segment at every line of the grid, in exact arithmetic, and name the cell of each piece's middle."""
    a, b = ([on_the_kernels_lattice(v) for v in point] for point in (start, end))
    cuts = {Fraction(0), Fraction(1)}
    for axis in range(2):
        low, high = sorted((a[axis], b[axis]))
        for line in range(int(low) - 2, int(high) + 3):
            if low < line < high:
                cuts.add((line - a[axis]) / (b[axis] - a[axis]))
    ordered = sorted(cuts)
    cells = []
    for t0, t1 in pairwise(ordered):
        x, y = (a[k] + (t0 + t1) / 2 * (b[k] - a[k]) for k in range(2))
        cells.append((y.numerator // y.denominator, x.numerator // x.denominator))
    return cells


COORDINATES = st.one_of(
    st.floats(-12, 12),
    st.integers(-6, 6).map(float),  # on lines and corners of the grid
    st.integers(-24, 24).map(lambda n: n / 4),
)
POINTS = st.tuples(COORDINATES, COORDINATES).map(np.array)


@settings(max_examples=400)
@given(start=POINTS, end=POINTS)
def test_walk_visits_exactly_the_cells_crossed_in_order(start, end):
    visited = [tuple(cell) for cell in ray_cells(UNIT, start, end).tolist()]
    assert visited == crossed_cells(start, end)


@settings(max_examples=100)
@given(
    start=POINTS, end=POINTS, resolution=st.sampled_from([0.05, 0.3]), yaw=st.floats(-3, 3),
    origin=st.tuples(st.floats(-9, 9), st.floats(-9, 9)).map(np.array),
)  # fmt: skip
def test_walk_agrees_with_dense_sampling_in_any_grid(start, end, resolution, yaw, origin):
    geometry = GridGeometry(origin_m=origin, resolution_m=resolution, shape=(8, 8), yaw_rad=yaw)
    cells = ray_cells(geometry, start, end)
    assert len(np.unique(cells, axis=0)) == len(cells)
    assert (np.abs(np.diff(cells, axis=0)).max(axis=1, initial=1) == 1).all()
    samples = start + np.linspace(0, 1, 4001)[:, None] * (end - start)
    # A sample within a millionth of a cell of a line may fall to either side.
    position = (samples - origin) @ geometry.cells_from_map[:2, :2].T
    clear = (np.abs(position - np.round(position)) > 1e-5).all(axis=1)
    sampled = {tuple(cell) for cell in geometry.world_to_cell(samples[clear]).tolist()}
    assert sampled <= {tuple(cell) for cell in cells.tolist()}


def test_diagonal_goes_through_corners_without_the_cells_beside_them():
    cells = ray_cells(UNIT, np.array([0.5, 0.5]), np.array([4.5, 4.5]))
    assert cells.tolist() == [[k, k] for k in range(5)]
    assert ray_cells(UNIT, np.array([4.5, 0.5]), np.array([0.5, 4.5]))[-1].tolist() == [4, 0]


def test_walks_along_an_axis_and_within_a_cell():
    assert ray_cells(UNIT, np.array([0.5, 2.5]), np.array([3.5, 2.5])).tolist() == [[2, k] for k in range(4)]
    assert ray_cells(UNIT, np.array([1.5, 3.5]), np.array([1.5, -1.5])).tolist() == [[k, 1] for k in range(3, -3, -1)]
    assert ray_cells(UNIT, np.array([1.2, 1.3]), np.array([1.8, 1.1])).tolist() == [[1, 1]]


def test_long_walk_ends_in_its_last_cell():
    start, end = np.array([0.123, 0.456]), np.array([200_000.7, 70_000.1])
    cells = ray_cells(UNIT, start, end)
    assert cells[-1].tolist() == [70_000, 200_000]
    assert len(cells) == 270_001
    x = start[0] + (cells[:, 0] - start[1]) * (end[0] - start[0]) / (end[1] - start[1])
    assert np.abs(cells[:, 1] - x).max() < 4.9  # slope 2.86: a row spans that many columns, and one cell more
