"""What a run leaves is read by others: evo the trajectory, nav2's rules the map, GTSAM the graph."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface
from matplotlib import image as matplotlib_image
from ruamel.yaml import YAML

from posegraph_slam import Run, optimize
from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.geometry import xyt_from_pose


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path]:
    folder = tmp_path_factory.mktemp("others")
    run = optimize(simulate(tiny_settings(duration_s=20.0), folder / "log"))
    return run, run.save(folder / "run", figures=False)


def test_evo_opens_the_trajectory_and_measures_the_same_error(finished: tuple[Run, Path]) -> None:
    run, folder = finished
    theirs = file_interface.read_tum_trajectory_file(folder / "trajectory.tum")
    truth = file_interface.read_tum_trajectory_file(next(run.log.path.glob("truth*.tum")))
    reference, estimate = sync.associate_trajectories(truth, theirs)
    estimate.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    ours = run.metrics["stages"]["optimised"]["ape"]["translation_m"]["rmse"]
    assert ape.get_statistic(metrics.StatisticsType.rmse) == pytest.approx(ours, rel=1e-6)


def test_nav2s_rules_read_the_map_as_it_was(finished: tuple[Run, Path]) -> None:
    """map_server, trinary: occ = (255 - pixel) / 255; above occupied_thresh 100, below free_thresh 0, else -1."""
    run, folder = finished
    assert run.map is not None
    keys = YAML(typ="safe").load((folder / "maps" / "map.yaml").read_text())
    pixels = matplotlib_image.imread(folder / "maps" / keys["image"]).astype(float)
    assert (keys["mode"], keys["negate"]) == ("trinary", 0)
    occupancy = (255.0 - pixels) / 255.0
    cells = np.full(pixels.shape, -1)
    cells[occupancy > keys["occupied_thresh"]] = 100
    cells[occupancy < keys["free_thresh"]] = 0
    cells = cells[::-1]  # the image's last row is the map's first
    np.testing.assert_array_equal(cells == 100, run.map.occupied)
    np.testing.assert_array_equal(cells == 0, run.map.free)
    assert keys["resolution"] == run.map.geometry.resolution_m
    np.testing.assert_array_equal(keys["origin"], [*run.map.geometry.origin_m, 0.0])


def test_gtsam_reads_the_graph(finished: tuple[Run, Path]) -> None:
    run, folder = finished
    factors, values = gtsam.readG2o(str(folder / "graph.g2o"), False)
    theirs = gtsam.utilities.extractPose2(values)
    assert factors.size() == len(run.graph.constraints)
    np.testing.assert_allclose(theirs, xyt_from_pose(run.graph.poses), atol=1e-12)
    first = factors.at(0)
    np.testing.assert_allclose(
        [first.measured().x(), first.measured().y(), first.measured().theta()],
        xyt_from_pose(run.graph.constraints.T_i_j[0]), atol=1e-12,
    )  # fmt: skip
    np.testing.assert_allclose(
        first.noiseModel().information(), run.graph.constraints.information[0], rtol=1e-9, atol=1e-6
    )
