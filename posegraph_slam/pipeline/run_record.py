"""What `run.json` says of a run: versions, platform, configuration, input, times and memory."""

from __future__ import annotations

import hashlib
import platform
import resource
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from posegraph_slam import __version__
from posegraph_slam.pipeline.configuration import Configuration, configuration_hash
from posegraph_slam.pipeline.run_directory import FORMAT_VERSION

PACKAGES = ("gtsam", "numpy", "scipy", "numba", "opencv-python-headless", "matplotlib", "pydantic")
"""Packages whose version can change a number or a picture."""

HASHED_BYTES = 1 << 28
"""Inputs up to this size are hashed in full (a quarter of a second); larger ones are told by size only."""


def run_record(
    configuration: Configuration,
    log: Path,
    *,
    log_format: str,
    topics: Mapping[str, str] | None = None,
    stages_s: dict[str, float],
    jit_compile_s: float,
    command: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Return the content of `run.json` for a run that is about to end."""
    return {
        "format_version": FORMAT_VERSION,
        "posegraph_slam": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": package_versions(),
        "command": list(sys.argv if command is None else command),
        "configuration_sha256": configuration_hash(configuration),
        "seed": configuration.seed,
        "input": {"format": log_format, **({"topics": dict(topics)} if topics else {}), **fingerprint(log)},
        "stages_s": {name: round(seconds, 3) for name, seconds in stages_s.items()},
        "total_s": round(sum(stages_s.values()), 3),
        "jit_compile_s": round(jit_compile_s, 3),
        "peak_memory_mib": round(peak_memory_mib(), 1),
    }


def package_versions() -> dict[str, str | None]:
    """Return the installed version of each package that results depend on, None where it is absent."""
    return {name: _version(name) for name in PACKAGES}


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def fingerprint(path: Path) -> dict[str, Any]:
    """Return path, number of files, size in bytes and SHA-256 of a file, or of a folder's files with their names.

    The hash is None for inputs of more than `HASHED_BYTES`; a path that is gone, or never was, has no files.
    """
    if not path.exists():
        return {"path": str(path), "files": 0, "bytes": 0, "sha256": None}
    files = [path] if path.is_file() else sorted(item for item in path.rglob("*") if item.is_file())
    size = sum(item.stat().st_size for item in files)
    digest = hashlib.sha256()
    for item in files if size <= HASHED_BYTES else []:
        if item != path:
            digest.update(item.relative_to(path).as_posix().encode() + b"\0")
        with item.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest() if item != path else file.read())
    sha256 = digest.hexdigest() if size <= HASHED_BYTES else None
    return {"path": str(path.resolve()), "files": len(files), "bytes": size, "sha256": sha256}


def peak_memory_mib() -> float:
    """Return the largest resident memory of this process so far, or of one of its finished workers if that is more.

    Linux hands the maximum that getrusage tells down to the programs that a process starts; VmHWM begins anew.
    """
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, KiB on Linux
    workers = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * unit
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text(encoding="utf-8").splitlines() if ":" in line)
        if "VmHWM" in lines:
            return max(int(lines["VmHWM"].split()[0]) * 1024, workers) / 2**20
    return max(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit, workers) / 2**20
