"""Figures: what they show where, and bytes that depend on the content alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from posegraph_slam.geometry import SE2, SO3, Trajectory, pose_from_rotation_translation, pose_from_xyt
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid
from posegraph_slam.pose_graph.graph import ConstraintKind, Constraints
from posegraph_slam.report import canvas
from posegraph_slam.report.canvas import BLACK, BLUE, GREEN, ORANGE, SKY, round_length
from posegraph_slam.report.figures import align_truth, draw_map, draw_texture, draw_trajectories, loop_segments
from posegraph_slam.report.space_figure import draw_heights, height_offset, profile
from posegraph_slam.report.view import MAXIMUM_PIXELS, View, bounds_around


def trajectory(xyt: np.ndarray) -> Trajectory:
    return Trajectory(stamps_s=np.arange(len(xyt)) * 0.1, poses=pose_from_xyt(xyt), parent="map", child="base")


@pytest.fixture(scope="module")
def path_xyt() -> np.ndarray:
    t = np.linspace(0, 5, 200)
    return np.stack([3 * np.cos(t), 2 * np.sin(t), t], axis=1)


@pytest.fixture(scope="module")
def grid() -> OccupancyGrid:
    geometry = GridGeometry.square(20.0, resolution_m=0.1)
    observed, log_odds = np.zeros(geometry.shape, bool), np.zeros(geometry.shape)
    observed[50:150, 50:150] = True
    log_odds[50:150, 50:150] = -5.0
    log_odds[50:52, 50:150] = 5.0
    return OccupancyGrid(geometry=geometry, log_odds=log_odds, observed=observed)


@pytest.fixture
def full_resolution(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw as users see it: at half the resolution thin lines have other colours."""
    monkeypatch.setattr(canvas, "DPI", 200)


def share(path: Path, colour: str, tolerance: int = 12) -> float:
    """Part of the pixels that have about this colour."""
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB"), np.int16)
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], np.int16)
    return float((np.abs(pixels - wanted).max(axis=-1) <= tolerance).mean())


def climb(lift_m: float = 0.0, first: int = 0) -> Trajectory:
    """Up a ramp of 0.2 rad at 1 m/s and on, rolling by 0.05 rad."""
    t = 0.1 * np.arange(first, 100)
    pitch = np.where(t < 5, -0.2, 0.0)
    height = 0.2 * np.minimum(t, 5.0) + lift_m
    R = SO3.exp(pitch[:, None] * [0, 1, 0]) @ SO3.exp(np.tile([0.05, 0.0, 0.0], (len(t), 1)))
    poses = pose_from_rotation_translation(R, np.stack([t, 0 * t, height], axis=1))
    return Trajectory(stamps_s=t, poses=poses, parent="map", child="base")


@pytest.mark.usefixtures("full_resolution")
def test_heights_show_what_the_plan_view_does_not(tmp_path: Path, path_xyt: np.ndarray) -> None:
    height, roll, pitch = profile(climb())
    assert height[-1] == pytest.approx(1.0)
    np.testing.assert_allclose(roll, np.degrees(0.05), atol=1e-9)
    np.testing.assert_allclose(pitch[[0, -1]], [-np.degrees(0.2), 0.0], atol=1e-9)
    assert not profile(trajectory(path_xyt)).any()
    assert height_offset(climb(), climb(lift_m=3.0, first=20)) == pytest.approx(-3.0)
    stages = {"odometry": trajectory(path_xyt), "optimised": climb()}
    for name in ("a.png", "b.png"):
        draw_heights(stages, tmp_path / name, truth=climb(lift_m=3.0))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert share(tmp_path / "a.png", BLUE) > 0.001
    assert share(tmp_path / "a.png", SKY) > 0.0005


@pytest.mark.usefixtures("full_resolution")
def test_trajectories_of_all_stages_are_seen(tmp_path: Path, path_xyt: np.ndarray) -> None:
    drift = path_xyt + np.linspace(0, 1, 200)[:, None] * [1.0, -0.5, 0.0]
    stages = {"odometry": trajectory(drift), "scan matching": trajectory(drift * [0.9, 0.9, 1])}
    both = tmp_path / "both.png"
    draw_trajectories({**stages, "optimised": trajectory(path_xyt)}, both, truth=trajectory(path_xyt))
    assert all(share(both, colour) > 1e-3 for colour in (ORANGE, SKY, BLUE))
    one = tmp_path / "one.png"
    draw_trajectories({"optimised": trajectory(path_xyt)}, one)
    assert share(one, ORANGE) == 0.0
    assert {item.name for item in tmp_path.iterdir()} == {"both.png", "one.png"}


def test_same_content_gives_the_same_bytes(tmp_path: Path, path_xyt: np.ndarray, grid: OccupancyGrid) -> None:
    for name in ("a.png", "b.png"):
        draw_map(grid, tmp_path / name, trajectory=trajectory(path_xyt))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.usefixtures("full_resolution")
