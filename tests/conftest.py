"""What all tests share: the folder of real logs, a reproducible hypothesis profile, and coarse pictures."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "reproducible",
    deadline=None,  # the first example of a test may compile a kernel
    derandomize=True,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "reproducible"))

DRAWING_ROOMS = {"api", "cli", "datasets", "pipeline", "report"}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests marked `data`, saying why, where no folder of real logs is named."""
    if os.environ.get("PSG_DATA"):
        return
    skip = pytest.mark.skip(reason="needs the real logs: set PSG_DATA to their folder")
    for item in items:
        if item.get_closest_marker("data"):
            item.add_marker(skip)


@pytest.fixture(scope="session")
def psg_data() -> Path:
    """Return the folder of real logs: a test skips where PSG_DATA is not set, and fails where it names no folder."""
    named = os.environ.get("PSG_DATA")
    if not named:
        pytest.skip("needs the real logs: set PSG_DATA to their folder")
    folder = Path(named).resolve()
    if not folder.is_dir():
        pytest.fail(f"PSG_DATA names {folder}, which is not a folder")
    return folder


@pytest.fixture(scope="session", autouse=True)
def coarse_pictures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Draw the pictures of runs at half their resolution: drawing them takes four fifths of a short run."""
    if not DRAWING_ROOMS & {item.path.parent.name for item in request.session.items}:
        yield  # no test draws: spare them the import
        return
    from posegraph_slam.report import attitude_figures, canvas, evaluation_figures

    assert attitude_figures.DPI == evaluation_figures.DPI == canvas.DPI  # these two keep theirs
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(canvas, "DPI", canvas.DPI // 2)
        yield
