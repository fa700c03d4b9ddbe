"""Simulated RGB-D over floors that are known: colours of the cells, and whether each cell shows its own place."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from posegraph_slam.datasets.ece276a import T_BASE_CAMERA
from posegraph_slam.datasets.simulation import LidarSettings, SimulatedRun, camera, demo_settings, simulate_run
from posegraph_slam.datasets.simulation.floor import FloorTexture, build_floor
from posegraph_slam.geometry import Trajectory, spatial_from_planar
from posegraph_slam.mapping.floor_map import FloorLabeller
from posegraph_slam.mapping.floor_settings import FloorMethod, FloorSettings
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.texture import TextureMap, TextureSettings, build_texture
from posegraph_slam.sensors import DisparityCalibration, RgbdFrames

CALIBRATION = DisparityCalibration()
TIMES_S = np.arange(3.0, 21.0, 0.75)
COLOUR_LAG_S = 0.015
FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)
PERIOD_M = 1.6
"""Colours of the coded floor rise and fall once in this length: 12.5 levels a cell of 0.05 m."""


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return simulate_run(demo_settings(lidar=LidarSettings(beams=11, rate_hz=1.0)))


@pytest.fixture(scope="module")
def path(run: SimulatedRun) -> Trajectory:
    """The true path of the base, dense in time."""
    times = np.arange(0.0, 60.0, 0.02)
    poses = spatial_from_planar(run.motion.poses_at(times))
    return Trajectory(stamps_s=times, poses=poses, parent="map", child="base")


@pytest.fixture(scope="module")
def disparity(run: SimulatedRun, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """Noisy disparity images as the simulator draws them."""
    folder, rng = tmp_path_factory.mktemp("disparity"), np.random.default_rng(4)
    view, files = camera.disparity_view(CALIBRATION), []
    for k, xyt in enumerate(run.motion.xyt_at(TIMES_S)):
        depth, _ = camera.render_depth(view, run.world, xyt)
        files.append(folder / f"{k}.png")
        cv2.imwrite(str(files[-1]), camera.disparity_image(depth, CALIBRATION, run.settings.kinect, rng), FAST)
    return tuple(files)


def images_of(run: SimulatedRun, floor: FloorTexture) -> list[np.ndarray]:
    """Colour images that show `floor`, each taken a little later than its disparity image, before any exposure."""
    view = camera.colour_view(CALIBRATION)
    return [camera.render_colour(view, run.world, floor, xyt) for xyt in run.motion.xyt_at(TIMES_S + COLOUR_LAG_S)]


def rgbd(images: list[np.ndarray], disparity: tuple[Path, ...], folder: Path, gains: np.ndarray) -> RgbdFrames:
    """Frames whose colour images are `images`, each exposed in its own way."""
    files = []
    for k, image in enumerate(images):
        files.append(folder / f"{k}.png")
        cv2.imwrite(str(files[-1]), camera.expose(image, gains[k])[..., ::-1], FAST)
    return RgbdFrames(
        disparity_stamps_s=TIMES_S, colour_stamps_s=TIMES_S + COLOUR_LAG_S, disparity_files=disparity,
        colour_files=tuple(files), T_base_camera=T_BASE_CAMERA,
    )  # fmt: skip


def triangle(s: np.ndarray) -> np.ndarray:
    """Rises from 20 to 220 over half a period and falls back."""
    return 20 + 400 * np.minimum(np.mod(s / PERIOD_M, 1.0), 1 - np.mod(s / PERIOD_M, 1.0))


def coded_floor(run: SimulatedRun) -> FloorTexture:
    """A floor whose red tells x and whose green tells y, both by triangles; blue is plain."""
    lower, size = run.world.lower_m, np.ceil((run.world.upper_m - run.world.lower_m) / 0.01).astype(int)
    x, y = (lower[k] + (np.arange(size[k]) + 0.5) * 0.01 for k in range(2))
    red, green = np.meshgrid(triangle(x), triangle(y))
    colours = np.stack([red, green, np.full_like(red, 100)], axis=-1)
    return FloorTexture(colours=np.rint(colours).astype(np.uint8), origin_m=lower, resolution_m=0.01)


def share_in_own_cell(texture: TextureMap, level: np.ndarray | float = 1.0) -> tuple[float, int]:
    """Share of the cells whose colour is that of a place inside the cell, and how many cells can tell.

    Cells within 0.1 m of a fold of the triangles cannot: a place beyond it has the same colour. `level` is how much
    brighter the floor itself is than the map, which cannot know the mean exposure.
    """
    row, column = np.nonzero(texture.observed)
    centre = texture.geometry.cell_to_world(np.column_stack([row, column]))
    phase = np.mod(centre / PERIOD_M, 0.5) * PERIOD_M
    clear = (np.minimum(phase, PERIOD_M / 2 - phase) > 0.1).all(axis=1)
    error = np.abs((texture.colour * level)[row, column, :2][clear] - triangle(centre[clear])) / (400 / PERIOD_M)
    return float((error <= texture.geometry.resolution_m / 2).all(axis=1).mean()), int(clear.sum())


def mean_colours(floor: FloorTexture, geometry: GridGeometry, parts: int = 5) -> np.ndarray:
    """The mean colour (R, C, 3) of the floor in every cell, over parts x parts points in each."""
    cells = np.stack(np.mgrid[: geometry.shape[0], : geometry.shape[1]], axis=-1)
    centre, total = geometry.cell_to_world(cells), np.zeros((*geometry.shape, 3))
    offset = ((np.arange(parts) + 0.5) / parts - 0.5) * geometry.resolution_m
    for dx in offset:
        for dy in offset:
            total += floor.colour_at((centre + np.array([dx, dy])).reshape(-1, 2)).reshape(total.shape)
    return total / parts**2


def colour_error(texture: TextureMap, floor: FloorTexture) -> np.ndarray:
    """Mean absolute error of each channel in every observed cell (n,), on a scale to 255."""
    error = np.abs(texture.colour - mean_colours(floor, texture.geometry)).mean(axis=2)
    return np.asarray(error[texture.observed])


def exposures(change: float) -> np.ndarray:
    """How much brighter each colour frame is."""
    return 1 + change * np.random.default_rng(11).uniform(-1, 1, len(TIMES_S))


@pytest.fixture(scope="module")
def coded_images(run) -> list[np.ndarray]:
    return images_of(run, coded_floor(run))


@pytest.fixture(scope="module")
def coded(coded_images, disparity, tmp_path_factory) -> RgbdFrames:
    return rgbd(coded_images, disparity, tmp_path_factory.mktemp("coded"), exposures(0.0))


@pytest.fixture(scope="module")
def floor(run) -> FloorTexture:
    return build_floor(run.world, run.settings.world, 0.02, np.random.default_rng(0))


@pytest.fixture(scope="module")
def floor_images(run, floor) -> list[np.ndarray]:
    return images_of(run, floor)


@pytest.mark.parametrize("method", list(FloorMethod))
def test_cells_show_their_own_place(coded, path, method):
    labeller = None
    if method is not FloorMethod.NONE:
        labeller = FloorLabeller(settings=FloorSettings(method=method), T_base_camera=T_BASE_CAMERA)
    share, cells = share_in_own_cell(build_texture(coded, path, labeller=labeller))
    assert cells > 6000
    assert share >= 0.98


def test_cells_show_their_own_place_under_changing_exposure(coded_images, path, disparity, tmp_path):
    frames = rgbd(coded_images, disparity, tmp_path, exposures(0.2))
    texture = build_texture(frames, path)
    level = np.exp(np.log(texture.gains).mean(axis=0) - np.log(exposures(0.2)).mean())  # the gauge: mean exposure
    np.testing.assert_allclose(texture.gains, exposures(0.2)[:, None] * level, rtol=0.03)
    share, cells = share_in_own_cell(texture, level)
    assert cells > 6000
    assert share >= 0.98


@pytest.mark.parametrize("change", [0.0, 0.2])
def test_colours_are_right_whatever_the_exposure(floor, floor_images, path, disparity, tmp_path, change):
    frames = rgbd(floor_images, disparity, tmp_path, exposures(change))
    error = colour_error(build_texture(frames, path), floor)
    assert len(error) > 12_000
    assert error.mean() <= 8
    if change:
        uneven = build_texture(frames, path, TextureSettings(even_exposure=False))
        assert colour_error(uneven, floor).mean() > 2 * error.mean()
