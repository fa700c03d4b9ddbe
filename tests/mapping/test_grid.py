"""Cells and world coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posegraph_slam.errors import InputError
from posegraph_slam.mapping.grid import GridGeometry

GEOMETRIES = st.builds(
    GridGeometry,
    origin_m=st.tuples(st.floats(-50, 50), st.floats(-50, 50)).map(np.array),
    resolution_m=st.floats(0.01, 2),
    shape=st.tuples(st.integers(1, 300), st.integers(1, 300)),
    yaw_rad=st.floats(-4, 4),
)


def test_row_is_y_and_origin_is_the_lower_left_corner():
    geometry = GridGeometry(origin_m=np.array([-1.0, 2.0]), resolution_m=0.5, shape=(4, 6))
    points = np.array([[-1.0, 2.0], [-0.51, 2.0], [-0.49, 2.9], [1.9, 3.9], [-1.01, 1.99]])
    expected = [[0, 0], [0, 0], [1, 1], [3, 5], [-1, -1]]
    assert geometry.world_to_cell(points).tolist() == expected
    assert geometry.cell_to_world(np.array([1, 2])).tolist() == [0.25, 2.75]
    assert geometry.contains(np.array([[0, 0], [3, 5], [4, 0], [0, 6], [-1, 0]])).tolist() == [True, True, *[False] * 3]
    assert geometry.extent_m == (-1.0, 2.0, 2.0, 4.0)


@given(geometry=GEOMETRIES, cell=st.tuples(st.integers(-500, 500), st.integers(-500, 500)))
def test_centre_of_a_cell_lies_in_the_cell(geometry, cell):
    cell = np.array(cell)
    centre = geometry.cell_to_world(cell)
    assert (geometry.world_to_cell(centre) == cell).all()
    column, row, _ = geometry.cells_from_map @ [*centre, 1.0]
    assert [row, column] == pytest.approx(cell + 0.5, abs=1e-6)


def test_yaw_turns_the_grid_about_its_origin():
    geometry = GridGeometry(origin_m=np.array([1.0, 1.0]), resolution_m=1.0, shape=(3, 3), yaw_rad=np.pi / 2)
    # Columns now run along +y and rows along -x.
    assert geometry.cell_to_world(np.array([0, 2])) == pytest.approx([0.5, 3.5])
    assert geometry.cell_to_world(np.array([2, 0])) == pytest.approx([-1.5, 1.5])


@given(
    points=st.lists(st.tuples(st.floats(-40, 40), st.floats(-40, 40)), min_size=1, max_size=9).map(np.array),
    resolution=st.sampled_from([0.05, 0.1, 0.37]),
    margin=st.floats(0, 2),
)
def test_around_holds_every_point_with_its_margin_and_no_more(points, resolution, margin):
    geometry = GridGeometry.around(points, resolution_m=resolution, margin_m=margin)
    assert geometry.contains(geometry.world_to_cell(points)).all()
    left, right, bottom, top = geometry.extent_m
    low, high = points.min(axis=0), points.max(axis=0)
    for edge, inner in ((low[0], left), (low[1], bottom), (-high[0], -right), (-high[1], -top)):
        assert -1e-9 <= edge - margin - inner <= resolution + 1e-5
    assert geometry.origin_m / resolution == pytest.approx(np.round(geometry.origin_m / resolution), abs=1e-6)


def test_square_is_centred_and_has_the_size_asked_for():
    geometry = GridGeometry.square(40.0, resolution_m=0.05)
    assert geometry.shape == (800, 800)
    assert geometry.extent_m == pytest.approx((-20, 20, -20, 20))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"resolution_m": 0.0}, "resolution"),
        ({"resolution_m": float("nan")}, "resolution"),
        ({"shape": (0, 5)}, "cells"),
        ({"shape": (100_000, 100_000)}, "coarser resolution"),
        ({"origin_m": np.array([np.nan, 0.0])}, "finite"),
    ],
)
def test_impossible_grids_are_refused(change, problem):
    with pytest.raises(InputError, match=problem):
        GridGeometry(**{"origin_m": np.zeros(2), "resolution_m": 0.05, "shape": (5, 5), **change})


def test_around_refuses_no_points_and_points_that_are_not_finite():
    for points in (np.zeros((0, 2)), np.array([[0.0, np.inf]])):
        with pytest.raises(InputError, match="points"):
            GridGeometry.around(points, resolution_m=0.05)
