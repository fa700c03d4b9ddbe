"""The configuration of a run: the settings of every room in one frozen model, from presets, files and overrides."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from posegraph_slam.errors import ConfigurationError, did_you_mean
from posegraph_slam.localization.settings import LocalizationSettings
from posegraph_slam.localization.slam_settings import ParticleSlamSettings
from posegraph_slam.loop_closure.refinement import RefinementSettings
from posegraph_slam.loop_closure.settings import LoopClosureSettings
from posegraph_slam.mapping.floor_settings import FloorSettings
from posegraph_slam.mapping.occupancy import OccupancySettings
from posegraph_slam.mapping.texture import TextureSettings
from posegraph_slam.odometry.scan_matching import ScanMatchingSettings
from posegraph_slam.odometry.settings import OdometrySettings
from posegraph_slam.odometry.timing import TimingSettings
from posegraph_slam.pipeline.rgbd_settings import RgbdSettings
from posegraph_slam.pipeline.settings_files import Layer, build_settings, parse_override, read_layer
from posegraph_slam.pipeline.spatial import SpatialSettings
from posegraph_slam.pose_graph.robust import RobustLoss, RobustSettings
from posegraph_slam.pose_graph.solver_settings import SolverSettings
from posegraph_slam.registration.beam_scans import BeamScanSettings
from posegraph_slam.settings import Settings


class PoseGraphSettings(SolverSettings):
    """The pose graph of a run and how it is solved."""

    group: Literal["se2", "se3"] = "se2"
    """se2: poses in the plane; se3: poses in space, for a robot with wheel encoders and IMU on ramps and slopes."""


class Configuration(Settings):
    """Every key of the commands that run on a log, with its value."""

    seed: int = Field(0, ge=0)
    """Seed of every random choice; the same log, seed and configuration give the same results."""
    workers: int = Field(0, ge=0, le=1024)
    """Threads or processes that share the work, 0 for one a core; results do not depend on it."""
    odometry: OdometrySettings = OdometrySettings()
    scans: BeamScanSettings = BeamScanSettings()
    timing: TimingSettings = TimingSettings()
    scan_matching: ScanMatchingSettings = ScanMatchingSettings()
    loop_closure: LoopClosureSettings = LoopClosureSettings()
    refinement: RefinementSettings = RefinementSettings()
    smoothing: bool = True
    """Smooth the poses of all scans with odometry from wheels, which is known at the scans' own stamps; poses that a
    logger wrote beside the scans are too coarse in time and would only bend the path."""
    pose_graph: PoseGraphSettings = PoseGraphSettings(robust=RobustSettings(loss=RobustLoss.HUBER))
    spatial: SpatialSettings = SpatialSettings()
    maps: bool = True
    """Rebuild the maps from the trajectories."""
    mapping: OccupancySettings = OccupancySettings()
    texture: TextureSettings = TextureSettings()
    floor: FloorSettings = FloorSettings()
    rgbd: RgbdSettings = RgbdSettings()
    localization: LocalizationSettings = LocalizationSettings()
    particle_slam: ParticleSlamSettings = ParticleSlamSettings()


def preset_folder() -> Path:
    """Return the folder of the presets: inside an installed package, or `configs/` of a source checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "presets"
    return installed if installed.is_dir() else package.parent / "configs"


def available_presets() -> dict[str, Path]:
    """Return the preset files by name, in alphabetical order."""
    return {path.stem: path for path in sorted(preset_folder().glob("*.toml"))}


def preset_title(path: Path) -> str:
    """Return the first comment line of a preset: what it is for."""
    first = path.read_text(encoding="utf-8").partition("\n")[0]
    return first.lstrip("# ").strip() if first.startswith("#") else ""


def find_configuration(name: str | Path) -> Path:
    """Return the file meant by `name`: a preset, or a path.

    Raises ConfigurationError listing the presets where it is neither.
    """
    presets = available_presets()
    path = Path(name)
    if str(name) in presets and not path.is_file():
        return presets[str(name)]
    if path.is_file():
        return path
    guess = did_you_mean(str(name), presets)
    raise ConfigurationError(name, "is neither a file nor a preset", f"{guess}the presets are {', '.join(presets)}")


def load_configuration(
    files: Sequence[str | Path | Mapping[str, Any]] = (),
    overrides: Sequence[str] = (),
    *,
    seed: int | None = None,
    workers: int | None = None,
) -> Configuration:
    """Build the configuration from presets or TOML `files` in order, then `a.b=value` overrides, over the defaults.

    A mapping among the files gives its keys, dotted or nested, as a file would; `seed` and `workers`, where given, win
    over all of them. Raises ConfigurationError naming file and key.
    """
    layers = [
        Layer(source="config", values=name) if isinstance(name, Mapping) else read_layer(find_configuration(name))
        for name in files
    ]
    layers += [parse_override(text) for text in overrides]
    if seed is not None:
        layers.append(Layer(source="--seed", values={"seed": seed}))
    if workers is not None:
        layers.append(Layer(source="--workers", values={"workers": workers}))
    return build_settings(Configuration, layers)


def configuration_hash(configuration: Settings) -> str:
    """Return the SHA-256 of the canonical JSON of all keys that can change a result (`workers` cannot)."""
    values = configuration.model_dump(mode="json", exclude={"workers"})
    canonical = json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def usable_workers(configuration: Configuration) -> int:
    """Return the number of workers to use: the configured one, or the cores that this process may run on."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return configuration.workers or cores
