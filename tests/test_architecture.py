"""The rules of the house, read from the source without importing it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = "posegraph_slam"
ROOT = Path(__file__).resolve().parents[1] / PACKAGE

ROWS: tuple[tuple[str, ...], ...] = (
    ("geometry",),
    ("sensors",),
    ("datasets", "registration", "pose_graph", "mapping"),
    ("odometry", "loop_closure", "localization", "evaluation"),
    ("pipeline",),
    ("report",),
    ("cli",),
)
ROW_OF = {room: row for row, rooms in enumerate(ROWS, start=1) for room in rooms}
SHARED = {"errors", "arrays", "settings", "jit", "execution", "files"}
"""Row 0: modules that every room may import and that import no room."""
FRONT = {"__init__", "api"}
"""The front door for programs, above all rooms; no room imports it."""

HOMES = {
    "gtsam": ("pose_graph/",),
    "typer": ("cli/",),
    "rich": ("cli/",),
    "matplotlib": ("report/",),
    "dask": ("pipeline/",),
    "distributed": ("pipeline/",),
    "rerun": ("report/viewer.py",),
    "rosbags": ("datasets/rosbag/",),
    "cv2": (
        "datasets/rgbd_writing.py",
        "datasets/rosbag/images.py",
        "datasets/simulation/files.py",
        "datasets/simulation/rgbd_room.py",
        "localization/free_space.py",
        "mapping/images.py",
        "registration/features.py",
    ),
    "open3d": (),
    "evo": (),  # GPL: an oracle in the tests, never a part of the package
    "small_gicp": (),
}
"""Third-party packages that may be imported only under these files or folders."""

GLOBAL_RANDOM = {"seed", "rand", "randn", "randint", "random", "normal", "uniform", "choice", "shuffle", "permutation"}


def imported_names(tree: ast.AST, path: str) -> Iterator[tuple[int, str]]:
    """Yield line and dotted name of every import, lazy ones and those written as strings included."""
    package = [PACKAGE, *Path(path).parts[:-1]]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{stem}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith(f"{PACKAGE}."):
            yield node.lineno, node.value


def room_violations(path: str, tree: ast.AST) -> Iterator[str]:
    """Yield the imports that reach a higher row or a neighbour, and those by which row 0 reaches a room."""
    parts = Path(path).parts
    here = parts[0] if len(parts) > 1 else Path(path).stem
    if here not in FRONT and here not in ROW_OF and here not in SHARED:
        yield f"{path}: {here} is neither a room nor a shared module"
        return
    for line, name in imported_names(tree, path):
        if here in FRONT:
            continue
        segments = name.split(".")
        there = segments[1].split(":")[0] if segments[0] == PACKAGE and len(segments) > 1 else None
        if there == "api":
            yield f"{path}:{line}: {here} imports the front door"
        if there in ROW_OF and there != here and ROW_OF[there] >= ROW_OF.get(here, 0):
            yield f"{path}:{line}: {here} (row {ROW_OF.get(here, 0)}) imports {there} (row {ROW_OF[there]})"


def home_violations(path: str, tree: ast.AST) -> Iterator[str]:
    """Yield imports of third-party packages outside their homes."""
    for line, name in imported_names(tree, path):
        top = name.split(".")[0]
        if top in HOMES and not path.startswith(HOMES[top]):
            yield f"{path}:{line}: imports {top}, which lives in {', '.join(HOMES[top]) or 'no file'}"


def practice_violations(path: str, tree: ast.AST) -> Iterator[str]:
    """Yield prints, pickles, bare excepts and global random numbers."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ExceptHandler) and node.type is None:
            yield f"{path}:{node.lineno}: bare except"
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called == "print" and not path.startswith("cli/"):
                yield f"{path}:{node.lineno}: only the command line prints"
            if called.startswith(("np.random.", "numpy.random.")) and called.rsplit(".", 1)[1] in GLOBAL_RANDOM:
                yield f"{path}:{node.lineno}: {called} uses the global generator; pass a numpy Generator"
            yield from (
                f"{path}:{node.lineno}: allow_pickle must stay False"
                for keyword in node.keywords
                if keyword.arg == "allow_pickle"
                and not (isinstance(keyword.value, ast.Constant) and keyword.value.value is False)
            )
    for line, name in imported_names(tree, path):
        if name.split(".")[0] in {"pickle", "cPickle", "dill", "random"}:
            yield f"{path}:{line}: imports {name.split('.')[0]}"


RULES = (room_violations, home_violations, practice_violations)


@pytest.fixture(scope="module")
def trees() -> dict[str, ast.AST]:
    """Return the syntax tree of every file of the package by its path in it."""
    return {
        path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(ROOT.rglob("*.py"))
    }


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_package_follows_the_rules(trees: dict[str, ast.AST], rule) -> None:
    assert len(trees) > 30
    broken = [violation for path, tree in trees.items() for violation in rule(path, tree)]
    assert not broken, "\n".join(broken)


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("geometry/a.py", "from posegraph_slam.sensors import Imu"),
        ("mapping/a.py", "import posegraph_slam.registration.icp"),
        ("odometry/a.py", "def f():\n    from posegraph_slam.pipeline import optimize"),
        ("sensors/a.py", "from ..mapping import grid"),
        ("sensors/a.py", "from .. import mapping"),
        ("cli/a.py", "from posegraph_slam.api import optimize"),
        ("arrays.py", "from posegraph_slam.geometry import SE2"),
        ("datasets/a.py", "load('posegraph_slam.pipeline.optimize:f')"),
        ("heap.py", "x = 1"),
        ("mapping/a.py", "import gtsam"),
        ("pipeline/a.py", "from matplotlib.figure import Figure"),
        ("geometry/a.py", "import cv2"),
        ("evaluation/a.py", "import evo.core"),
        ("report/a.py", "print(1)"),
        ("mapping/a.py", "np.random.seed(1)"),
        ("mapping/a.py", "import numpy as np\nnp.load(p, allow_pickle=True)"),
        ("mapping/a.py", "import pickle"),
        ("mapping/a.py", "from random import random"),
        ("mapping/a.py", "try:\n    f()\nexcept:\n    g()"),
    ],
)
def test_rules_find_violations(path: str, source: str) -> None:
    tree = ast.parse(source)
    assert [violation for rule in RULES for violation in rule(path, tree)]


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("pipeline/a.py", "from posegraph_slam.mapping import grid\nfrom posegraph_slam.errors import InputError"),
        ("mapping/a.py", "from posegraph_slam.mapping.raycast import cast\nfrom . import raycast"),
        ("datasets/a.py", "GROUP = 'posegraph_slam.readers'"),
        ("pose_graph/a.py", "import gtsam"),
        ("mapping/a.py", "rng = np.random.default_rng(1)\nnp.load(p, allow_pickle=False)"),
    ],
)
def test_rules_leave_the_rest_alone(path: str, source: str) -> None:
    tree = ast.parse(source)
    assert not [violation for rule in RULES for violation in rule(path, tree)]
