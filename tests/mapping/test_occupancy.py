"""The occupancy map: rules of evidence, bounds, determinism."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from posegraph_slam.errors import ConfigurationError, InputError
from posegraph_slam.geometry import Trajectory, pose_from_xyt
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.occupancy import OccupancyGrid, OccupancySettings, build_occupancy
from posegraph_slam.mapping.raycast import ray_cells
from posegraph_slam.sensors import LaserScans

STEP = math.log(4)


def scans_of(ranges, *, angle_min=0.0, increment=0.1, T_base_lidar=None) -> LaserScans:
    ranges = np.atleast_2d(np.asarray(ranges, dtype=np.float32))
    return LaserScans(
        stamps_s=np.arange(len(ranges), dtype=float),
        ranges_m=ranges,
        angle_min_rad=angle_min,
        angle_increment_rad=increment,
        range_min_m=0.1,
        range_max_m=10.0,
        T_base_lidar=np.eye(4) if T_base_lidar is None else T_base_lidar,
    )


def path_of(xyt) -> Trajectory:
    xyt = np.atleast_2d(np.asarray(xyt, dtype=float))
    return Trajectory(stamps_s=np.arange(len(xyt), dtype=float), poses=pose_from_xyt(xyt), parent="map", child="base")


def value_at(grid: OccupancyGrid, x: float, y: float) -> float:
    row, column = grid.geometry.world_to_cell(np.array([x, y]))
    return float(grid.log_odds[row, column])


def slow_occupancy(scans: LaserScans, path: Trajectory, options: OccupancySettings, geometry: GridGeometry):
    """The rules, one cell at a time: sets of cells a scan, hits before misses, clamped sums."""
    total, seen = np.zeros(geometry.shape), np.zeros(geometry.shape, dtype=bool)
    for k in range(len(scans)):
        T = path.spatial().poses[k] @ scans.T_base_lidar
        hits, misses = set(), set()
        for angle, value in zip(scans.angles_rad, scans.ranges_m[k].astype(float), strict=True):
            at = lambda r, a=angle, T=T: (T @ [r * np.cos(a), r * np.sin(a), 0, 1])[:2]  # noqa: E731
            trusted = scans.range_min_m <= value < min(options.max_range_m, scans.range_max_m)
            if trusted:
                hits.add(tuple(geometry.world_to_cell(at(value)).tolist()))
            reach = min(value, options.free_range_m) if value < scans.range_max_m else options.no_return_clear_m
            if value >= scans.range_min_m and reach > 0:
                misses |= {tuple(cell) for cell in ray_cells(geometry, T[:2, 3], at(reach))[:-1].tolist()}
        for cell, step in [(c, options.occupied_log_odds) for c in hits] + [
            (c, -options.free_log_odds) for c in misses - hits
        ]:
            if geometry.contains(np.array(cell)):
                total[cell] = np.clip(total[cell] + step, -options.clamp_log_odds, options.clamp_log_odds)
                seen[cell] = True
    return total, seen


VALUES = st.sampled_from([0.0, 0.05, 0.9, 1.0, 2.3, 4.7, 7.7, 9.99, 10.0, 60.0, np.nan, np.inf])
RANGES = st.lists(st.lists(VALUES, min_size=7, max_size=7), min_size=1, max_size=6)


@settings(max_examples=60, deadline=None)
@given(
    ranges=RANGES,
    seed=st.integers(0, 1000),
    options=st.builds(
        OccupancySettings,
        resolution_m=st.sampled_from([0.2, 0.5]),
        occupied_log_odds=st.sampled_from([STEP, 0.9]),
        clamp_log_odds=st.sampled_from([4 * STEP, 1.5]),
        max_range_m=st.sampled_from([30.0, 5.0]),
        free_range_m=st.sampled_from([30.0, 3.0]),
        no_return_clear_m=st.sampled_from([0.0, 2.0]),
        fixed_size_m=st.sampled_from([0.0, 6.0]),
    ),
)
def test_map_agrees_with_the_slow_rules(ranges, seed, options):
    rng = np.random.default_rng(seed)
    mount = np.eye(4)
    mount[:2, 3] = 0.13, -0.02
    scans = scans_of(ranges, angle_min=-1.0, increment=0.35, T_base_lidar=mount)
    path = path_of(rng.uniform(-2, 2, (len(scans), 3)))
    used = scans.ranges_m[scans.ranges_m >= scans.range_min_m]
    if options.fixed_size_m == 0 and not ((used < 10) | (options.no_return_clear_m > 0)).any():
        with pytest.raises(InputError, match="no trusted return"):
            build_occupancy(scans, path, options)
        return
    grid = build_occupancy(scans, path, options)
    total, seen = slow_occupancy(scans, path, options, grid.geometry)
    assert (grid.observed == seen).all()
    assert np.abs(grid.log_odds - total).max() < 3e-3  # a step is rounded to 1/4096 of a hit


def test_beam_frees_its_way_and_marks_its_end():
    grid = build_occupancy(scans_of([[2.02]]), path_of([0.02, 0.02, 0]))
    assert value_at(grid, 2.04, 0.02) == pytest.approx(STEP, rel=1e-6)
    assert [value_at(grid, x, 0.02) for x in (0.02, 1.0, 1.98)] == pytest.approx([-STEP] * 3, rel=1e-6)
    assert grid.observed.sum() == 41
    assert grid.occupied.sum() == 1
    assert grid.free.sum() == 40
    assert grid.probability[grid.occupied] == pytest.approx(0.8)
    assert grid.probability[~grid.observed] == pytest.approx(0.5)


def test_cell_changes_once_a_scan_and_a_hit_wins():
    # 200 beams within a milliradian: 100 end at 1 m, 100 pass on to 2 m through the very same cells.
    ranges = np.where(np.arange(200) % 2, 1.02, 2.02)
    grid = build_occupancy(scans_of([ranges], increment=5e-6), path_of([0.02, 0.02, 0]))
    assert value_at(grid, 1.04, 0.021) == pytest.approx(STEP)
    assert value_at(grid, 2.04, 0.021) == pytest.approx(STEP)
    assert value_at(grid, 0.5, 0.021) == pytest.approx(-STEP)
    assert value_at(grid, 1.5, 0.021) == pytest.approx(-STEP)


def test_log_odds_stay_within_the_clamp_and_equal_evidence_cancels():
    scans = scans_of([[2.02]] * 300)
    grid = build_occupancy(scans, path_of([[0.02, 0.02, 0]] * 300))
    assert value_at(grid, 2.04, 0.02) == pytest.approx(4 * STEP)
    assert value_at(grid, 1.0, 0.02) == pytest.approx(-4 * STEP)
    # Three hits, then three misses of the same cell: exactly zero, and yet observed.
    grid = build_occupancy(scans_of([[1.02]] * 3 + [[3.02]] * 3), path_of([[0.02, 0.02, 0]] * 6))
    assert value_at(grid, 1.04, 0.02) == 0.0
    assert grid.observed[tuple(grid.geometry.world_to_cell(np.array([1.04, 0.02])))]


def test_clamping_keeps_the_recorded_order():
    near, far = [[1.02]] * 10, [[3.02]] * 2
    path = path_of([[0.02, 0.02, 0]] * 12)
    assert value_at(build_occupancy(scans_of(near + far), path), 1.04, 0.02) == pytest.approx(2 * STEP)
    assert value_at(build_occupancy(scans_of(far + near), path), 1.04, 0.02) == pytest.approx(4 * STEP)


def test_map_does_not_depend_on_the_pieces_of_work():
    rng = np.random.default_rng(3)
    count = 4100  # more than two pieces, and sixteen turns of the one-byte marks
    scans = scans_of(rng.uniform(0.2, 3, (count, 3)), increment=2.0)
    path = path_of(rng.uniform(-1, 1, (count, 3)))
    calls = []
    options = OccupancySettings(resolution_m=0.25)
    grid = build_occupancy(scans, path, options, progress=lambda *call: calls.append(call))
    assert calls[-1] == ("occupancy map", count, count)
    assert len(calls) == 3
    part = build_occupancy(scans.select(slice(0, 600)), path.select(np.arange(600)), options)
    again = build_occupancy(scans, path, options)
    assert (again.log_odds == grid.log_odds).all()
    total, seen = slow_occupancy(scans.select(slice(0, 600)), path.select(np.arange(600)), options, part.geometry)
    assert np.abs(part.log_odds - total).max() < 1e-4
    assert (part.observed == seen).all()


def test_grid_grows_to_what_is_seen_and_leaves_out_absurd_ranges():
    scans = scans_of([[9.0, 5.0, 81.83, np.inf, np.nan, 0.001]], increment=np.pi / 2)
    grid = build_occupancy(scans, path_of([3.0, -2.0, 0.0]), OccupancySettings(margin_m=1.0))
    left, right, bottom, top = grid.geometry.extent_m
    assert (left, right, bottom, top) == pytest.approx((2.0, 13.0, -3.0, 4.0), abs=0.051)
    assert grid.occupied.sum() == 2


def test_returns_beyond_the_trusted_range_free_but_do_not_mark():
    grid = build_occupancy(
        scans_of([[6.0]]), path_of([0.02, 0.02, 0]), OccupancySettings(max_range_m=4, free_range_m=3)
    )
    assert grid.occupied.sum() == 0
    assert value_at(grid, 2.9, 0.02) == pytest.approx(-STEP)
    assert grid.geometry.extent_m[1] < 3.7


def test_no_return_clears_only_on_demand_and_dropouts_never():
    path = path_of([0.02, 0.02, 0])
    scans = scans_of([[1.0, 60.0, 0.001]], increment=np.pi / 2)
    assert build_occupancy(scans, path).log_odds.min(axis=1).nonzero()[0].size == 1
    grid = build_occupancy(scans, path, OccupancySettings(no_return_clear_m=2.0))
    assert value_at(grid, 0.02, 1.9) == pytest.approx(-STEP)
    assert not grid.observed[:, : grid.geometry.world_to_cell(np.array([0.0, 0.0]))[1]].any()


def test_fixed_size_map_is_clipped():
    scans = scans_of([[9.0] * 8], increment=np.pi / 4)
    grid = build_occupancy(scans, path_of([0.02, 0.02, 0.1]), OccupancySettings(fixed_size_m=4.0))
    assert grid.geometry.shape == (80, 80)
    assert grid.occupied.sum() == 0
    assert grid.observed[:, [0, -1]].any()
    outside = build_occupancy(scans, path_of([50.0, 50.0, 0]), OccupancySettings(fixed_size_m=4.0))
    assert not outside.observed.any()


def test_weights_scale_the_evidence_of_a_scan():
    scans, path = scans_of([[2.02], [3.02]]), path_of([[0.02, 0.02, 0]] * 2)
    grid = build_occupancy(scans, path, weights=np.array([0.5, 0.0]))
    assert value_at(grid, 2.04, 0.02) == pytest.approx(STEP / 2)
    assert grid.geometry.extent_m[1] < 2.7
    with pytest.raises(InputError, match="weight"):
        build_occupancy(scans, path, weights=np.array([1.0, -1.0]))


def test_every_kth_beam_alone_is_used():
    grid = build_occupancy(
        scans_of([[2.0, 3.0, 2.0, 3.0]], increment=0.5), path_of([0, 0, 0]), OccupancySettings(beam_stride=2)
    )
    assert grid.occupied.sum() == 2


def test_spatial_poses_and_an_inverted_sensor():
    upside_down = np.diag([1.0, -1.0, -1.0, 1.0])
    scans = scans_of([[2.0]], angle_min=np.pi / 2, T_base_lidar=upside_down)
    path = path_of([0.02, 0.02, 0]).spatial()
    assert value_at(build_occupancy(scans, path), 0.02, -1.98) == pytest.approx(STEP)


def test_errors_name_the_problem():
    scans = scans_of([[2.0], [2.0]])
    with pytest.raises(InputError, match="1 poses do not fit 2 scans"):
        build_occupancy(scans, path_of([0, 0, 0]))
    with pytest.raises(InputError, match="pose of scan 1 is not finite"):
        build_occupancy(scans, path_of([[0, 0, 0], [np.nan, 0, 0]]))
    with pytest.raises(InputError, match="no trusted return"):
        build_occupancy(scans_of([[np.nan, 60.0]]), path_of([0, 0, 0]))
    with pytest.raises(ConfigurationError, match="no return is trusted"):
        build_occupancy(scans, path_of([[0, 0, 0]] * 2), OccupancySettings(max_range_m=0.05))
    with pytest.raises(InputError, match="coarser resolution"):
        build_occupancy(scans, path_of([[0, 0, 0], [1e7, 0, 0]]))
    for wrong in ({"resolution_m": 0}, {"min_range_m": 9, "max_range_m": 8}, {"colour": 1}):
        with pytest.raises(ValidationError):
            OccupancySettings(**wrong)
    with pytest.raises(InputError, match="does not fit the grid"):
        OccupancyGrid(
            geometry=GridGeometry.square(1, resolution_m=0.5), log_odds=np.zeros((3, 3)), observed=np.zeros((2, 2))
        )


@pytest.mark.data
def test_map_of_the_true_path_shows_the_corridors(psg_data):
    folder = psg_data / "ece276a" / "20"
    with np.load(folder / "Hokuyo20.npz", allow_pickle=False) as lidar:
        ranges, first, step = lidar["ranges"].T, lidar["angle_min"].item(), lidar["angle_increment"].item()
    truth = np.loadtxt(folder / "truth20.tum")
    mount = np.eye(4)
    mount[:3, 3] = 0.133, 0, 0.514
    scans = scans_of(ranges[::20], angle_min=first, increment=step, T_base_lidar=mount)
    xyt = np.column_stack([truth[::20, 1:3], 2 * np.arctan2(truth[::20, 6], truth[::20, 7])])
    grid = build_occupancy(scans, path_of(xyt))
    assert 3000 < grid.occupied.sum() < 9000  # thin walls: 7.5 to 22 square metres
    rows, columns = grid.geometry.world_to_cell(xyt[:, :2]).T
    assert (grid.log_odds[rows, columns] < 0).mean() > 0.98  # the robot drove where the map is free