def test_map_shows_walls_path_and_loops(tmp_path: Path, path_xyt: np.ndarray, grid: OccupancyGrid) -> None:
    segments = np.array([[[-3.0, -3.0], [3.0, 3.0]]])
    plain, full = tmp_path / "plain.png", tmp_path / "full.png"
    draw_map(grid, plain)
    assert share(plain, BLUE) == share(plain, GREEN) == 0.0
    assert share(plain, BLACK) > 0.005
    draw_map(
        grid,
        full,
        trajectory=trajectory(path_xyt),
        loops={ConstraintKind.PROXIMITY: segments, ConstraintKind.FIXED_INTERVAL: np.zeros((0, 2, 2))},
        rejected=segments[:, ::-1] * [1, -1],
    )
    assert share(full, BLUE) > 1e-3
    assert share(full, GREEN) > 5e-4
    assert share(full, SKY) == 0.0


def test_texture_shows_colours_and_walls(tmp_path: Path, grid: OccupancyGrid, path_xyt: np.ndarray) -> None:
    colours = np.zeros((*grid.geometry.shape, 3), np.uint8)
    colours[..., 0] = 200
    covered = grid.observed & ~grid.occupied
    file = tmp_path / "texture.png"
    draw_texture(grid.geometry, colours, covered, file, occupied=grid.occupied, trajectory=trajectory(path_xyt))
    assert share(file, "#c80000") > 0.3
    assert share(file, "#3c3c3c") > 0.002
    draw_texture(grid.geometry, colours, np.zeros_like(covered), tmp_path / "nothing.png")
    assert share(tmp_path / "nothing.png", "#c80000") == 0.0


@given(x=st.floats(-50, 50), y=st.floats(-50, 50), angle=st.floats(-3, 3))
def test_truth_is_laid_over_the_estimate(x: float, y: float, angle: float) -> None:
    t = np.linspace(0, 5, 60)
    estimate = trajectory(np.stack([3 * np.cos(t), np.sin(2 * t), t], axis=1))
    moved = pose_from_xyt(np.array([x, y, angle])) @ estimate.poses
    longer = np.concatenate([moved, moved[-5:] @ SE2.exp(np.array([0.1, 0, 0]))])
    truth = Trajectory(stamps_s=np.arange(len(longer)) * 0.1, poses=longer, parent="ref", child="base")
    np.testing.assert_allclose(align_truth(truth, estimate)[:60], estimate.positions, atol=1e-9)


def test_truth_of_another_time_is_left_as_it_is() -> None:
    estimate = trajectory(np.zeros((5, 3)))
    truth = trajectory(np.ones((5, 3))).restamped(np.arange(5) + 100.0)
    np.testing.assert_array_equal(align_truth(truth, estimate), np.ones((5, 2)))


def test_segments_by_kind() -> None:
    positions = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    constraints = Constraints(
        i=np.array([0, 1, 0]),
        j=np.array([1, 2, 2]),
        T_i_j=np.tile(np.eye(3), (3, 1, 1)),
        information=np.tile(np.eye(3), (3, 1, 1)),
        kind=np.array([ConstraintKind.SCAN_MATCHING, ConstraintKind.PROXIMITY, ConstraintKind.GLOBAL]),
    )
    segments = loop_segments(positions, constraints)
    assert set(segments) == {ConstraintKind.PROXIMITY, ConstraintKind.GLOBAL}
    np.testing.assert_array_equal(segments[ConstraintKind.GLOBAL], [[[0, 0], [1, 1]]])


@given(st.floats(1e-3, 1e6))
def test_round_length(length: float) -> None:
    result = round_length(length)
    assert length / 2.5 - 1e-9 <= result <= length * (1 + 1e-9)
    assert f"{result:e}"[0] in "125"


@given(rows=st.integers(1, 40), columns=st.integers(1, 5000))
def test_view_keeps_every_wall_and_the_scale(rows: int, columns: int) -> None:
    geometry = GridGeometry(origin_m=np.array([-2.0, 3.0]), resolution_m=0.5, shape=(rows, columns))
    values = np.zeros(geometry.shape)
    values[rows // 2, columns // 3] = 7.0
    view = View.of(geometry, np.ones(geometry.shape, bool))
    image = view.peaks(values)
    assert max(image.shape) <= MAXIMUM_PIXELS
    assert image.max() == 7.0
    left, right, bottom, top = view.extent_m
    assert (right - left) / image.shape[1] == pytest.approx((top - bottom) / image.shape[0])
    row, column = np.argwhere(image == 7.0)[0]
    pixel = view.block * 0.5
    assert left + column * pixel <= -2 + (columns // 3 + 0.5) * 0.5 <= left + (column + 1) * pixel
    assert bottom + row * pixel <= 3 + (rows // 2 + 0.5) * 0.5 <= bottom + (row + 1) * pixel
    assert view.samples(values).shape == image.shape


def test_bounds_ignore_what_is_not_finite() -> None:
    left, right, bottom, top = bounds_around(np.array([[0.0, 0.0], [10.0, 4.0], [np.nan, 1.0]]))
    assert (left, right, bottom, top) == pytest.approx((-0.5, 10.5, -0.5, 4.5))
    assert bounds_around(np.zeros((0, 2)))[1] > 0
