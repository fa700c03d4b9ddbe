"""Floor and texture maps of a run: files on the cells of the occupancy map, the same for any workers, and remarks."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from posegraph_slam.datasets import read
from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.mapping.archive import read_occupancy
from posegraph_slam.mapping.floor_settings import FloorMethod
from posegraph_slam.mapping.images import read_image
from posegraph_slam.mapping.nav2 import read_nav2
from posegraph_slam.pipeline.configuration import Configuration, load_configuration
from posegraph_slam.pipeline.optimize import optimize
from posegraph_slam.pipeline.plan import describe
from posegraph_slam.pipeline.run import run
from posegraph_slam.report.run_figures import draw_figures

NAMES = ("map", "floor", "map_with_floor")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tiny_settings(duration_s=20.0, images=True), tmp_path_factory.mktemp("log") / "one")


def configured(method: FloorMethod, workers: int = 1) -> Configuration:
    return load_configuration(overrides=[f"floor.method={method}", "loop_closure.enabled=false"], workers=workers)


def test_floor_texture_and_laser_maps_share_their_cells(simulated: Path, tmp_path: Path) -> None:
    for workers in (1, 2):
        draw = draw_figures if workers == 1 else None
        run(simulated, configured(FloorMethod.PLANE, workers), out=tmp_path / f"run{workers}", draw=draw)
    folder, again = tmp_path / "run1", tmp_path / "run2"
    maps = {name: read_nav2(folder / f"maps/{name}.yaml") for name in NAMES}
    exact = {name: read_occupancy(folder / f"maps/{name}.npz") for name in NAMES}
    for name in NAMES:
        assert maps[name].geometry.shape == maps["map"].geometry.shape
        np.testing.assert_array_equal(maps[name].geometry.cells_from_map, maps["map"].geometry.cells_from_map)
        np.testing.assert_array_equal(maps[name].occupied, exact[name].occupied)
        for suffix in ("pgm", "yaml", "png", "npz"):
            file = f"maps/{name}.{suffix}"
            assert (folder / file).read_bytes() == (again / file).read_bytes(), file
    pixels = read_image(folder / "maps/texture.png")
    assert pixels.shape == (*maps["map"].geometry.shape, 4)
    seen = pixels[::-1, :, 3] == 255
    assert seen.sum() > 500
    assert (maps["floor"].free & seen).sum() > 0.9 * maps["floor"].free.sum()
    lowered, raised = exact["floor"].log_odds < 0, exact["floor"].log_odds > 0
    change = exact["map_with_floor"].log_odds - exact["map"].log_odds
    assert lowered.any()
    assert (change[lowered] < 0).all()
    assert (change[raised] > 0).all()
    assert not change[~lowered & ~raised].any()
    assert (folder / "figures/floor.png").stat().st_size > 1000


def test_no_floor_map_unless_it_is_asked_for(simulated: Path) -> None:
    log = read(simulated)
    result = optimize(log, configured(FloorMethod.NONE))
    assert result.depth_maps.floor is None
    assert result.depth_maps.fused is None
    assert result.texture is not None
    assert not any("floor from obstacles" in step for step in describe(log, configured(FloorMethod.NONE)))
    assert any("by a RANSAC plane" in step for step in describe(log, configured(FloorMethod.PLANE)))


def test_a_broken_image_is_told_in_a_remark(simulated: Path, tmp_path: Path) -> None:
    log_folder = tmp_path / "log"
    shutil.copytree(simulated, log_folder)
    broken = sorted((log_folder / "dataRGBD/Disparity1").glob("*.png"))[2]
    broken.write_bytes(broken.read_bytes()[:100])
    result = optimize(read(log_folder), configured(FloorMethod.GROUND))
    told = [remark for remark in result.remarks if broken.name in remark]
    assert [remark.split(" leaves")[0] for remark in told] == ["the texture map", "the floor map"]
    assert all("1 " in remark and "\n" not in remark for remark in told)


def test_a_floor_map_that_cannot_be_made_is_told(simulated: Path, tmp_path: Path) -> None:
    log_folder = tmp_path / "log"
    shutil.copytree(simulated, log_folder)
    shutil.rmtree(log_folder / "dataRGBD/Disparity1")
    without = read(log_folder)
    result = optimize(without, configured(FloorMethod.GROUND))
    assert result.depth_maps.floor is None
    assert [remark for remark in result.remarks if remark.startswith("no floor map")] == [
        "no floor map: floor.method asks for one, but the log has no depth images"
    ]
    assert not any("no floor map" in each for each in optimize(without, configured(FloorMethod.NONE)).remarks)
